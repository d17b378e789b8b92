"""Method 2 of [BLM] for any system: the projected θ map on the final constraint manifold of a chain."""

import jax
import jax.numpy as jnp

from dirax.schemes.step import Field, Shape, StepEquation
from dirax.systems.constraint_chain import ResolvedSystem


def projected_field(system: ResolvedSystem, shape: Shape, theta: float) -> StepEquation:
    """ẋ = X(x) on M_f = {φ = 0} by the projected map (P × P) ∘ R_d ([BLM] Prop 7.3), P the nearest point of M_f:

        x_k = P(x − θh X(x)),   x_{k+1} = P(x + (1 − θ)h X(x)),   x ∈ M_f.

    Unknowns are (w, s) with x = x_k + θh w, w = X(x) + Dφ(x_k)ᵀs, and the same of the second half. φ holds at the nodes
    to roundoff. Self-adjoint and of second order for θ = ½.
    """
    n, m = shape.n, shape.m
    k = n + m

    def parts(u, state, h):
        x = state + theta * h * u[:n]
        return x, x + (1.0 - theta) * h * u[k : k + n]

    def half(w, s, at, there, field, fraction, params):
        phi = lambda y: system.chain.constraints(y, params)
        value, pull = jax.vjp(phi, at)
        # a half of length zero moves nothing, and needs no force
        on = s if fraction == 0.0 else (value if there is at else phi(there))
        return jnp.concatenate([w - field - pull(s)[0], on])

    def residual(u, state, t, h, params):
        x, end = parts(u, state, h)
        field = system.chain.field(x, params)
        first = half(u[:n], u[n:k], state, x, field, theta, params)
        return jnp.concatenate([first, half(u[k : k + n], u[k + n :], end, end, field, 1.0 - theta, params)])

    def start(data, h, params):
        u = jnp.concatenate([data["velocity"], jnp.zeros(m)])
        return data["x"], jnp.concatenate([u, u])

    def unpack(state, u, t, h, params):
        return {"x": state, "multipliers": system.chain.multipliers(parts(u, state, h)[0], params)}

    multipliers = len(system.chain.multiplier_names)
    return StepEquation(
        start=start,
        residual=residual,
        advance=lambda u, state, t, h, params: parts(u, state, h)[1],
        unpack=unpack,
        state_size=n,
        unknowns=2 * k,
        fields={"x": Field((n,)), "multipliers": Field((multipliers,), "step", ("constraint",), "multipliers at the base point")},
        labels=tuple(f"equation {i} of the projected map" for i in range(2 * k)),
    )
