"""One step of the discrete Lagrange–Poincaré equations on Σ × 𝔤 for a curved shape space Σ: a step in charts of Σ × G seen on
the quotient by G ([RL] §6)."""

from collections.abc import Sequence
from dataclasses import dataclass

import jax.numpy as jnp

from dirax.program.tracing import gradient
from dirax.program.user_functions import UserFunction
from dirax.reduction.bundle import TrivialBundle
from dirax.reduction.reduced_on_manifold import ReducedManifoldLagrangian
from dirax.schemes.abstract_step import AbstractStep
from dirax.schemes.layout import Layout
from dirax.schemes.step import Field
from dirax.schemes.step_in_charts import StepInCharts


@dataclass(frozen=True, eq=False)
class ReducedStepInCharts(AbstractStep):
    """The step on (Q × Q)/G of a step in charts of Q = Σ × G, whose equations the group leaves alone.

    State (m, r, w, μ, g, …): the centre of the chart of Σ, coordinates and momentum in it, the body momentum, and g; unknowns
    (ṙ, γ, …) with the vertical part hγ. Every step begins at (x, e), in the chart at (m, e), with p = (w − A(x)ᵀμ, μ), ends at
    (x', f): w' and μ' are those of its momentum, seen from f, as the charts of G are left-invariant, and g' = g f.
    So an atlas of Σ alone is met, and no coordinates of G but those of a step.
    """

    system: ReducedManifoldLagrangian
    unreduced: StepInCharts

    @property
    def bundle(self) -> TrivialBundle:
        """Q = Σ × G with the connection."""
        return self.system.connection

    @property
    def state(self) -> Layout:
        bundle, d = self.bundle, self.bundle.shapes.dimension
        own = {"chart": bundle.shapes.ambient_dimension, "r": d, "w": d, "mu": bundle.k, "g": bundle.group.ambient_dimension}
        return Layout(**own, **self.unreduced.state.without("chart", "r", "p"))

    @property
    def unknowns(self) -> Layout:
        return Layout(rate=self.bundle.shapes.dimension, vertical=self.bundle.k, **self.unreduced.unknowns.without("v"))

    @property
    def fields(self) -> dict[str, Field]:
        bundle, of_q = self.bundle, self.unreduced.fields
        n, k = bundle.shapes.ambient_dimension, bundle.k
        return {
            "x": Field((n,), dims=("shape",)),
            "w": Field((n,), dims=("shape",), description="momentum of the shape, p_x + A(x)ᵀμ"),
            "mu": Field((k,), dims=("algebra",), description="body momentum of the group's part"),
            "g": Field((bundle.group.ambient_dimension,), dims=("group",), description="group element, by reconstruction"),
            "vertical": Field((k,), "step", ("algebra",), "coordinates of the vertical part of (q_k, q_{k+1})", "sum"),
            "chart": Field((n,), dims=("shape",), description="the point of Σ at which the chart in use is centred"),
        } | {name: field for name, field in of_q.items() if name not in ("q", "p", "chart")}

    @property
    def labels(self) -> Sequence[str]:
        horizontal = tuple(f"horizontal equation {i} in the chart" for i in range(self.bundle.shapes.dimension))
        vertical = tuple(f"vertical equation {a}" for a in range(self.bundle.k))
        return horizontal + vertical + tuple(self.unreduced.labels[len(horizontal + vertical) :])

    # ------------------------------------------------------------------------------------------- to Q at e, and back

    def ends(self, state, u, h):
        """The points x0 and x1 of Σ."""
        parts, chart = self.state.split(state), self.bundle.chart_of_shapes(self.state.split(state).chart)
        return chart.to_manifold(parts.r), chart.to_manifold(parts.r + h * self.unknowns.split(u).rate)

    def lifted(self, state, u, h):
        """The state on Q, at (x, e), and the unknowns there."""
        bundle, parts = self.bundle, self.state.split(state)
        rate, vertical, *_ = self.unknowns.split(u)
        along = vertical
        if bundle.connection is not None:
            along = bundle.step_along(*self.ends(state, u, h), h * vertical) / h
        matrix = bundle.matrix(bundle.chart_of_shapes(parts.chart), parts.r)
        on_q = self.unreduced.state.join(
            chart=bundle.join(parts.chart, bundle.group.identity()),
            r=bundle.join_local(parts.r, jnp.zeros(bundle.k)),
            p=bundle.join_local(parts.w - matrix.T @ parts.mu, parts.mu),
            **self.state.rest(state, "chart", "r", "w", "mu", "g"),
        )
        rest = self.unknowns.rest(u, "rate", "vertical")
        return on_q, self.unreduced.unknowns.join(v=bundle.join_local(rate, along), **rest)

    def lowered(self, on_q, f, g):
        """The state of one on Q at a point whose group element is f; g is that of the motion."""
        bundle, layout = self.bundle, self.unreduced.state
        base, coordinates, p, *_ = layout.split(on_q)
        (m, centre), (r, _), (p_r, p_s) = bundle.split(base), bundle.split_local(coordinates), bundle.split_local(p)
        there, here = bundle.chart_of_group(centre), bundle.chart_of_group(f)
        mu = gradient(lambda s: there.to_local(here.to_manifold(s)) @ p_s)(jnp.zeros(bundle.k))
        w = p_r + bundle.matrix(bundle.chart_of_shapes(m), r).T @ mu
        return self.state.join(chart=m, r=r, w=w, mu=mu, g=g, **layout.rest(on_q, "chart", "r", "p"))

    # ------------------------------------------------------------------------------------------------ the equations

    def residual(self, u, state, t, h, params):
        on_q, v = self.lifted(state, u, h)
        missed, d = self.unreduced.residual(v, on_q, t, h, params), self.bundle.manifold.dimension
        parts = self.state.split(state)
        across, along = self.bundle.split_local(missed[:d])
        matrix = self.bundle.matrix(self.bundle.chart_of_shapes(parts.chart), parts.r)
        return jnp.concatenate([across + matrix.T @ along, along, missed[d:]])

    def advance(self, u, state, t, h, params):
        bundle, before = self.bundle, self.state.split(state)
        on_q, v = self.lifted(state, u, h)
        _, along = bundle.split_local(self.unreduced.unknowns.split(v).v)
        f = bundle.chart_of_group(bundle.group.identity()).to_manifold(h * along)
        g = bundle.group.nearest(bundle.chart_of_group(before.g).to_manifold(h * along))
        after = self.lowered(self.unreduced.advance(v, on_q, t, h, params), f, g)
        # of an abelian group, without forces, the vertical equation is the law μ_{k+1} = μ_k
        return self.state.replace(after, mu=before.mu) if self.system.conserves_momentum else after

    def unpack(self, state, u, t, h, params):
        bundle, parts = self.bundle, self.state.split(state)
        on_q, v = self.lifted(state, u, h)
        row = dict(self.unreduced.unpack(on_q, v, t, h, params))
        q, p, _ = row.pop("q"), row.pop("p"), row.pop("chart")
        x, (p_x, mu) = bundle.split(q)[0], bundle.body(q, p)
        vertical = h * self.unknowns.split(u).vertical
        own = {"x": x, "w": p_x + bundle.shift(x, mu), "mu": mu, "g": parts.g, "vertical": vertical, "chart": parts.chart}
        return own | row

    def guess(self, state, previous, h, params):
        on_q, before = self.lifted(state, previous, h)
        return self._lowered_unknowns(state, self.unreduced.guess(on_q, before, h, params), h)

    def _lowered_unknowns(self, state, on_q, h):
        """(ṙ, γ, …) of the unknowns on Q."""
        layout = self.unreduced.unknowns
        rate, along = self.bundle.split_local(layout.split(on_q).v)
        u = self.unknowns.join(rate=rate, vertical=along, **layout.rest(on_q, "v"))
        if self.bundle.connection is None:
            return u
        return self.unknowns.replace(u, vertical=self.bundle.vertical_of(*self.ends(state, u, h), h * along) / h)

    # ---------------------------------------------------------------------------------------------------- the start

    def start(self, data, h, params):
        return self._begun(self.unreduced.start, data, h, params)

    def resume(self, data, h, params):
        return self._begun(self.unreduced.resume, data, h, params)

    def _begun(self, begin, data, h, params):
        """The start on Q of data translated to e."""
        bundle = self.bundle
        q = data["q0"] if "q0" in data else data["q"]
        (x, g), e = bundle.split(q), bundle.group.identity()
        if "q0" in data:
            x1, g1 = bundle.split(data["q1"])
            moved = {"q0": bundle.join(x, e), "q1": bundle.join(x1, bundle.between(g, g1))}
        else:
            at, v = bundle.to_identity(q, data["v"])
            moved = {"q": at, "v": v, "p": bundle.covector(at, *bundle.body(q, data["p"]))}
        if "chart" in data:
            moved["chart"] = bundle.join(data["chart"], e)
        on_q, u = begin(data | moved, h, params)
        state = self.lowered(on_q, e, g)
        return state, self._lowered_unknowns(state, u, h)

    def check(self, data, h, params):
        local = self.unreduced.local
        own = {"discrete_lagrangian": local.rule, "constraint": local.constraint_rule}
        own = {name: function for name, function in own.items() if isinstance(function, UserFunction)}
        if own:
            self.system.refuse_asymmetric(own, data, h, params)
        if self.unreduced.part:
            self.system.refuse_moved_one_forms(data, params)
