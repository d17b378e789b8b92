"""Method 2 of [BLM] for Lagrangians with constraints: the θ map projected on the final constraint manifold M_f."""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.numerics.arrays import Data
from dirax.program.linear_solves import solve
from dirax.program.tracing import along, gradient, jacobian, once
from dirax.schemes.lagrangian_step import LagrangianStep, numbered, one_point_only
from dirax.schemes.layout import Layout
from dirax.systems.nonholonomic import NonholonomicMechanics


@dataclass(frozen=True, eq=False)
class ThetaStep(LagrangianStep):
    """A step of Method 2 by the θ map: q = q_k + θh v, at the time t + θh."""

    theta: float

    @property
    def labels(self) -> tuple[str, ...]:
        return numbered(self.unknowns.size)


@dataclass(frozen=True, eq=False)
class NonholonomicStep(ThetaStep):
    """Method 2 for a metric, potential and one-forms ([BLM] (39)–(43)), with the closed form of λ and of the projector.

    Unknowns are the base point as (v, p-multiplier σ) with p = g(q) v: q_k = q − θh v,
    p_k + μ(q_k)ᵀσ = p − (1 − θ)h ṗ, μ(q) v = 0; then q_{k+1} = q + (1 − θ)h v, p_{k+1} = P(p + θh ṗ).
    """

    system: NonholonomicMechanics

    @property
    def unknowns(self) -> Layout:
        return Layout(v=self.shape.n, sigma=self.shape.m)

    def start(self, data: Data, h: Any, params: Any) -> tuple[Float[Array, " s"], Float[Array, " k"]]:
        one_point_only(data)
        return self.book.start(data["q"], data["p"]), self.unknowns.join(v=data["v"])

    def residual(self, u, state, t, h, params):
        parts, (v, sigma) = self.state.split(state), self.unknowns.split(u)
        q, p, force, _ = self._base(u, state, h, params)
        balance = parts.p + self._forms(parts.q, params).T @ sigma - (p - (1.0 - self.theta) * h * force)
        return jnp.concatenate([balance, self._forms(q, params) @ v])

    def advance(self, u, state, t, h, params):
        q, p, force, _ = self._base(u, state, h, params)
        q1 = q + (1.0 - self.theta) * h * self.unknowns.split(u).v
        return self.state.join(q=q1, p=self.system.projector(q1, p + self.theta * h * force, params))

    def unpack(self, state, u, t, h, params):
        return self.row(state) | {"multipliers": self._base(u, state, h, params)[3]}

    def _forms(self, q: Array, params: Any) -> Float[Array, "m n"]:
        return self.system.constraints.one_forms_at(0.0, q, params)

    def _base(self, u: Array, state: Array, h: Any, params: Any) -> tuple[Array, Array, Array, Array]:
        return once(self._at_base)(u, state, h, params)

    def _at_base(self, u: Array, state: Array, h: Any, params: Any) -> tuple[Array, Array, Array, Array]:
        """(q, p, ṗ, λ) at the base point. With v at hand the metric is inverted once, and its inverse never differentiated."""
        system, v = self.system, self.unknowns.split(u).v
        q = self.state.split(state).q + self.theta * h * v
        metric, forms = system.metric.at(0.0, q, params), self._forms(q, params)
        turning = along(lambda q: system.metric.at(0.0, q, params), (q,), (v,))
        drift = along(lambda q: self._forms(q, params), (q,), (v,))
        rate = gradient(lambda q: system.lagrangian(q, v, params))(q)  # −∂H/∂q at p = g v
        solved = solve(metric, jnp.concatenate([forms.T, (rate - turning @ v)[:, None]], axis=1))
        lifted, force = solved[:, : self.shape.m], solved[:, self.shape.m]
        multipliers = -solve(forms @ lifted, drift @ v + forms @ force)  # (μ v)˙ = 0
        return q, metric @ v, rate + forms.T @ multipliers, multipliers


