"""Methods 1 and 2 of [BLM] for Lagrangians with constraints: the cotangent-lifted θ map on S_0, and the projected map on M_f."""

from typing import Any

import jax.numpy as jnp

from dirax.program.linear_solves import solve
from dirax.program.tracing import along, gradient, jacobian, once
from dirax.schemes.constraint_rows import ConstraintRows
from dirax.schemes.step import Field, Shape, StepEquation
from dirax.schemes.work_of_forces import WorkOfForces
from dirax.systems.lagrange_dirac import LagrangeDirac
from dirax.systems.manifold_lagrangian import ManifoldLagrangian
from dirax.systems.nonholonomic import NonholonomicMechanics


def rates(system: LagrangeDirac | ManifoldLagrangian, t, q, v, params):
    """(∂L/∂q + f, ∂L/∂v) at (t, q, v)."""
    dq, dv = gradient(lambda q, v: system.lagrangian.at(t, q, v, params), (0, 1))(q, v)
    return (dq if system.forces is None else dq + system.forces(t, q, v, params)), dv


def lagrangian_fields(system: Any, n: int, k: int) -> dict[str, Field]:
    """What a run in (q, p) with k multipliers saves."""
    fields = {"q": Field((n,)), "p": Field((n,))}
    if k:
        fields["multipliers"] = Field((k,), "step", ("constraint",), "Lagrange multipliers of the constraints")
    return fields | WorkOfForces(system, n).fields


def discretized_lagrangian(system: LagrangeDirac, shape: Shape, theta: float) -> StepEquation:
    """Method 1: the cotangent lift of the θ map on p = ∂L/∂q̇, ṗ = ∂L/∂q + f + Wᵀλ, W q̇ + b = 0 ([BLM] §6, (36)–(38)).

    With q = q_k + θh q̇ and p = p_k + (1 − θ)h ṗ the base point, at time t_k + θh, unknowns are (q̇, λ). For θ = ½ and no
    constraints these are the discrete Euler–Lagrange equations of the midpoint L_d, also for degenerate L. Of holonomic
    constraints the Dirac structure has their distribution, G q̇ + ∂g/∂t = 0 at the base point: θ = ½ keeps quadratic g.
    """
    n, rows = shape.n, ConstraintRows(system, shape)
    k, book = rows.count, WorkOfForces(system, n)

    def base(u, state, t, h, params):
        q, v = state[:n] + theta * h * u[:n], u[:n]
        rate, momentum = rates(system, t + theta * h, q, v, params)
        return (q, rate + rows.matrix(t + theta * h, q, params).T @ u[n:], momentum) if k else (q, rate, momentum)

    def residual(u, state, t, h, params):
        p0, v = state[n : 2 * n], u[:n]
        q, rate, momentum = base(u, state, t, h, params)
        balance = p0 + (1.0 - theta) * h * rate - momentum
        return jnp.concatenate([balance, rows.velocity_defect(t + theta * h, q, v, params)]) if k else balance

    def advance(u, state, t, h, params):
        q0, v = state[:n], u[:n]
        q, rate, momentum = base(u, state, t, h, params)
        # p1 = p0 + h ṗ, written from the base point so that p keeps to the image of the Legendre transform
        return book.after(state, [q0 + h * v, momentum + theta * h * rate], t + theta * h, q, v, h, params)

    def unpack(state, u, t, h, params):
        row = {"q": state[:n], "p": state[n : 2 * n]}
        return book.row(state) | row | ({"multipliers": rows.all(u[n:])} if shape.m + shape.c else {})

    def start(data, h, params):
        if "q0" not in data:
            return book.start(data["q"], data["p"]), jnp.concatenate([data["v"], jnp.zeros(k)])
        if k:
            raise ValueError("with constraints this scheme starts from q= with v= or p=, not from two points.")
        q0, v = data["q0"], (data["q1"] - data["q0"]) / h
        _, rate, momentum = base(v, q0, data.get("t", 0.0), h, params)
        return book.start(q0, momentum - (1.0 - theta) * h * rate), v

    return StepEquation(
        start=start,
        residual=residual,
        advance=advance,
        unpack=unpack,
        state_size=2 * n + book.size,
        unknowns=n + k,
        fields=lagrangian_fields(system, n, shape.m + shape.c),
        labels=tuple(f"momentum balance {i}" for i in range(n)) + tuple(f"constraint {r} at the base point" for r in rows.kept),
        canonical=not book.size,
    )


