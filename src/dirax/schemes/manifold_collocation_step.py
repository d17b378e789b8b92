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
    """The Gauss method for (r, p_r) in the chart φ at q_k that is compatible with the manifold's retraction, from r = 0, with

        ℓ(r, ṙ) = L(φ⁻¹(r), Dφ⁻¹(r) ṙ),   R_i = h Σ_j a_ij Ṙ_j,   ∂ℓ/∂ṙ(R_i, Ṙ_i) = p_r + h Σ_j a_ij ∂ℓ/∂r(R_j, Ṙ_j).

    Symplectic on T*Q, of order 2s, and q_{k+1} = φ⁻¹(r_1) lies on the manifold. State (q, p) in R^N, unknowns the Ṙ_i.
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
        return Layout(**{f"rate_{i + 1}": self.manifold.dimension for i in range(self.tableau.stages)})

    @property
    def fields(self) -> dict[str, Field]:
        return {"q": Field((self.size,)), "p": Field((self.size,))}

    @property
    def labels(self) -> tuple[str, ...]:
        names = ((i, j + 1) for j in range(self.tableau.stages) for i in range(self.manifold.dimension))
        return tuple(f"equation {i} at node {j} in the chart" for i, j in names)

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
        q, rates = self.state.split(state).q, list(self.unknowns.split(u))
        points = [h * combined(row, rates) for row in self.tableau.matrix.tolist()]
        found = [self.slopes(q, r, rate, params) for r, rate in zip(points, rates, strict=True)]
        return rates, [slope for slope, _ in found], [momentum for _, momentum in found]

    def momentum(self, state):
        """p_r at r = 0."""
        q, p = self.state.split(state)
        return self.chart(q).frame.T @ p

    def residual(self, u, state, t, h, params):
        _, slopes, momenta = self.nodes(u, state, h, params)
        start = self.momentum(state)
        given = [start + h * combined(row, slopes) for row in self.tableau.matrix.tolist()]
        return jnp.concatenate([a - b for a, b in zip(given, momenta, strict=True)])

    def advance(self, u, state, t, h, params):
        rates, slopes, _ = self.nodes(u, state, h, params)
        weights, here = self.tableau.weights.tolist(), self.chart(self.state.split(state).q)
        q, p = here.momentum_to_manifold(h * combined(weights, rates), self.momentum(state) + h * combined(weights, slopes))
        return self.state.join(q=q, p=p)

    def start(self, data: dict, h: Any, params: Any):
        here = self.chart(data["q"])
        return self.state.join(q=data["q"], p=data["p"]), jnp.tile(here.components(data["v"]), self.tableau.stages)

    def guess(self, state, previous, h, params):
        """The same: rates in the chart before, which differs from this one by its frame, say more than none."""
        return previous

    def unpack(self, state, u, t, h, params):
        return self.state.split(state)._asdict()
