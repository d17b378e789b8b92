"""One step of the discrete Lagrange–d'Alembert equations on a manifold, in charts that change on the way ([RL] §6)."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax.numpy as jnp

from dirax.geometry.charts import Atlas, RetractionChart
from dirax.geometry.manifolds import AbstractGeodesicManifold
from dirax.program.linear_solves import solve
from dirax.program.tracing import jacobian
from dirax.schemes.abstract_step import AbstractStep
from dirax.schemes.labels import Labels
from dirax.schemes.lagrange_dalembert_part import LagrangeDAlembertPart
from dirax.schemes.lagrange_dalembert_step import LagrangeDAlembertStep
from dirax.schemes.lagrangian_in_charts import LagrangianInCharts
from dirax.schemes.layout import Layout
from dirax.schemes.step import Field, Shape

NEAR = 0.25
"""Square of the distance, relative to the velocity of the momentum at the node, up to which an extrapolated one is the guess."""

VELOCITIES = ("v", "end_v")
"""The unknowns that are components in the frame of the chart."""


def lagrangian_in_charts(system: Any, rule: Any, constraint: Any, exponential: bool = False) -> LagrangianInCharts:
    """The discrete Lagrangian of a system on a manifold. Raises `TypeError` for a manifold without a retraction, and for
    holonomic constraints."""
    on_manifold = system.manifold_form()
    if on_manifold.holonomic is not None:
        raise TypeError(
            "discrete Lagrangians on a manifold do not keep holonomic constraints: take them into the manifold, or use "
            'dx.DiscreteDirac(map, "resolve").'
        )
    if not isinstance(on_manifold.manifold, AbstractGeodesicManifold):
        raise TypeError(
            f"discrete Lagrangians on a manifold need one with a retraction, and {on_manifold.manifold!r} has none: use "
            "dx.DiscreteDirac with a map on it."
        )
    return LagrangianInCharts(on_manifold, on_manifold.manifold, rule, constraint, exponential)


@dataclass(frozen=True, eq=False)
class StepInCharts(AbstractStep):
    """The discrete equations in the chart at a point m: state (m, r, p, work), unknowns the velocity of r and the multipliers.

    The inner step is that of the equations in R^d, with the coordinates r, and (params, m) as its parameters; where it is a
    `part` of a composition it ends at the momentum projected onto the constraints.
    """

    local: LagrangianInCharts
    atlas: Atlas
    shape: Shape
    momentum: str
    part: bool = False

    @cached_property
    def inner(self) -> LagrangeDAlembertStep | LagrangeDAlembertPart:
        """The step in coordinates."""
        local, shape = self.local, Shape(self.local.manifold.dimension, self.shape.m, redundant=self.shape.redundant)
        forced = None if local.system.forces is None else local.impulses
        step = LagrangeDAlembertStep(
            local.local_system, shape, local.local_rule, local.local_constraint, self.momentum, quadrature=forced
        )
        return LagrangeDAlembertPart(step) if self.part else step

    @property
    def state(self) -> Layout:
        d = self.local.manifold.dimension
        return Layout(chart=self.shape.n, r=d, p=d, **self.inner.state.without("q", "p"))

    @property
    def unknowns(self) -> Layout:
        return self.inner.unknowns

    @property
    def fields(self) -> dict[str, Field]:
        n = self.shape.n
        own = {
            "q": Field((n,)),
            "p": Field((n,)),
            "chart": Field((n,), description="the point at which the chart in use is centred"),
        }
        return own | {name: field for name, field in self.inner.fields.items() if name not in own}

    @property
    def labels(self) -> Labels:
        d = self.local.manifold.dimension
        kind = "Lagrange–d'Alembert" if self.shape.m or self.local.system.forces is not None else "Euler–Lagrange"
        return Labels.numbered(f"discrete {kind} equation {{}} in the chart", d) + tuple(self.inner.labels[d:])

    # ------------------------------------------------------------------------------------------------- coordinates

    def chart(self, m) -> RetractionChart:
        """The chart centred at m."""
        return self.local.chart(m)

    def lowered(self, state):
        """(m, the state of the inner step)."""
        m, r, p, *_ = self.state.split(state)
        return m, self.inner.state.join(q=r, p=p, **self.state.rest(state, "chart", "r", "p"))

    def lifted(self, m, inner):
        """The state of an inner one in the chart at m."""
        q, p, *_ = self.inner.state.split(inner)
        return self.state.join(chart=m, r=q, p=p, **self.inner.state.rest(inner, "q", "p"))

    # ------------------------------------------------------------------------------------------------ the equations

    def residual(self, u, state, t, h, params):
        m, inner = self.lowered(state)
        return self.inner.residual(u, inner, t, h, (params, m))

    def advance(self, u, state, t, h, params):
        m, inner = self.lowered(state)
        after = self.inner.advance(u, inner, t, h, (params, m))
        q, p, *_ = self.inner.state.split(after)
        there, r, p = self.atlas.follow(self.chart(m), q, p)
        return self.lifted(there.base, self.inner.state.replace(after, q=r, p=p))

    def unpack(self, state, u, t, h, params):
        m, inner = self.lowered(state)
        row = self.inner.unpack(inner, u, t, h, (params, m))
        q, p = self.chart(m).momentum_to_manifold(row["q"], row["p"])
        return row | {"q": q, "p": p, "chart": m}

    def guess(self, state, previous, h, params):
        """The velocities extrapolated from the steps before, where they are near that of the momentum at the node: components
        from before a change of chart are those of other vectors, and then it is that velocity."""
        m, inner = self.lowered(state)
        r, p, *_ = self.inner.state.split(inner)
        system, at_rest = self.local.local_system, jnp.zeros_like(r)
        momentum = lambda v: system.legendre(r, v, (params, m))
        velocity = solve(jacobian(momentum)(at_rest), p - momentum(at_rest))

        def nearer(extrapolated):
            apart = extrapolated - velocity
            return jnp.where(apart @ apart <= NEAR * (velocity @ velocity), extrapolated, velocity)

        parts = self.unknowns.split(previous)._asdict()
        return self.unknowns.replace(previous, **{name: nearer(parts[name]) for name in VELOCITIES if name in parts})

    # ---------------------------------------------------------------------------------------------------- the start

    def start(self, data, h, params):
        if "q0" in data:
            here = self.atlas.chart_at(data["q0"])
            ends = {name: here.to_local(data[name]) for name in ("q0", "q1")}
            state, u = self.inner.start(data | ends, h, (params, here.base))
            return self.lifted(here.base, state), u
        here, r, p = self.atlas.enter(data["q"], data["p"])
        inner = {"q": r, "p": p, "v": here.velocity_to_local(data["q"], data["v"])[1], "t": data.get("t", 0.0)}
        state, u = self.inner.start(inner, h, (params, here.base))
        return self.lifted(here.base, state), u

    def resume(self, data, h, params):
        """In the chart that was in use."""
        here = self.chart(data["chart"])
        r, p = here.momentum_to_local(data["q"], data["p"])
        v = here.velocity_to_local(data["q"], data["v"])[1]
        state, u = self.inner.resume(data | {"q": r, "p": p, "v": v}, h, (params, here.base))
        return self.lifted(here.base, state), u