def resolved_nonholonomic(system: NonholonomicMechanics, shape: Shape, theta: float) -> StepEquation:
    """Method 2 for a metric, potential and one-forms ([BLM] (39)–(43)), with the closed form of λ and of the projector.

    Unknowns are the base point as (v, p-multiplier σ) with p = g(q) v: q_k = q − θh v,
    p_k + μ(q_k)ᵀσ = p − (1 − θ)h ṗ, μ(q) v = 0; then q_{k+1} = q + (1 − θ)h v, p_{k+1} = P(p + θh ṗ).
    """
    n, m = shape.n, shape.m
    one_forms = lambda q, params: system.constraints.one_forms_at(0.0, q, params)

    def base(u, state, h, params):
        return once(at_base)(u, state, h, params)

    def at_base(u, state, h, params):
        """(q, p, ṗ, λ) at the base point. With v at hand the metric is inverted once, and its inverse never differentiated."""
        q, v = state[:n] + theta * h * u[:n], u[:n]
        metric, forms = system.metric.at(0.0, q, params), one_forms(q, params)
        turning = along(lambda q: system.metric.at(0.0, q, params), (q,), (v,))
        drift = along(lambda q: one_forms(q, params), (q,), (v,))
        rate = gradient(lambda q: system.lagrangian(q, v, params))(q)  # −∂H/∂q at p = g v
        solved = solve(metric, jnp.concatenate([forms.T, (rate - turning @ v)[:, None]], axis=1))
        multipliers = -solve(forms @ solved[:, :m], drift @ v + forms @ solved[:, m])  # (μ v)˙ = 0
        return q, metric @ v, rate + forms.T @ multipliers, multipliers

    def residual(u, state, t, h, params):
        q0, p0 = state[:n], state[n:]
        q, p, force, _ = base(u, state, h, params)
        balance = p0 + one_forms(q0, params).T @ u[n:] - (p - (1.0 - theta) * h * force)
        return jnp.concatenate([balance, one_forms(q, params) @ u[:n]])

    def advance(u, state, t, h, params):
        q, p, force, _ = base(u, state, h, params)
        q1 = q + (1.0 - theta) * h * u[:n]
        return jnp.concatenate([q1, system.projector(q1, p + theta * h * force, params)])

    def unpack(state, u, t, h, params):
        *_, multipliers = base(u, state, h, params)
        return {"q": state[:n], "p": state[n:], "multipliers": multipliers}

    first_guess = lambda data: jnp.concatenate([data["v"], jnp.zeros(m)])
    return _resolved(system, shape, n + m, residual, advance, unpack, first_guess)


