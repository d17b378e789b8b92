"""Method 2 of [BLM] for Lagrangians with constraints by the cotangent lift of any discretization map on Q, projected."""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.numerics.arrays import Data
from dirax.program.linear_solves import solve
from dirax.program.tracing import gradient, jacobian, once
from dirax.schemes.lagrangian_step import LagrangianStep, numbered, one_point_only
from dirax.schemes.layout import Layout
from dirax.schemes.map_lift import Base, Lift


@dataclass(frozen=True, eq=False)
class ProjectedLiftStep(LagrangianStep):
    """The projected lift ([BLM] Prop 7.3) on M_f = {g = 0, W v + b = 0, G v + ∂g/∂t = 0} of a regular Lagrangian.

    At the base point (q, v) ∈ M_f, λ follows from the derivatives of the last two along the flow, and with p = ∂L/∂v, ṗ

        (q_k, p_k) = P(q̃0, p̃0),   (q_{k+1}, p_{k+1}) = P(q̃1, p̃1),   (−p̃0, p̃1) = DB(q̃0, q̃1)ᵀ (h ṗ, p),

    P(q̃, p̃) = (q', p'): q̃ lies in the direction h M⁻¹G(q')ᵀs from q' with g(q') = 0, and p̃ = p' + [W; G](q')ᵀσ with the
    velocity of p' on the other constraints; M = ∂²L/∂v² on the tangent space at q'. Unknowns are the velocity from q̃0 to q̃1,
    σ and s of the first half, and v', σ' of the second, with the velocity w from q_k to q_{k+1} and s' for holonomic constraints.
    """

    lift: Lift

    @property
    def unknowns(self) -> Layout:
        d, k, c = self.lift.dimension, self.rows.count, self.rows.holonomic
        return Layout(velocity=d, sigma=k, s=c, end_v=d, end_sigma=k, w=d if c else 0, end_s=c)

    @property
    def canonical(self) -> bool:
        return self.lift.flat and super().canonical

    @property
    def labels(self) -> tuple[str, ...]:
        return numbered(self.unknowns.size)

    def start(self, data: Data, h: Any, params: Any) -> tuple[Float[Array, " s"], Float[Array, " k"]]:
        one_point_only(data)
        v = self.lift.components(data["q"], data["v"])
        guess = self.unknowns.join(velocity=v, end_v=v, **({"w": v} if self.rows.holonomic else {}))
        return self.book.start(data["q"], data["p"]), guess

    def residual(self, u, state, t, h, params):
        (q0, p0, _), parts, rows, lift = self.state.split(state), self.unknowns.split(u), self.rows, self.lift
        at = self._base(u, state, t, h, params)
        q1 = self._end(u, state, at, h)
        p, rate, _ = self._flow(q0, at.t, at.q, at.v, params)
        minus_p0, p1 = lift.lifted(at, h * rate, p)
        begun = p0 + rows.force(t, q0, parts.sigma, params) + minus_p0
        v1 = lift.tangents(q0, q1) @ parts.end_v
        momentum = self.rates(t + h, q1, v1, params)[1] + rows.force(t + h, q1, parts.end_sigma, params)
        # a velocity from a difference of points has their roundoff by h: what p misses of the first balance is added to p̃1
        equations = [
            lift.paired(q0, begun),
            rows.velocity_defect(at.t, at.q, at.v, params),
            lift.tangents(q0, q1).T @ (momentum - p1 - lift.tangential(q0, begun)),
            rows.velocity_defect(t + h, q1, v1, params),
        ]
        if rows.holonomic:
            missed = lift.tangents(q0, at.q1).T @ (self._pushed(t + h, q1, v1, parts.end_s, h, params) - at.q1) / h
            equations += [rows.position(at.t, at.q, params) / h, missed, rows.position(t + h, q1, params) / h]
        return jnp.concatenate(equations)

    def advance(self, u, state, t, h, params):
        at = self._base(u, state, t, h, params)
        q1 = self._end(u, state, at, h)
        v1 = self.lift.tangents(self.state.split(state).q, q1) @ self.unknowns.split(u).end_v
        p1 = self.lift.tangential(q1, self.rates(t + h, q1, v1, params)[1])
        return self.book.after(state, [q1, p1], at.t, at.q, at.v, h, params)

    def unpack(self, state, u, t, h, params):
        at = self._base(u, state, t, h, params)
        multipliers = self._flow(self.state.split(state).q, at.t, at.q, at.v, params)[2]
        return self.row(state) | {"multipliers": self.rows.all(multipliers)}

    def _mass(self, t: Any, q: Array, v: Array, params: Any) -> Float[Array, "N N"]:
        return jacobian(gradient(lambda v: self.system.lagrangian.at(t, q, v, params)))(v)

    def _flow(self, q0: Array, t: Any, q: Array, v: Array, params: Any) -> tuple[Array, Array, Array]:
        return once(self._at_point)(q0, t, q, v, params)

    def _at_point(self, q0: Array, t: Any, q: Array, v: Array, params: Any) -> tuple[Array, Array, Array]:
        """(p, ṗ, λ) at a point of M_f: M v̇ and [W; G] v̇ with v̇ = F a + its normal part, F tangent vectors at q."""
        rate, p = self.rates(t, q, v, params)
        w, hessian, frame = self.rows.matrix(t, q, params), self._mass(t, q, v, params), self.lift.tangents(q0, q)
        coupling = self.along_flow(lambda t, q: self.rates(t, q, v, params)[1], t, q, v)
        turning = self.along_flow(lambda t, q: self.rows.velocity_defect(t, q, v, params), t, q, v)
        if not self.lift.flat:
            normal = self.lift.turning(q, v)
            coupling, turning = coupling + hessian @ normal, turning + w @ normal
        w_tangent = w @ frame
        lifted = solve(frame.T @ hessian @ frame, w_tangent.T)
        multipliers = -solve(w_tangent @ lifted, turning + lifted.T @ (frame.T @ (rate - coupling)))
        return p, rate + w.T @ multipliers, multipliers

    def _pushed(self, t: Any, q: Array, v: Array, s: Array, h: Any, params: Any) -> Float[Array, " N"]:
        """q + h M⁻¹G(q)ᵀs, on the manifold."""
        frame = self.lift.frame(q)
        mass, force = self._mass(t, q, v, params), self.rows.holonomic_force(t, q, s, params)
        return self.lift.end(q, h * solve(frame.T @ mass @ frame, frame.T @ force))

    def _base(self, u: Array, state: Array, t: Any, h: Any, params: Any) -> Base:
        """The base point of the step from q̃0 to q̃1."""
        q0, parts = self.state.split(state).q, self.unknowns.split(u)
        v0 = self.lift.frame(q0) @ parts.velocity
        begun = self._pushed(t, q0, v0, parts.s, h, params) if self.rows.holonomic else q0
        return self.lift.base(begun, self.lift.end(q0, h * parts.velocity), t, h)

    def _end(self, u: Array, state: Array, at: Base, h: Any) -> Float[Array, " N"]:
        """q_{k+1}."""
        if not self.rows.holonomic:
            return at.q1
        return self.lift.end(self.state.split(state).q, h * self.unknowns.split(u).w)
