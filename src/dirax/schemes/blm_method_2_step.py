"""Method 2 of [BLM] for Lagrangians with constraints: the θ map projected on the final constraint manifold M_f."""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.numerics.arrays import Data
from dirax.program.linear_solves import solve
from dirax.program.tracing import along, gradient, once
from dirax.schemes.lagrangian_step import LagrangianStep, numbered, one_point_only
from dirax.schemes.layout import Layout
from dirax.systems.nonholonomic import NonholonomicMechanics

FEW = 4
"""Coordinates up to which accelerations are solved for in place: a step of three and a constraint takes .7 of the time of one in
which they are unknowns, in batches. The Cartesian double pendulum, of four, takes .76 of it, and the turntable, of five, 1.2
times as much; Bricard's mechanism, of five and as many holonomic constraints, has 67 000 operations in place, and 20 000 else."""


@dataclass(frozen=True, eq=False)
class ThetaStep(LagrangianStep):
    """A step of Method 2 by the θ map: q = q_k + θh v, at the time t + θh."""

    theta: float

    @property
    def one_sided(self) -> bool:
        return self.theta != 0.5

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
    constraints; M = ∂²L/∂v² at (q', v). Unknowns are v, σ, the acceleration a and λ of the base point, and s and d of the first
    half, which moves q by d, where M(d/θh − v) = Gᵀs; and v', σ', s' and d' of the second. The equations of a and λ are
    (∂L/∂v)˙ = ∂L/∂q + f + [W; G]ᵀλ and ([W; G] v + …)˙ = 0 along v̇ = a: where there are few of them they are solved in place,
    else no matrix is inverted, and σ and σ' are counted from the impulses of λ in their halves, so that the balance of momenta
    hardly depends on λ. It is d and not a velocity that is unknown since derivatives by d are derivatives by q, of which many
    stand in the equations anyway. Constraints at the times t_k, t_k + θh and t_k + h hold to roundoff at all three points.
    """

    @property
    def unknowns(self) -> Layout:
        n, k, c = self.shape.n, self.rows.count, self.rows.holonomic
        moved, last = (n if count else 0 for count in (c * (not self.in_place), c))
        flow = {} if self.in_place else {"a": n, "multipliers": k}
        return Layout(v=n, sigma=k, **flow, s=c, moved=moved, end_v=n, end_sigma=k, end_s=c, end_moved=last)

    @property
    def in_place(self) -> bool:
        """Whether a and λ are functions of (q, v) and d one of (q, v, s), and no unknowns."""
        return self.shape.n <= FEW and not self.system.forces_see_multipliers

    @property
    def weak(self) -> tuple[tuple[range, range], ...]:
        """The balance of the first half by λ, whose impulse σ is counted from: what is left is the turning of the constraints."""
        if self.in_place or self.system.forces_see_multipliers:
            return ()
        n, k = self.shape.n, self.rows.count
        return ((range(n), range(2 * n + k, 2 * (n + k))),)

    def start(self, data: Data, h: Any, params: Any) -> tuple[Float[Array, " s"], Float[Array, " k"]]:
        one_point_only(data)
        v = data["v"]
        values = {"v": v, "end_v": v, "moved": self.theta * h * v, "end_moved": (1.0 - self.theta) * h * v}
        guess = self.unknowns.join(**{name: value for name, value in values.items() if self.unknowns[name] == v.shape})
        return self.book.start(data["q"], data["p"]), guess

    def residual(self, u, state, t, h, params):
        (q0, p0, _), parts, rows = self.state.split(state), self.unknowns.split(u), self.rows
        base = at, q, q1 = self._base(u, state, t, h, params)
        p, rate, along_flow, multipliers = self._flow(at, q, parts, params)
        impulses = (0.0, 0.0) if self.in_place else ((1.0 - self.theta) * h * multipliers, self.theta * h * multipliers)
        first, last = parts.sigma - impulses[0], parts.end_sigma + impulses[1]
        begun = p0 + rows.force(t, q0, first, params) - (p - (1.0 - self.theta) * h * rate)
        ended = self.system.legendre(q1, parts.end_v, params, t + h) + rows.force(t + h, q1, last, params)
        ends = [
            begun,
            rows.velocity_defect(at, q, parts.v, params),
            *along_flow,
            ended - (p + self.theta * h * rate),
            rows.velocity_defect(t + h, q1, parts.end_v, params),
        ]
        return jnp.concatenate([*ends, self._position(q0, parts, base, t, h, params)] if rows.holonomic else ends)

    def advance(self, u, state, t, h, params):
        at, q, q1 = self._base(u, state, t, h, params)
        parts = self.unknowns.split(u)
        end = [q1, self.system.legendre(q1, parts.end_v, params, t + h)]
        forces = None if self.in_place else self._forces(parts.multipliers)
        return self.book.after(state, end, at, q, parts.v, h, params, forces)

    def unpack(self, state, u, t, h, params):
        at, q, _ = self._base(u, state, t, h, params)
        return self.row(state) | {"multipliers": self.rows.all(self._flow(at, q, self.unknowns.split(u), params)[-1])}

    def _forces(self, multipliers: Array) -> Any:
        """The forces where these are the multipliers, which are those of the system with the opposite sign."""
        return self.system.forces_at(-self.rows.all(multipliers))

    def _flow(self, t: Any, q: Array, parts: Any, params: Any) -> tuple[Array, Array, tuple[Array, ...], Array]:
        """(p, ṗ, equations of a and λ, λ) at a point of M_f."""
        if self.in_place:
            p, rate, multipliers = once(self._solved)(t, q, parts.v, params)
            return p, rate, (), multipliers
        p, rate, defect = once(self._at_point)(t, q, parts.v, parts.a, parts.multipliers, params)
        return p, rate, (defect,), parts.multipliers

    def _solved(self, t: Any, q: Array, v: Array, params: Any) -> tuple[Array, Array, Array]:
        """(p, ṗ, λ) at a point of M_f, where M a = b + [W; G]ᵀλ."""
        none, rows = jnp.zeros(self.rows.count), self.rows
        p, rate, defect = self._at_point(t, q, v, jnp.zeros_like(v), none, params)
        matrix = rows.matrix(t, q, params)
        lifted = solve(
            self.system.velocity_hessian(t, q, v, params), jnp.concatenate([matrix.T, -defect[: len(v), None]], axis=1)
        )
        multipliers = -solve(matrix @ lifted[:, :-1], defect[len(v) :] + matrix @ lifted[:, -1])
        return p, rate + matrix.T @ multipliers, multipliers

    def _at_point(self, t: Any, q: Array, v: Array, a: Array, multipliers: Array, params: Any) -> tuple[Array, Array, Array]:
        """(p, ṗ, what is zero where a and λ are those of the flow) at a point of M_f."""
        rate, p = self.rates(t, q, v, params, self._forces(multipliers))
        rate = rate + self.rows.force(t, q, multipliers, params)
        turning = self._along(lambda t, q, v: self.system.legendre(q, v, params, t), t, q, v, a)
        drift = self._along(lambda t, q, v: self.rows.velocity_defect(t, q, v, params), t, q, v, a)
        return p, rate, jnp.concatenate([turning - rate, drift])

    def _along(self, function: Any, t: Any, q: Array, v: Array, a: Array) -> Array:
        """The derivative of function(t, q, v) along q̇ = v, v̇ = a, ṫ = 1."""
        if self.system.depends_on_time:
            return along(function, (jnp.asarray(t, float), q, v), (jnp.ones(()), v, a))
        return along(lambda q, v: function(t, q, v), (q, v), (v, a))

    def _first(self, t: Any, q: Array, parts: Any, h: Any, params: Any) -> Float[Array, " n"]:
        """d of the first half, which is θh (v + M⁻¹G(q_k)ᵀs)."""
        if not self.in_place:
            return parts.moved
        if not self.theta:
            return jnp.zeros_like(parts.v)
        pushed = solve(self.system.velocity_hessian(t, q, parts.v, params), self.rows.holonomic_force(t, q, parts.s, params))
        return self.theta * h * (parts.v + pushed)

    def _pushed(self, t: Any, q: Array, v: Array, moved: Array, part: Any, s: Array, params: Any) -> Float[Array, " n"]:
        """M(d/part − v) − G(q)ᵀs, zero where d is along the projection onto g = 0 at q; `part` of time is that of the half, and
        d is zero where there is none."""
        if isinstance(part, float) and not part:
            return moved
        change = along(lambda v: self.system.legendre(q, v, params, t), (v,), (moved / part - v,))
        return change - self.rows.holonomic_force(t, q, s, params)

    def _base(self, u: Array, state: Array, t: Any, h: Any, params: Any) -> tuple[Any, Array, Array]:
        """The time of the base point, the base point, and where the second half ends."""
        q0, parts, halves = self.state.split(state).q, self.unknowns.split(u), (self.theta * h, (1.0 - self.theta) * h)
        if not self.rows.holonomic:
            first, second = (half * parts.v for half in halves)
        else:
            first, second = self._first(t, q0, parts, h, params), parts.end_moved
        return t + halves[0], q0 + first, q0 + first + second

    def _position(self, q0: Array, parts: Any, base: tuple[Any, Array, Array], t: Any, h: Any, params: Any) -> Array:
        """g at the base and at the end, and the directions of both halves; a half of length zero needs no force."""
        (at, q, q1), rows = base, self.rows
        onto = rows.position(at, q, params) / h if self.theta else parts.s
        last = rows.position(t + h, q1, params) / h if self.theta < 1.0 else parts.end_s
        first, second = (part and part * h for part in (self.theta, 1.0 - self.theta))
        begun = [] if self.in_place else [self._pushed(t, q0, parts.v, parts.moved, first, parts.s, params)]
        ended = self._pushed(t + h, q1, parts.v, parts.end_moved, second, parts.end_s, params)
        return jnp.concatenate([onto, *begun, ended, last])
