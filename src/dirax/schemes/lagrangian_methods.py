"""Methods 1 and 2 of [BLM] for Lagrangians with constraints: the cotangent-lifted θ map on S_0, and the projected map on M_f."""

from typing import Any

import jax
import jax.numpy as jnp

from dirax.schemes.constraint_rows import ConstraintRows
from dirax.schemes.step import Field, Shape, StepEquation
from dirax.schemes.work import WorkBook, work_field
from dirax.systems.lagrange_dirac import LagrangeDirac
from dirax.systems.nonholonomic import NonholonomicMechanics


def _rates(system: LagrangeDirac, t, q, v, params):
    """(∂L/∂q + f, ∂L/∂v) at (t, q, v)."""
    dq, dv = jax.grad(lambda q, v: system.lagrangian.at(t, q, v, params), argnums=(0, 1))(q, v)
    return (dq if system.forces is None else dq + system.forces(t, q, v, params)), dv


def _fields(system: Any, n: int, k: int) -> dict[str, Field]:
    fields = {"q": Field((n,)), "p": Field((n,))}
    if k:
        fields["multipliers"] = Field((k,), "step", ("constraint",), "Lagrange multipliers of the constraints")
    return fields | work_field(system)


def discretized_lagrangian(system: LagrangeDirac, shape: Shape, theta: float) -> StepEquation:
    """Method 1: the cotangent lift of the θ map on p = ∂L/∂q̇, ṗ = ∂L/∂q + f + Wᵀλ, W q̇ + b = 0 ([BLM] §6, (36)–(38)).

    With q = q_k + θh q̇ and p = p_k + (1 − θ)h ṗ the base point, at time t_k + θh, unknowns are (q̇, λ). For θ = ½ and no
    constraints these are the discrete Euler–Lagrange equations of the midpoint L_d, also for degenerate L. Of holonomic
    constraints the Dirac structure has their distribution, G q̇ + ∂g/∂t = 0 at the base point: θ = ½ keeps quadratic g.
    """
    n, rows = shape.n, ConstraintRows(system, shape)
    k, book = rows.count, WorkBook(system, n)

    def base(u, state, t, h, params):
        q, v = state[:n] + theta * h * u[:n], u[:n]
        rate, momentum = _rates(system, t + theta * h, q, v, params)
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
        fields=_fields(system, n, shape.m + shape.c),
        labels=tuple(f"momentum balance {i}" for i in range(n)) + tuple(f"constraint {r} at the base point" for r in rows.kept),
        canonical=not book.size,
    )


def resolved_nonholonomic(system: NonholonomicMechanics, shape: Shape, theta: float) -> StepEquation:
    """Method 2 for a metric, potential and one-forms ([BLM] (39)–(43)), with the closed form of λ and of the projector.

    Unknowns are the base point as (v, p-multiplier σ) with p = g(q) v: q_k = q − θh v,
    p_k + μ(q_k)ᵀσ = p − (1 − θ)h ṗ, μ(q) v = 0; then q_{k+1} = q + (1 − θ)h v, p_{k+1} = P(p + θh ṗ).
    """
    n, m = shape.n, shape.m

    def base(u, state, h, params):
        q0, v = state[:n], u[:n]
        q = q0 + theta * h * v
        p = system.metric(q, params) @ v
        multipliers = system.multipliers(q, p, params)
        force = -jax.grad(system.hamiltonian)(q, p, params) + system.one_forms(q, params).T @ multipliers
        return q, p, force, multipliers

    def residual(u, state, t, h, params):
        q0, p0 = state[:n], state[n:]
        q, p, force, _ = base(u, state, h, params)
        balance = p0 + system.one_forms(q0, params).T @ u[n:] - (p - (1.0 - theta) * h * force)
        return jnp.concatenate([balance, system.one_forms(q, params) @ u[:n]])

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
    """Method 2 for any regular Lagrangian: λ from the derivative of W v + b = 0 along the flow, and the projector
    p ↦ p − W(q)ᵀσ onto W(q) v(q, p) + b = 0 as further equations, since it has no closed form when L is not quadratic.

    Unknowns are (v, σ) of the base point and (v1, σ1) of the end point.
    """
    if shape.c:
        raise ValueError(
            "Method 2 of a Lagrangian with holonomic constraints needs its final manifold: simulate "
            'dx.constraint_algorithm(system, near={"q": q, "v": v}).resolved() instead, or use dx.LagrangeDAlembert, whose '
            "constraints hold at the nodes."
        )
    n, rows = shape.n, ConstraintRows(system, shape)
    k, book = n + rows.count, WorkBook(system, shape.n)

    def flow(t, q, v, params):
        """(p, ṗ, λ) at a point of M_f."""
        rate, p = _rates(system, t, q, v, params)
        w = rows.matrix(t, q, params)
        mass = jax.hessian(lambda v: system.lagrangian.at(t, q, v, params))(v)
        coupling = _along(system, lambda t, q: system.legendre(q, v, params, t), t, q, v)
        turning = _along(system, lambda t, q: rows.velocity_defect(t, q, v, params), t, q, v)
        lifted = jnp.linalg.solve(mass, w.T)
        multipliers = -jnp.linalg.solve(w @ lifted, turning + lifted.T @ (rate - coupling))
        return p, rate + w.T @ multipliers, multipliers

    def residual(u, state, t, h, params):
        q0, p0, v, v1 = state[:n], state[n : 2 * n], u[:n], u[k : k + n]
        at, q, q1 = t + theta * h, q0 + theta * h * v, q0 + h * v
        p, rate, _ = flow(at, q, v, params)
        first = p0 + rows.matrix(t, q0, params).T @ u[n:k] - (p - (1.0 - theta) * h * rate)
        projected = system.legendre(q1, v1, params, t + h) + rows.matrix(t + h, q1, params).T @ u[k + n :]
        ends = [rows.velocity_defect(at, q, v, params), projected - (p + theta * h * rate)]
        return jnp.concatenate([first, *ends, rows.velocity_defect(t + h, q1, v1, params)])

    def advance(u, state, t, h, params):
        v = u[:n]
        q, q1 = state[:n] + theta * h * v, state[:n] + h * v
        end = [q1, system.legendre(q1, u[k : k + n], params, t + h)]
        return book.after(state, end, t + theta * h, q, v, h, params)

    def unpack(state, u, t, h, params):
        q, v = state[:n] + theta * h * u[:n], u[:n]
        multipliers = rows.all(flow(t + theta * h, q, v, params)[2])
        return {"q": state[:n], "p": state[n : 2 * n], "multipliers": multipliers, **book.row(state)}

    def first_guess(data):
        zero = jnp.zeros(rows.count)
        return jnp.concatenate([data["v"], zero, data["v"], zero])

    return _resolved(system, shape, 2 * k, residual, advance, unpack, first_guess)


def _along(system: LagrangeDirac, function, t, q, v):
    """The derivative of function(t, q) along q̇ = v, ṫ = 1."""
    if system.depends_on_time:
        return jax.jvp(function, (jnp.asarray(t, float), q), (jnp.ones(()), v))[1]
    return jax.jvp(lambda q: function(t, q), (q,), (v,))[1]


def _resolved(system: Any, shape: Shape, unknowns: int, residual, advance, unpack, first_guess) -> StepEquation:
    """The StepEquation on M_f with state (q, p): common to the two forms of Method 2."""
    n, book = shape.n, WorkBook(system, shape.n)

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
        fields=_fields(system, n, shape.m),
        labels=tuple(f"equation {i} of Method 2" for i in range(unknowns)),
        canonical=not book.size,
    )