def resolved_lagrangian(system: LagrangeDirac, shape: Shape, theta: float) -> StepEquation:
    """Method 2 for any regular Lagrangian: the projected θ map ([BLM] Prop 7.3) on M_f = {g = 0, W v + b = 0, G v + ∂g/∂t = 0}.

    At the base point (q, v) ∈ M_f, λ follows from the derivatives of the last two along the flow, and with p = ∂L/∂v, ṗ

        (q_k, p_k) = P(q − θh v, p − (1 − θ)h ṗ),   (q_{k+1}, p_{k+1}) = P(q + (1 − θ)h v, p + θh ṗ),

    P(q̃, p̃) = (q', p'): q̃ = q' + M⁻¹G(q')ᵀs with g(q') = 0, and p̃ = p' + [W; G](q')ᵀσ with the velocity of p' on the other
    constraints; M = ∂²L/∂v² at (q', v). Unknowns are (v, σ, s) of the first half and (v', σ, w, s) of the second, where h w
    moves q and M(w − v) = Gᵀs. Constraints at the times t_k, t_k + θh and t_k + h hold to roundoff at all three points.
    """
    n, rows = shape.n, ConstraintRows(system, shape)
    k, c, book = n + rows.count, rows.holonomic, WorkOfForces(system, shape.n)
    first, second = k + c, (k + n + c) if c else k

    def mass(t, q, v, params):
        return jacobian(gradient(lambda v: system.lagrangian.at(t, q, v, params)))(v)

    def flow(t, q, v, params):
        return once(at_point)(t, q, v, params)

    def at_point(t, q, v, params):
        """(p, ṗ, λ) at a point of M_f."""
        rate, p = rates(system, t, q, v, params)
        w = rows.matrix(t, q, params)
        coupling = _along(system, lambda t, q: system.legendre(q, v, params, t), t, q, v)
        turning = _along(system, lambda t, q: rows.velocity_defect(t, q, v, params), t, q, v)
        lifted = solve(mass(t, q, v, params), w.T)
        multipliers = -solve(w @ lifted, turning + lifted.T @ (rate - coupling))
        return p, rate + w.T @ multipliers, multipliers

    def pushed(t, q, v, s, params):
        """v + M⁻¹G(q)ᵀs, the direction of the projection onto g = 0 at q."""
        return v + solve(mass(t, q, v, params), rows.holonomic_matrix(t, q, params).T @ s)

    def base(u, state, t, h, params):
        """The base point, its time, and where the second half ends."""
        q0, v = state[:n], u[:n]
        at = t + theta * h
        if not c:
            return at, q0 + theta * h * v, q0 + h * v
        q = q0 + (theta * h * pushed(t, q0, v, u[k:first], params) if theta else 0.0)
        return at, q, q + (1.0 - theta) * h * u[first + k : first + k + n]

    def position(u, state, t, h, params):
        """g at the base and at the end, and the direction of the second half; a half of length zero needs no force."""
        at, q, q1 = base(u, state, t, h, params)
        v, w, s, s1 = u[:n], u[first + k : first + k + n], u[k:first], u[first + k + n :]
        onto = rows.position(at, q, params) / h if theta else s
        last = rows.position(t + h, q1, params) / h if theta < 1.0 else s1
        return jnp.concatenate([onto, w - pushed(t + h, q1, v, s1, params), last])

    def residual(u, state, t, h, params):
        q0, p0, v, v1 = state[:n], state[n : 2 * n], u[:n], u[first : first + n]
        at, q, q1 = base(u, state, t, h, params)
        p, rate, _ = flow(at, q, v, params)
        begun = p0 + rows.matrix(t, q0, params).T @ u[n:k] - (p - (1.0 - theta) * h * rate)
        ended = system.legendre(q1, v1, params, t + h) + rows.matrix(t + h, q1, params).T @ u[first + n : first + k]
        ends = [rows.velocity_defect(at, q, v, params), ended - (p + theta * h * rate)]
        ends = [begun, *ends, rows.velocity_defect(t + h, q1, v1, params)]
        return jnp.concatenate([*ends, position(u, state, t, h, params)] if c else ends)

    def advance(u, state, t, h, params):
        at, q, q1 = base(u, state, t, h, params)
        end = [q1, system.legendre(q1, u[first : first + n], params, t + h)]
        return book.after(state, end, at, q, u[:n], h, params)

    def unpack(state, u, t, h, params):
        at, q, _ = base(u, state, t, h, params)
        multipliers = rows.all(flow(at, q, u[:n], params)[2])
        return {"q": state[:n], "p": state[n : 2 * n], "multipliers": multipliers, **book.row(state)}

    def first_guess(data):
        v, forces, shift = data["v"], jnp.zeros(rows.count), jnp.zeros(c)
        return jnp.concatenate([v, forces, shift, v, forces] + [v, shift] * bool(c))

    return _resolved(system, shape, first + second, residual, advance, unpack, first_guess)


def _along(system: LagrangeDirac, function, t, q, v):
    """The derivative of function(t, q) along q̇ = v, ṫ = 1."""
    if system.depends_on_time:
        return along(function, (jnp.asarray(t, float), q), (jnp.ones(()), v))
    return along(lambda q: function(t, q), (q,), (v,))


def _resolved(system: Any, shape: Shape, unknowns: int, residual, advance, unpack, first_guess) -> StepEquation:
    """The StepEquation on M_f with state (q, p): common to the two forms of Method 2."""
    n, book = shape.n, WorkOfForces(system, shape.n)

    def start(data: dict[str, Any], h, params):
        if "q0" in data:
            raise ValueError("Method 2 is a one-step method on M_f: start it from q= with v= or p=, not from two points.")
        return book.start(data["q"], data["p"]), first_guess(data)

    return StepEquation(
        start=start,
        residual=residual,
        advance=advance,
        unpack=unpack,
        state_size=2 * n + book.size,
        unknowns=unknowns,
        fields=lagrangian_fields(system, n, shape.m + shape.c),
        labels=tuple(f"equation {i} of Method 2" for i in range(unknowns)),
        canonical=not book.size,
    )
