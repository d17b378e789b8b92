"""Discrete Lagrangian mechanics on a manifold, computed in retraction-compatible charts that change on the way ([RL] §6)."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax.numpy as jnp

from dirax.geometry.charts import Atlas, RetractionChart
from dirax.geometry.manifolds import AbstractGeodesicManifold
from dirax.geometry.maps import AbstractDiscretizationMap
from dirax.program.linear_solves import solve
from dirax.program.tracing import gradient, jacobian
from dirax.program.user_functions import UserFunction
from dirax.schemes.abstract_step import AbstractStep
from dirax.schemes.discrete_lagrangian import LD_ARGUMENTS
from dirax.schemes.lagrange_dalembert_step import LagrangeDAlembertStep
from dirax.schemes.layout import Layout
from dirax.schemes.step import AbstractScheme, Field, Shape, StepEquation
from dirax.schemes.step_forms import ChartedForm
from dirax.systems.lagrange_dirac import LagrangeDirac
from dirax.systems.manifold_lagrangian import ManifoldLagrangian

NEAR = 0.25
"""Square of the distance, relative to the velocity of the momentum at the node, up to which an extrapolated one is the guess."""


class InCharts(AbstractScheme):
    """The discrete Euler–Lagrange equations of L_d(q0, q1) = h L(R_d⁻¹(q0, q1)/h), solved in a chart at hand.

    `map`: a discretization map R_d on the manifold; L_d is defined on Q × Q by it, without coordinates, so that the chart
    changes nothing but roundoff. `atlas`: which charts and when to leave them; by default the charts compatible with the
    manifold's retraction ([RL] Definition 6.2), left where half of the domain is used. The state is (m, r, p): the
    centre of the chart and the coordinates in it. Symplectic on T*Q; second order for a symmetric map.
    """

    map: AbstractDiscretizationMap
    atlas: Atlas | None = None

    def discrete_structure(self, system: Any, shape: Shape, step: Any) -> str:
        return "no structure on a Q × Q that is not flat is stated; whether a step is symplectic is measured instead"

    def step_equation(self, system: Any, shape: Shape) -> StepEquation:
        on_manifold = system.manifold_form()
        if on_manifold is None:
            raise TypeError(f"dx.InCharts steps a dx.ManifoldLagrangian, but a {type(system).__name__} was given.")
        if on_manifold.constraints.any or on_manifold.forces is not None:
            raise ValueError("dx.InCharts steps a Lagrangian without one_forms and forces: use dx.DiscreteDirac(map).")
        manifold = on_manifold.manifold
        if not isinstance(manifold, AbstractGeodesicManifold):
            raise TypeError(f"dx.InCharts needs a manifold with a retraction, and {manifold!r} has none.")
        return StepInCharts(on_manifold, manifold, self.map, self.atlas or Atlas(manifold), shape.n).equation()

    def step_form(self, system: Any, shape: Shape, step: Any) -> ChartedForm:
        return ChartedForm(system, step)


@dataclass(frozen=True, eq=False)
class StepInCharts(AbstractStep):
    """The discrete Euler–Lagrange equations in the chart at a point m: state (m, r, p), unknown the velocity of r.

    The inner step is that of the (+) scheme in R^d, with the coordinates r and (params, m) as its parameters.
    """

    system: ManifoldLagrangian
    manifold: AbstractGeodesicManifold
    map: AbstractDiscretizationMap
    atlas: Atlas
    size: int

    @cached_property
    def inner(self) -> LagrangeDAlembertStep:
        """The step in coordinates."""
        only_its_rule_is_used = LagrangeDirac(lambda r, v: jnp.zeros(()))
        rule = UserFunction(self.discrete_lagrangian, "discrete_lagrangian", LD_ARGUMENTS)
        return LagrangeDAlembertStep(only_its_rule_is_used, Shape(self.manifold.dimension), rule, "right", "incoming")

    @property
    def state(self) -> Layout:
        return Layout(chart=self.size, r=self.manifold.dimension, p=self.manifold.dimension)

    @property
    def unknowns(self) -> Layout:
        return Layout(v=self.manifold.dimension)

    @property
    def fields(self) -> dict[str, Field]:
        return {
            "q": Field((self.size,)),
            "p": Field((self.size,)),
            "chart": Field((self.size,), description="the point at which the chart in use is centred"),
        }

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(f"discrete Euler–Lagrange equation {i} in the chart" for i in range(self.manifold.dimension))

    def chart(self, m) -> RetractionChart:
        """The chart centred at m."""
        return RetractionChart(self.manifold, m, self.manifold.frame(m), self.atlas.exponential)

    def discrete_lagrangian(self, r0, r1, h, where):
        """L_d of two points given by their coordinates, in the chart that `where` names."""
        params, m = where
        here = self.chart(m)
        x, w = self.map.backward(here.to_manifold(r0), here.to_manifold(r1))
        return h * self.system.lagrangian(x, w / h, params)

    def guess(self, state, previous, h, params):
        """The velocities extrapolated from the steps before, where they are near that of the momentum at the node: components
        from before a change of chart are those of other vectors, and then it is that velocity."""
        m, r, p = self.state.split(state)
        here = self.chart(m)

        def momentum(v):
            return gradient(lambda v: self.system.lagrangian(*here.velocity_to_manifold(r, v), params))(v)

        at_rest = jnp.zeros_like(r)
        velocity = solve(jacobian(momentum)(at_rest), p - momentum(at_rest))
        apart = previous - velocity
        return jnp.where(apart @ apart <= NEAR * (velocity @ velocity), previous, velocity)

    def residual(self, u, state, t, h, params):
        m, r, p = self.state.split(state)
        return self.inner.residual(u, self.inner.state.join(q=r, p=p), t, h, (params, m))

    def advance(self, u, state, t, h, params):
        m, r, p = self.state.split(state)
        after = self.inner.state.split(self.inner.advance(u, self.inner.state.join(q=r, p=p), t, h, (params, m)))
        there, r, p = self.atlas.follow(self.chart(m), after.q, after.p)
        return self.state.join(chart=there.base, r=r, p=p)

    def unpack(self, state, u, t, h, params):
        m, r, p = self.state.split(state)
        q, momentum = self.chart(m).momentum_to_manifold(r, p)
        return {"q": q, "p": momentum, "chart": m}

    def start(self, data, h, params):
        here, r, p = self.atlas.enter(data["q"], data["p"])
        # the unknowns are a first guess of the velocity
        return self.state.join(chart=here.base, r=r, p=p), here.components(data["v"])

    def resume(self, data, h, params):
        """In the chart that was in use."""
        here = self.chart(data["chart"])
        r, p = here.momentum_to_local(data["q"], data["p"])
        return self.state.join(chart=here.base, r=r, p=p), here.velocity_to_local(data["q"], data["v"])[1]
