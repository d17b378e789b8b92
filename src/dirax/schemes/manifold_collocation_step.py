"""One step of a Gauss method on a manifold: collocation in the chart at the point that the step leaves."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from dirax.geometry.charts import RetractionChart
from dirax.geometry.manifolds import AbstractGeodesicManifold
from dirax.program.tracing import gradient, once
from dirax.schemes.abstract_step import AbstractStep
from dirax.schemes.collocation_step import combined
from dirax.schemes.collocation_tables import Tableau
from dirax.schemes.layout import Layout
from dirax.schemes.step import Field
from dirax.systems.manifold_lagrangian import ManifoldLagrangian


@dataclass(frozen=True, eq=False)
class ManifoldCollocation(AbstractStep):
    """The discrete Euler–Lagrange equations of the Galerkin discrete Lagrangian in the chart φ at q_0 that is compatible with
    the manifold's retraction,

        L_d(q_0, q_1) = ext h Σ_i b_i L(φ⁻¹(R_i), Dφ⁻¹(R_i) Ṙ_i),   R_i = h Σ_j a_ij Ṙ_j,   q_1 = φ⁻¹(h Σ_i b_i Ṙ_i).

    With ℓ for L in the chart, the extremum is π_1 = ∂ℓ/∂ṙ_i + h Σ_j (b_j − a_ij) ∂ℓ/∂r_j at every node, where π_1 are the
    components of p_1 in the chart; p_0 = −D1 L_d moves the chart with q_0, which makes the map symplectic on T*Q.
    Order 2s; q_1 lies on the manifold. State (q, p) in R^N, unknowns the Ṙ_i and π_1.
    """

    tableau: Tableau
    system: ManifoldLagrangian
    manifold: AbstractGeodesicManifold
    size: int

    @property
    def state(self) -> Layout:
        return Layout(q=self.size, p=self.size)

    @property
    def unknowns(self) -> Layout:
        d = self.manifold.dimension
        return Layout(**{f"rate_{i + 1}": d for i in range(self.tableau.stages)}, momentum=d)

    @property
    def fields(self) -> dict[str, Field]:
        return {"q": Field((self.size,)), "p": Field((self.size,))}

    @property
    def labels(self) -> tuple[str, ...]:
        names = ((i, j + 1) for j in range(self.tableau.stages) for i in range(self.manifold.dimension))
        ends = tuple(f"momentum {i} at the start" for i in range(self.manifold.dimension))
        return tuple(f"equation {i} at node {j} in the chart" for i, j in names) + ends

    def chart(self, q) -> RetractionChart:
        """The chart at q; the step does not depend on which frame is taken there, which may not be smooth in q."""
        return RetractionChart(self.manifold, q, jax.lax.stop_gradient(self.manifold.frame(q)))

    @once
    def slopes(self, q, r, rate, params):
        """(∂ℓ/∂r, ∂ℓ/∂ṙ) in the chart at q."""
        here = self.chart(q)
        value = lambda r, rate: self.system.lagrangian(*here.velocity_to_manifold(r, rate), params)
        return gradient(value, (0, 1))(r, rate)

    def nodes(self, u, state, h, params) -> tuple[list, list, list]:
        """(Ṙ, ∂ℓ/∂r, ∂ℓ/∂ṙ) at every node."""
        q, rates = self.state.split(state).q, list(self.unknowns.split(u))[:-1]
        points = [h * combined(row, rates) for row in self.tableau.matrix.tolist()]
        found = [self.slopes(q, r, rate, params) for r, rate in zip(points, rates, strict=True)]
        return rates, [slope for slope, _ in found], [momentum for _, momentum in found]

    @once
    def end(self, u, state, h):
        """(q_1, p_1)."""
        parts = self.unknowns.split(u)
        here = self.chart(self.state.split(state).q)
        return here.momentum_to_manifold(h * combined(self.tableau.weights.tolist(), list(parts)[:-1]), parts.momentum)

    @property
    def interpolation(self):
        return self.interpolate

    def interpolate(self, theta, u, state, t, h, params):
        """r(θ) = h Σ_j ∫_0^θ ℓ_j Ṙ_j in the chart, with π(θ) = π_1 − h Σ_j ∫_θ^1 ℓ_j ∂ℓ/∂r_j."""
        rates, slopes, _ = self.nodes(u, state, h, params)
        shares, weights = self.tableau.integrals(theta), self.tableau.weights.tolist()
        left = combined([b - share for b, share in zip(weights, shares, strict=True)], slopes)
        here = self.chart(self.state.split(state).q)
        q, p = here.momentum_to_manifold(h * combined(shares, rates), self.unknowns.split(u).momentum - h * left)
        return {"q": q, "p": p}

    def residual(self, u, state, t, h, params):
        rates, slopes, momenta = self.nodes(u, state, h, params)
        weights, end = self.tableau.weights.tolist(), self.unknowns.split(u).momentum
        left = [[b - a for a, b in zip(row, weights, strict=True)] for row in self.tableau.matrix.tolist()]
        inner = [end - momentum - h * combined(row, slopes) for momentum, row in zip(momenta, left, strict=True)]
        now, (_, last) = self.state.split(state), self.end(u, state, h)
        here = self.chart(now.q)
        points = [h * combined(row, rates) for row in self.tableau.matrix.tolist()]
        arrival = h * combined(weights, rates)

        def action(s):
            """h Σ b_i L − ⟨p_1, q_1⟩ for the chart at the point with coordinates s, and the same coordinates in it."""
            base = here.to_manifold(s)
            frame = jax.vmap(lambda column: self.manifold.projection(base, column), 1, 1)(here.frame)
            there = RetractionChart(self.manifold, base, frame)
            values = [
                self.system.lagrangian(*there.velocity_to_manifold(r, v), params) for r, v in zip(points, rates, strict=True)
            ]
            return h * sum(b * value for b, value in zip(weights, values, strict=True)) - last @ there.to_manifold(arrival)

        start = here.frame.T @ now.p + gradient(action)(jnp.zeros(self.manifold.dimension))
        return jnp.concatenate([*inner, start])

    def advance(self, u, state, t, h, params):
        q, p = self.end(u, state, h)
        return self.state.join(q=q, p=p)

    def start(self, data: dict, h: Any, params: Any):
        here = self.chart(data["q"])
        rates = jnp.tile(here.components(data["v"]), self.tableau.stages)
        return self.state.join(q=data["q"], p=data["p"]), jnp.concatenate([rates, here.frame.T @ data["p"]])

    def unpack(self, state, u, t, h, params):
        return self.state.split(state)._asdict()
