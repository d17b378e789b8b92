"""The (±)-Lagrange–Poincaré–Dirac equations: discrete Lagrange–Dirac systems on the quotient ([RL] (4.6), (4.8))."""

import jax.numpy as jnp

from dirax.reduction.reduced import ReducedLagrangeDirac
from dirax.schemes.discrete_lagrangian import discrete_constraint
from dirax.schemes.quotient import Quotient
from dirax.schemes.step import Field, Shape, StepEquation


def lagrange_poincare_dirac(system: ReducedLagrangeDirac, shape: Shape, rule, sign: int) -> StepEquation:
    """The StepEquation of [RL] (4.6) (sign +1) or (4.8) (sign −1): state (x, w, μ, g), unknowns (ẋ, γ).

    With linear h_d the equations are −∂l/∂x0 = w_k, ∂l/∂g1 = μ_k, ∂l/∂x1 = w_{k+1}, μ_{k+1} = μ_k, and
    g_{k+1} = g_k + hγ + A(x_{k+1} − x_k) reconstructs the group coordinate. Constraints that the symmetry leaves alone,
    W(x), act with the forces λ̂_d(Wᵀλ) = ((W_x + W_g A)ᵀλ, W_gᵀλ), which move μ: μ_{k+1} = ∂l/∂g1.
    """
    quotient, n, m = Quotient(system, shape.n, rule, sign), shape.n, shape.m
    connection, k, s = system.connection, quotient.k, quotient.s
    wd = discrete_constraint(system.system.constraints, "right" if sign > 0 else "left", m)
    at = lambda x: connection.join(x, jnp.zeros(k))

    def constraint(x, rate, vertical, h, params):
        return wd(0.0, at(x), connection.join(rate, quotient.group_rate(x, rate, vertical, h)), h, params)

    def force(x, multipliers, params):
        """λ̂_d of Wᵀλ at (x, 0): its shape and its group part."""
        covector = system.system.constraint_matrix(at(x), params).T @ multipliers
        return connection.trivialize_covector(at(x), covector)[1:]

    def residual(u, state, t, h, params):
        x, w, mu, _ = quotient.split(state)
        rate, vertical = u[:s], u[s:n]
        d0, _, dg = quotient.slots(t, x, rate, vertical, h, params)
        if not m:
            return jnp.concatenate([w + d0, mu - dg])
        along, across = force(x, u[n:], params)
        return jnp.concatenate([w + d0 - along, mu - dg - across, constraint(x, rate, vertical, h, params)])

    def advance(u, state, t, h, params):
        x, _, mu, g = quotient.split(state)
        rate, vertical = u[:s], u[s:n]
        _, d1, dg = quotient.slots(t, x, rate, vertical, h, params)
        # without constraints the equation ∂l/∂g1 = μ_k is the law μ_{k+1} = μ_k
        return jnp.concatenate([x + h * rate, d1, dg if m else mu, g + h * quotient.group_rate(x, rate, vertical, h)])

    def unpack(state, u, t, h, params):
        x, w, mu, g = quotient.split(state)
        saved = {"x": x, "w": w, "mu": mu, "g": g, "vertical": h * u[s:n]}
        if m:
            saved |= {"multipliers": u[n:], "constraint": constraint(x, u[:s], u[s:n], h, params)}
        return saved

    def start(data, h, params):
        state, u = quotient.start(data, h, params)
        return state, jnp.concatenate([u, jnp.zeros(m)])

    fields = quotient.fields()
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