@dataclass(frozen=True, eq=False)
class ProjectedThetaStep(ThetaStep):
    """Method 2 for any regular Lagrangian: the projected θ map ([BLM] Prop 7.3) on M_f = {g = 0, W v + b = 0, G v + ∂g/∂t = 0}.

    At the base point (q, v) ∈ M_f, λ follows from the derivatives of the last two along the flow, and with p = ∂L/∂v, ṗ

        (q_k, p_k) = P(q − θh v, p − (1 − θ)h ṗ),   (q_{k+1}, p_{k+1}) = P(q + (1 − θ)h v, p + θh ṗ),

    P(q̃, p̃) = (q', p'): q̃ = q' + M⁻¹G(q')ᵀs with g(q') = 0, and p̃ = p' + [W; G](q')ᵀσ with the velocity of p' on the other
    constraints; M = ∂²L/∂v² at (q', v). Unknowns are (v, σ, s) of the first half and (v', σ', w, s') of the second, where h w
    moves q and M(w − v) = Gᵀs'. Constraints at the times t_k, t_k + θh and t_k + h hold to roundoff at all three points.
    """

    @property
    def unknowns(self) -> Layout:
        n, k, c = self.shape.n, self.rows.count, self.rows.holonomic
        return Layout(v=n, sigma=k, s=c, end_v=n, end_sigma=k, w=n if c else 0, end_s=c)

    def start(self, data: Data, h: Any, params: Any) -> tuple[Float[Array, " s"], Float[Array, " k"]]:
        one_point_only(data)
        v = data["v"]
        guess = self.unknowns.join(v=v, end_v=v, **({"w": v} if self.rows.holonomic else {}))
        return self.book.start(data["q"], data["p"]), guess

    def residual(self, u, state, t, h, params):
        (q0, p0, _), parts, rows = self.state.split(state), self.unknowns.split(u), self.rows
        at, q, q1 = self._base(u, state, t, h, params)
        p, rate, _ = self._flow(at, q, parts.v, params)
        begun = p0 + rows.force(t, q0, parts.sigma, params) - (p - (1.0 - self.theta) * h * rate)
        ended = self.system.legendre(q1, parts.end_v, params, t + h) + rows.force(t + h, q1, parts.end_sigma, params)
        ends = [
            begun,
            rows.velocity_defect(at, q, parts.v, params),
            ended - (p + self.theta * h * rate),
            rows.velocity_defect(t + h, q1, parts.end_v, params),
        ]
        return jnp.concatenate([*ends, self._position(u, state, t, h, params)] if rows.holonomic else ends)

    def advance(self, u, state, t, h, params):
        at, q, q1 = self._base(u, state, t, h, params)
        parts = self.unknowns.split(u)
        end = [q1, self.system.legendre(q1, parts.end_v, params, t + h)]
        return self.book.after(state, end, at, q, parts.v, h, params)

    def unpack(self, state, u, t, h, params):
        at, q, _ = self._base(u, state, t, h, params)
        multipliers = self.rows.all(self._flow(at, q, self.unknowns.split(u).v, params)[2])
        return self.row(state) | {"multipliers": multipliers}

    def _mass(self, t: Any, q: Array, v: Array, params: Any) -> Float[Array, "n n"]:
        return jacobian(gradient(lambda v: self.system.lagrangian.at(t, q, v, params)))(v)

    def _flow(self, t: Any, q: Array, v: Array, params: Any) -> tuple[Array, Array, Array]:
        return once(self._at_point)(t, q, v, params)

    def _at_point(self, t: Any, q: Array, v: Array, params: Any) -> tuple[Array, Array, Array]:
        """(p, ṗ, λ) at a point of M_f."""
        rate, p = self.rates(t, q, v, params)
        w = self.rows.matrix(t, q, params)
        coupling = self.along_flow(lambda t, q: self.system.legendre(q, v, params, t), t, q, v)
        turning = self.along_flow(lambda t, q: self.rows.velocity_defect(t, q, v, params), t, q, v)
        lifted = solve(self._mass(t, q, v, params), w.T)
        multipliers = -solve(w @ lifted, turning + lifted.T @ (rate - coupling))
        return p, rate + w.T @ multipliers, multipliers

    def _pushed(self, t: Any, q: Array, v: Array, s: Array, params: Any) -> Float[Array, " n"]:
        """v + M⁻¹G(q)ᵀs, the direction of the projection onto g = 0 at q."""
        return v + solve(self._mass(t, q, v, params), self.rows.holonomic_force(t, q, s, params))

    def _base(self, u: Array, state: Array, t: Any, h: Any, params: Any) -> tuple[Any, Array, Array]:
        """The time of the base point, the base point, and where the second half ends."""
        q0, parts, theta = self.state.split(state).q, self.unknowns.split(u), self.theta
        v, at = parts.v, t + theta * h
        if not self.rows.holonomic:
            return at, q0 + theta * h * v, q0 + h * v
        q = q0 + (theta * h * self._pushed(t, q0, v, parts.s, params) if theta else 0.0)
        return at, q, q + (1.0 - theta) * h * parts.w

    def _position(self, u: Array, state: Array, t: Any, h: Any, params: Any) -> Array:
        """g at the base and at the end, and the direction of the second half; a half of length zero needs no force."""
        at, q, q1 = self._base(u, state, t, h, params)
        parts = self.unknowns.split(u)
        onto = self.rows.position(at, q, params) / h if self.theta else parts.s
        last = self.rows.position(t + h, q1, params) / h if self.theta < 1.0 else parts.end_s
        return jnp.concatenate([onto, parts.w - self._pushed(t + h, q1, parts.v, parts.end_s, params), last])
