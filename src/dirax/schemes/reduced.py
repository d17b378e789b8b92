"""The (±)-Lagrange–Poincaré–Dirac equations: discrete Lagrange–Dirac systems on the quotient ([RL] (4.6), (4.8))."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.reduction.connection import AbstractConnection, LinearConnection
from dirax.reduction.reduced import ReducedLagrangeDirac
from dirax.schemes.discrete_lagrangian import discrete_constraint, discrete_lagrangian
from dirax.schemes.step import Field, Shape, StepEquation


class QuotientState:
    """The layout (x, w, μ, g) of a state on the quotient, and how a run gets its first one."""

    def __init__(self, connection: AbstractConnection, n: int):
        self.connection, self.n = connection, n
        self.k = len(connection.fibre)
        self.s = n - self.k

    def split(self, state: Float[Array, " state"]) -> tuple[Array, Array, Array, Array]:
        """x, w, μ, g."""
        s, k = self.s, self.k
        return state[:s], state[s : 2 * s], state[2 * s : 2 * s + k], state[2 * s + k : 2 * s + 2 * k]

    def slot_derivatives(self, l, x, rate, vertical, h, params) -> tuple[Array, Array, Array]:
        """(−w_k, w_{k+1}, μ) from the derivatives of l in (x0, ẋ, γ): (∂l/∂x0, ∂l/∂x1, ∂l/∂g1) for linear h_d.

        Otherwise the terms with h⁰_d of (4.6) do not cancel those with A(x) = D2 h⁰_d(x, x) of the trivialization.
        """
        dx, drate, dvertical = jax.grad(l, argnums=(0, 1, 2))(x, rate, vertical, h, params)
        d0, d1, mu = dx - drate / h, drate / h, dvertical / h
        if isinstance(self.connection, LinearConnection):
            return d0, d1, mu
        x1, matrix_at = x + h * rate, self.connection.matrix_at
        lift0, lift1 = jax.jacfwd(self.connection.lift_of_shapes, argnums=(0, 1))(x, x1)
        return d0 - mu @ (lift0 + matrix_at(x)), d1 + mu @ (matrix_at(x1) - lift1), mu

    def group_rate(self, x, rate, vertical, h) -> Float[Array, " k"]:
        """ġ = (g1 − g0)/h with ω_d = hγ."""
        return group_rate(self.connection, x, rate, vertical, h)

    def start(self, l, data, h, params) -> tuple[Float[Array, " state"], Float[Array, " n"]]:
        """The first state and the first guess of (ẋ, γ)."""
        connection = self.connection
        if "q0" in data:
            (x0, g0), (x1, g1) = connection.split(data["q0"]), connection.split(data["q1"])
            rate = (x1 - x0) / h
            vertical = (g1 - g0) / h - self.group_rate(x0, rate, jnp.zeros(self.k), h)
            d0, _, dg = self.slot_derivatives(l, x0, rate, vertical, h, params)
            return jnp.concatenate([x0, -d0, dg, g0]), jnp.concatenate([rate, vertical])
        (x, g), (rate, along) = connection.split(data["q"]), connection.split(data["v"])
        _, w, mu = connection.trivialize_covector(data["q"], data["p"])
        return jnp.concatenate([x, w, mu, g]), jnp.concatenate([rate, along - connection.matrix_at(x) @ rate])


def group_rate(connection: AbstractConnection, x, rate, vertical, h) -> Float[Array, " k"]:
    """ġ = γ + h⁰_d(x, x + hẋ)/h."""
    if isinstance(connection, LinearConnection):
        return vertical + connection.matrix_at(x) @ rate
    return vertical + connection.lift_of_shapes(x, x + h * rate) / h


def quotient_fields(s: int, k: int) -> dict[str, Field]:
    """What is saved of a run on the quotient."""
    return {
        "x": Field((s,), dims=("shape",)),
        "w": Field((s,), dims=("shape",), description="momentum of the shape, w + h*_{d,Σ}(μ)"),
        "mu": Field((k,), dims=("group",), description="momentum map"),
        "g": Field((k,), dims=("group",), description="group coordinate, by reconstruction"),
        "vertical": Field((k,), "step", ("group",), "discrete connection ω_d(q_k, q_{k+1})"),
    }


def reduced_discrete_lagrangian(system: ReducedLagrangeDirac, rule, sign: int):
    """l_{d±} as a function (x0, ẋ, γ, h, params), with x1 = x0 + h ẋ and hγ = ω_d the vertical part ([RL] (4.5), (4.7)).

    (+) starts at (x0, 0): l_{d+}(x0, x1, g1) = L_d((x0, 0), (x1, g1 + h⁰_d(x0, x1)));
    (−) ends at (x1, 0): l_{d−}(x0, g0, x1) = L_d((x0, g0 + h⁰_d(x1, x0)), (x1, 0)), with g0 = −hγ.
    """
    connection, ld = system.connection, discrete_lagrangian(system.system.lagrangian, rule)

    def reduced(x0, rate, vertical, h, params):
        along = group_rate(connection, x0, rate, vertical, h)
        group = jnp.zeros_like(vertical) if sign > 0 else -h * along
        return ld(connection.join(x0, group), connection.join(rate, along), h, params)

    return reduced


def lagrange_poincare_dirac(system: ReducedLagrangeDirac, shape: Shape, rule, sign: int) -> StepEquation:
    """The StepEquation of [RL] (4.6) (sign +1) or (4.8) (sign −1): state (x, w, μ, g), unknowns (ẋ, γ).

    With linear h_d the equations are −∂l/∂x0 = w_k, ∂l/∂g1 = μ_k, ∂l/∂x1 = w_{k+1}, μ_{k+1} = μ_k, and
    g_{k+1} = g_k + hγ + A(x_{k+1} − x_k) reconstructs the group coordinate. Constraints that the symmetry leaves alone,
    W(x), act with the forces λ̂_d(Wᵀλ) = ((W_x + W_g A)ᵀλ, W_gᵀλ), which move μ: μ_{k+1} = ∂l/∂g1.
    """
    quotient, n, m = QuotientState(system.connection, shape.n), shape.n, shape.m
    connection, k, s = system.connection, quotient.k, quotient.s
    l = reduced_discrete_lagrangian(system, rule, sign)
    wd = discrete_constraint(system.system.constraint_matrix, "right" if sign > 0 else "left", m)
    at = lambda x: connection.join(x, jnp.zeros(k))

    def constraint(x, rate, vertical, h, params):
        return wd(at(x), connection.join(rate, quotient.group_rate(x, rate, vertical, h)), h, params)

    def force(x, multipliers, params):
        """λ̂_d of Wᵀλ at (x, 0): its shape and its group part."""
        covector = system.system.constraint_matrix(at(x), params).T @ multipliers
        return connection.trivialize_covector(at(x), covector)[1:]

    def residual(u, state, t, h, params):
        x, w, mu, _ = quotient.split(state)
        rate, vertical = u[:s], u[s:n]
        d0, _, dg = quotient.slot_derivatives(l, x, rate, vertical, h, params)
        if not m:
            return jnp.concatenate([w + d0, mu - dg])
        along, across = force(x, u[n:], params)
        return jnp.concatenate([w + d0 - along, mu - dg - across, constraint(x, rate, vertical, h, params)])

    def advance(u, state, t, h, params):
        x, _, mu, g = quotient.split(state)
        rate, vertical = u[:s], u[s:n]
        _, d1, dg = quotient.slot_derivatives(l, x, rate, vertical, h, params)
        # without constraints the equation ∂l/∂g1 = μ_k is the law μ_{k+1} = μ_k
        return jnp.concatenate([x + h * rate, d1, dg if m else mu, g + h * quotient.group_rate(x, rate, vertical, h)])

    def unpack(state, u, t, h, params):
        x, w, mu, g = quotient.split(state)
        saved = {"x": x, "w": w, "mu": mu, "g": g, "vertical": h * u[s:n]}
        if m:
            saved |= {"multipliers": u[n:], "constraint": constraint(x, u[:s], u[s:n], h, params)}
        return saved

    def start(data, h, params):
        state, u = quotient.start(l, data, h, params)
        return state, jnp.concatenate([u, jnp.zeros(m)])

    fields = quotient_fields(s, k)
    if m:
        fields["multipliers"] = Field((m,), "step", ("constraint",), "Lagrange multipliers of the constraints")
        fields["constraint"] = Field((m,), "step", ("constraint",), "discrete constraint w_d(q_k, q_{k+1})")
    return StepEquation(
        start=start,
        residual=residual,
        advance=advance,
        unpack=unpack,
        state_size=2 * n,
        unknowns=n + m,
        fields=fields,
        labels=tuple(f"horizontal equation {i}" for i in range(s))
        + tuple(f"vertical equation {a}" for a in range(k))
        + tuple(f"discrete constraint {r}" for r in range(m)),
    )
