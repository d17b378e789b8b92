"""The (±)-Lagrange–Poincaré–Dirac equations: discrete Lagrange–Dirac systems on the quotient ([RL] (4.6), (4.8))."""

import jax
import jax.numpy as jnp

from dirax.reduction.reduced import ReducedLagrangeDirac
from dirax.schemes.discrete_lagrangian import discrete_lagrangian
from dirax.schemes.step import Field, Shape, StepEquation


def reduced_discrete_lagrangian(system: ReducedLagrangeDirac, rule, sign: int, n: int):
    """l_{d±} as a function (x0, ẋ, γ, h, params), with x1 = x0 + h ẋ and hγ = ω_d the vertical part ([RL] (4.5), (4.7)).

    (+) starts at (x0, 0): l_{d+}(x0, x1, g1) = L_d((x0, 0), (x1, g1 + h⁰_d(x0, x1)));
    (−) ends at (x1, 0): l_{d−}(x0, g0, x1) = L_d((x0, g0 + h⁰_d(x1, x0)), (x1, 0)), with g0 = −hγ.
    """
    connection, ld = system.connection, discrete_lagrangian(system.system.lagrangian, rule)

    def reduced(x0, rate, vertical, h, params):
        group_rate = vertical + connection.matrix(n) @ rate
        group = jnp.zeros_like(vertical) if sign > 0 else -h * group_rate
        return ld(connection.join(x0, group), connection.join(rate, group_rate), h, params)

    return reduced


def lagrange_poincare_dirac(system: ReducedLagrangeDirac, shape: Shape, rule, sign: int) -> StepEquation:
    """The StepEquation of [RL] (4.6) (sign +1) or (4.8) (sign −1): state (x, w, μ, g), unknowns (ẋ, γ).

    With linear h_d the equations are −∂l/∂x0 = w_k, ∂l/∂g1 = μ_k, ∂l/∂x1 = w_{k+1}, μ_{k+1} = μ_k, and
    g_{k+1} = g_k + hγ + A(x_{k+1} − x_k) reconstructs the group coordinate.
    """
    connection, n = system.connection, shape.n
    k = len(connection.fibre)
    s = n - k
    l = reduced_discrete_lagrangian(system, rule, sign, n)

    def parts(state):
        return state[:s], state[s : 2 * s], state[2 * s : 2 * s + k], state[2 * s + k :]

    def derivatives(x, rate, vertical, h, params):
        """(∂l/∂x0, ∂l/∂x1, ∂l/∂g1) from the derivatives in (x0, ẋ, γ)."""
        dx, drate, dvertical = jax.grad(l, argnums=(0, 1, 2))(x, rate, vertical, h, params)
        return dx - drate / h, drate / h, dvertical / h

    def residual(u, state, t, h, params):
        x, w, mu, _ = parts(state)
        d0, _, dg = derivatives(x, u[:s], u[s:], h, params)
        return jnp.concatenate([w + d0, mu - dg])

    def advance(u, state, t, h, params):
        x, _, mu, g = parts(state)
        _, d1, _ = derivatives(x, u[:s], u[s:], h, params)
        return jnp.concatenate([x + h * u[:s], d1, mu, g + h * (u[s:] + connection.matrix(n) @ u[:s])])

    def unpack(state, u, t, h, params):
        x, w, mu, g = parts(state)
        return {"x": x, "w": w, "mu": mu, "g": g, "vertical": h * u[s:]}

    def start(data, h, params):
        if "q0" in data:
            (x0, g0), (x1, g1) = connection.split(data["q0"]), connection.split(data["q1"])
            rate = (x1 - x0) / h
            vertical = (g1 - g0) / h - connection.matrix(n) @ rate
            d0, _, dg = derivatives(x0, rate, vertical, h, params)
            return jnp.concatenate([x0, -d0, dg, g0]), jnp.concatenate([rate, vertical])
        (x, g), (rate, group_rate) = connection.split(data["q"]), connection.split(data["v"])
        _, w, mu = connection.trivialize_covector(data["q"], data["p"])
        return jnp.concatenate([x, w, mu, g]), jnp.concatenate([rate, group_rate - connection.matrix(n) @ rate])

    fields = {
        "x": Field((s,), dims=("shape",)),
        "w": Field((s,), dims=("shape",), description="momentum of the shape, w + h*_{d,Σ}(μ)"),
        "mu": Field((k,), dims=("group",), description="momentum map"),
        "g": Field((k,), dims=("group",), description="group coordinate, by reconstruction"),
        "vertical": Field((k,), "step", ("group",), "discrete connection ω_d(q_k, q_{k+1})"),
    }
    return StepEquation(
        start=start,
        residual=residual,
        advance=advance,
        unpack=unpack,
        state_size=2 * n,
        unknowns=n,
        fields=fields,
        labels=tuple(f"horizontal equation {i}" for i in range(s)) + tuple(f"vertical equation {a}" for a in range(k)),
    )
