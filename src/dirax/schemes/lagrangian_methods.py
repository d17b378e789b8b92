"""Methods 1 and 2 of [BLM] for Lagrangians with constraints: the cotangent-lifted θ map on S_0, and the projected map on M_f."""

from typing import Any

import jax
import jax.numpy as jnp

from dirax.schemes.step import Field, Shape, StepEquation
from dirax.systems.lagrange_dirac import LagrangeDirac
from dirax.systems.nonholonomic import NonholonomicMechanics


def _derivatives(system: LagrangeDirac, q, v, params):
    """(∂L/∂q, ∂L/∂v) at (q, v)."""
    return jax.grad(lambda q, v: system.lagrangian(q, v, params), argnums=(0, 1))(q, v)


def _fields(n: int, m: int) -> dict[str, Field]:
    fields = {"q": Field((n,)), "p": Field((n,))}
    if m:
        fields["multipliers"] = Field((m,), "step", ("constraint",), "Lagrange multipliers of the constraints")
    return fields


def discretized_lagrangian(system: LagrangeDirac, shape: Shape, theta: float) -> StepEquation:
    """Method 1: the cotangent lift of the θ map on p = ∂L/∂q̇, ṗ = ∂L/∂q + Wᵀλ, W q̇ = 0 ([BLM] §6, (36)–(38)).

    With q = q_k + θh q̇ and p = p_k + (1 − θ)h ṗ the base point, unknowns are (q̇, λ). For θ = ½ and no constraints these
    are the discrete Euler–Lagrange equations of the midpoint L_d, also for degenerate L.
    """
    n, m = shape.n, shape.m

    def force(q, v, u, params):
        dq, dv = _derivatives(system, q, v, params)
        if m:
            dq = dq + system.constraint_matrix(q, params).T @ u[n:]
        return dq, dv

    def residual(u, state, t, h, params):
        q0, p0, v = state[:n], state[n:], u[:n]
        q = q0 + theta * h * v
        rate, momentum = force(q, v, u, params)
        balance = p0 + (1.0 - theta) * h * rate - momentum
        return jnp.concatenate([balance, system.constraint_matrix(q, params) @ v]) if m else balance

    def advance(u, state, t, h, params):
        q0, v = state[:n], u[:n]
        rate, momentum = force(q0 + theta * h * v, v, u, params)
        # p1 = p0 + h ṗ, written from the base point so that p keeps to the image of the Legendre transform
        return jnp.concatenate([q0 + h * v, momentum + theta * h * rate])

    def unpack(state, u, t, h, params):
        row = {"q": state[:n], "p": state[n:]}
        return row | {"multipliers": u[n:]} if m else row

    def start(data, h, params):
        if "q0" not in data:
            return jnp.concatenate([data["q"], data["p"]]), jnp.concatenate([data["v"], jnp.zeros(m)])
        if m:
            raise ValueError("with constraints this scheme starts from q= with v= or p=, not from two points.")
        q0, v = data["q0"], (data["q1"] - data["q0"]) / h
        rate, momentum = force(q0 + theta * h * v, v, v, params)
        return jnp.concatenate([q0, momentum - (1.0 - theta) * h * rate]), v

    return StepEquation(
        start=start,
        residual=residual,
        advance=advance,
        unpack=unpack,
        state_size=2 * n,
        unknowns=n + m,
        fields=_fields(n, m),
        labels=tuple(f"momentum balance {i}" for i in range(n)) + tuple(f"constraint {r} at the base point" for r in range(m)),
        canonical=True,
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

    return _resolved(n, m, n + m, residual, advance, unpack, lambda data: jnp.concatenate([data["v"], jnp.zeros(m)]))


def resolved_lagrangian(system: LagrangeDirac, shape: Shape, theta: float) -> StepEquation:
    """Method 2 for any regular Lagrangian: λ from the derivative of W v = 0 along the flow, and the projector
    p ↦ p − W(q)ᵀσ onto W(q) v(q, p) = 0 as further equations, since it has no closed form when L is not quadratic.

    Unknowns are (v, σ) of the base point and (v1, σ1) of the end point.
    """
    n, m = shape.n, shape.m
    k = n + m

    def constraint(q, v, params):
        return system.constraint_matrix(q, params) @ v

    def flow(q, v, params):
        """(p, ṗ, λ) at a point of M_f."""
        dq, p = _derivatives(system, q, v, params)
        w = system.constraint_matrix(q, params)
        mass = jax.hessian(lambda v: system.lagrangian(q, v, params))(v)
        _, coupling = jax.jvp(lambda q: system.legendre(q, v, params), (q,), (v,))
        _, turning = jax.jvp(lambda q: constraint(q, v, params), (q,), (v,))
        lifted = jnp.linalg.solve(mass, w.T)
        multipliers = -jnp.linalg.solve(w @ lifted, turning + lifted.T @ (dq - coupling))
        return p, dq + w.T @ multipliers, multipliers

    def residual(u, state, t, h, params):
        q0, p0, v, v1 = state[:n], state[n:], u[:n], u[k : k + n]
        q = q0 + theta * h * v
        p, rate, _ = flow(q, v, params)
        q1 = q0 + h * v
        w0, w1 = system.constraint_matrix(q0, params), system.constraint_matrix(q1, params)
        first = p0 + w0.T @ u[n:k] - (p - (1.0 - theta) * h * rate)
        second = system.legendre(q1, v1, params) + w1.T @ u[k + n :] - (p + theta * h * rate)
        return jnp.concatenate([first, constraint(q, v, params), second, w1 @ v1])

    def advance(u, state, t, h, params):
        q1 = state[:n] + h * u[:n]
        return jnp.concatenate([q1, system.legendre(q1, u[k : k + n], params)])

    def unpack(state, u, t, h, params):
        q, v = state[:n] + theta * h * u[:n], u[:n]
        return {"q": state[:n], "p": state[n:], "multipliers": flow(q, v, params)[2]}

    def first_guess(data):
        zero = jnp.zeros(m)
        return jnp.concatenate([data["v"], zero, data["v"], zero])

    return _resolved(n, m, 2 * k, residual, advance, unpack, first_guess)


def _resolved(n: int, m: int, unknowns: int, residual, advance, unpack, first_guess) -> StepEquation:
    """The StepEquation on M_f with state (q, p): common to the two forms of Method 2."""

    def start(data: dict[str, Any], h, params):
        if "q0" in data:
            raise ValueError("Method 2 is a one-step method on M_f: start it from q= with v= or p=, not from two points.")
        return jnp.concatenate([data["q"], data["p"]]), first_guess(data)

    return StepEquation(
        start=start,
        residual=residual,
        advance=advance,
        unpack=unpack,
        state_size=2 * n,
        unknowns=unknowns,
        fields=_fields(n, m),
        labels=tuple(f"equation {i} of Method 2" for i in range(unknowns)),
        canonical=True,
    )
