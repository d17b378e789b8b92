"""One step of a Gauss method on a manifold: collocation in the chart at the point that the step leaves."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from dirax.geometry.manifolds import AbstractManifold
from dirax.program.legendre import constrained_velocity
from dirax.program.linear_solves import solve
from dirax.program.tracing import gradient, jacobian, once, value_along
from dirax.schemes.abstract_step import AbstractStep
from dirax.schemes.collocation_tables import Tableau
from dirax.schemes.labels import Labels
from dirax.schemes.layout import Layout
from dirax.schemes.step import Field
from dirax.systems.manifold_lagrangian import ManifoldLagrangian

NEAR = 0.5
"""How far the mean of extrapolated rates may be from the velocity at the start of the step, relative to this."""


@dataclass(frozen=True, eq=False)
class ManifoldCollocation(AbstractStep):
    """The discrete Euler–Lagrange equations of the Galerkin discrete Lagrangian in the chart φ at q_0 whose points are those of
    the manifold that are nearest to points of the tangent space, φ⁻¹(r) = nearest(q_0 + F r) with a basis F of it,

        L_d(q_0, q_1) = ext h Σ_i b_i L(φ⁻¹(R_i), Dφ⁻¹(R_i) Ṙ_i),   R_i = h Σ_j a_ij Ṙ_j,   q_1 = φ⁻¹(h Σ_i b_i Ṙ_i).

    With ℓ for L in the chart, the extremum is π_1 = ∂ℓ/∂ṙ_i + h Σ_j (b_j − a_ij) ∂ℓ/∂r_j at every node, where π_1 are the
    components of p_1 in the chart. The chart moves with q_0, which makes the map symplectic on T*Q: with σ the coordinates of
    the point that it is moved to, p_0 = −D1 L_d says that ⟨p_1, ∂q_1/∂σ⟩ is p_0 + h Σ_i b_i ∂ℓ_i/∂σ, which gives p_1 and π_1.
    Only the space of curves counts in L_d, and not which basis a moved chart has: it is F, projected to the tangent space there.
    All derivatives of L are taken once a node, in R^N. Order 2s; q_1 lies on the manifold. State (q, p) in R^N, unknowns the Ṙ_i.
    """

    tableau: Tableau
    system: ManifoldLagrangian
    size: int

    @property
    def manifold(self) -> AbstractManifold:
        return self.system.manifold

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
    def labels(self) -> Labels:
        numbered = (
            Labels.numbered(f"equation {{}} at node {j + 1} in the chart", self.manifold.dimension)
            for j in range(self.tableau.stages)
        )
        return sum(numbered, Labels())

    def frame(self, q):
        """The basis F (N, d) of the tangent space at q in which its chart has coordinates. The step does not depend on it, and it
        may not be smooth: fixed vectors, whose projections turn with the tangent space, on which the chart does depend."""
        fixed = jax.lax.stop_gradient(self.manifold.frame(q))
        return jax.vmap(lambda f: self.manifold.projection(q, f), 1, 1)(fixed)

    @once
    def slopes(self, point, velocity, params):
        """(∂/∂z, ∂/∂ż) of L at the point of the manifold nearest to z, with the velocity that this has."""
        value = lambda z, w: self.system.lagrangian(*value_along(self.manifold.nearest, (z,), (w,)), params)
        return gradient(value, (0, 1))(point, velocity)

    @once
    def arrival(self, q, frame, r, momentum):
        """(q_1, p_1, π_1): the point with coordinates r, and the covector p_1 there with ⟨p_1, ∂q_1/∂σ⟩ = `momentum`."""
        nearest, along = self.manifold.nearest, frame @ r
        from_moved = lambda shift: nearest(q + frame @ shift + self.manifold.projection(q + frame @ shift, along))
        by_shift = jacobian(from_moved)(jnp.zeros_like(r))
        by_r = jacobian(lambda r: nearest(q + frame @ r))(r)
        p = by_r @ solve(by_shift.T @ by_r, momentum, apart=True)
        return nearest(q + along), p, by_r.T @ p

    @once
    def nodes(self, u, state, h, params) -> tuple[Any, Any, tuple]:
        """∂L/∂z (s, N) at the nodes, ∂L/∂ż + h Σ_j (b_j − a_ij) ∂L/∂z (s, N), and (q_1, p_1, π_1)."""
        (q, p), rates = self.state.split(state), u.reshape(self.tableau.stages, -1)
        frame, weights, matrix = self.frame(q), self.tableau.weights, self.tableau.matrix
        velocities = rates @ frame.T
        leaps = h * (matrix @ velocities)
        by_point, by_rate = jax.vmap(self.slopes, (0, 0, None))(q[None] + leaps, velocities, params)
        momenta = by_rate + h * ((weights - matrix) @ by_point)

        def turned(base):
            """h Σ_i b_i ∂ℓ_i/∂σ but for what moves the base: b_i a_ij = b_j (b_i − a_ji) takes ∂L/∂z into the momenta."""
            carried = jax.vmap(lambda velocity: self.manifold.projection(base, velocity))(velocities)
            return weights @ jnp.sum(momenta * carried, axis=1)

        momentum = (p + h * (weights @ by_point + gradient(turned)(q))) @ frame
        return by_point, momenta, self.arrival(q, frame, h * (weights @ rates), momentum)

    @property
    def interpolation(self):
        return self.interpolate

    def interpolate(self, theta, u, state, t, h, params):
        """r(θ) = h Σ_j ∫_0^θ ℓ_j Ṙ_j in the chart, with π(θ) = π_1 − h Σ_j ∫_θ^1 ℓ_j ∂ℓ/∂r_j."""
        q = self.state.split(state).q
        frame, shares = self.frame(q), jnp.stack(self.tableau.integrals(theta))
        by_point, _, (_, _, end) = self.nodes(u, state, h, params)
        point, r = lambda r: self.manifold.nearest(q + frame @ r), h * (shares @ u.reshape(self.tableau.stages, -1))
        by_r, left = jacobian(point)(r), (self.tableau.weights - shares) @ by_point
        return {"q": point(r), "p": by_r @ solve(by_r.T @ by_r, end - h * left @ frame)}

    def residual(self, u, state, t, h, params):
        _, momenta, (_, _, end) = self.nodes(u, state, h, params)
        return (end[None] - momenta @ self.frame(self.state.split(state).q)).reshape(-1)

    def advance(self, u, state, t, h, params):
        _, _, (q, p, _) = self.nodes(u, state, h, params)
        return self.state.join(q=q, p=p)

    def start(self, data: dict, h: Any, params: Any):
        frame = self.frame(data["q"])
        local = (data["v"] @ frame) / jnp.sum(frame**2, axis=0)  # frames of all manifolds have orthogonal columns
        return self.state.join(q=data["q"], p=data["p"]), jnp.tile(local, self.tableau.stages)

    def guess(self, state, previous, h, params):
        """The unknowns extrapolated from the steps before; where they are far from the velocity that belongs to p, because the
        frame has jumped, this velocity at all nodes."""
        q, p = self.state.split(state)
        frame, rates = self.frame(q), previous.reshape(self.tableau.stages, -1)
        none = jnp.zeros((0, self.manifold.dimension)), jnp.zeros(0)
        of_rate = lambda rate: self.system.lagrangian(q, frame @ rate, params)
        here, _ = constrained_velocity(of_rate, p @ frame, *none, jnp.zeros(self.manifold.dimension))
        apart = self.tableau.weights @ rates - here
        near = jnp.sum(apart**2) <= NEAR**2 * jnp.sum(here**2)
        return jnp.where(near, previous, jnp.tile(here, self.tableau.stages))

    def unpack(self, state, u, t, h, params):
        return self.state.split(state)._asdict()
