"""The (±)-Lagrange–Poincaré–Dirac equations: discrete Lagrange–Dirac systems on the quotient ([RL] (4.6), (4.8))."""

import jax.numpy as jnp

from dirax.program.user_functions import UserFunction
from dirax.reduction.reduced import ReducedLagrangeDirac
from dirax.schemes.quotient import Quotient
from dirax.schemes.step import Shape, StepEquation


def lagrange_poincare_dirac(
    system: ReducedLagrangeDirac, shape: Shape, unreduced: StepEquation, rule, constraint, sign: int = +1
) -> StepEquation:
    """The StepEquation on (Q × Q)/G of an equation on Q with state (q, p, …) and unknowns (v, …) that the symmetry leaves
    alone: [RL] (4.6) (sign +1) or (4.8) (sign −1) for the discrete Lagrange–Dirac equations.

    State (x, w, μ, g, …), unknowns (ẋ, γ, …): the equation at (x, 0), for (+), or with the other point at group
    coordinate 0, for (−), its covectors trivialized by λ̂_d: (r_x + A(x)ᵀ r_g, r_g). For linear h_d these are −∂l/∂x0 = w_k,
    ∂l/∂g1 = μ_k, ∂l/∂x1 = w_{k+1}, μ_{k+1} = μ_k, and g_{k+1} = g_k + hγ + A(x_{k+1} − x_k) reconstructs the group coordinate.
    Forces f and constraint forces Wᵀλ have the trivializations ((f_x + A(x)ᵀ f_g), f_g); their group part moves μ.
    A discrete Lagrangian `rule` and a discrete `constraint` that are the user's functions are checked for invariance.
    """
    quotient, connection, n = Quotient(system.connection, shape.n), system.connection, shape.n
    k, s, free = quotient.k, quotient.s, system.conserves_momentum

    def lifted(state, u, h):
        """The state and the unknowns on Q, with the start at group coordinate 0 or minus the end."""
        x, w, mu, _ = quotient.split(state)
        along = quotient.group_rate(x, u[:s], u[s:n], h)
        q = connection.join(x, jnp.zeros(k) if sign > 0 else -h * along)
        on_q = jnp.concatenate([q, connection.untrivialize_covector(x, w, mu), state[2 * n :]])
        return on_q, jnp.concatenate([connection.join(u[:s], along), u[n:]])

    def lowered(state, g):
        """(x, w, μ, g, …) of (q, p, …), g being the group coordinate."""
        q, p = state[:n], state[n : 2 * n]
        _, w, mu = connection.trivialize_covector(q, p)
        return jnp.concatenate([connection.split(q)[0], w, mu, g, state[2 * n :]])

    def residual(u, state, t, h, params):
        on_q, v = lifted(state, u, h)
        missed = unreduced.residual(v, on_q, t, h, params)
        _, across, along = connection.trivialize_covector(on_q[:n], missed[:n])
        return jnp.concatenate([across, along, missed[n:]])

    def advance(u, state, t, h, params):
        on_q, v = lifted(state, u, h)
        _, _, mu, g = quotient.split(state)
        after = lowered(unreduced.advance(v, on_q, t, h, params), g + h * connection.split(v[:n])[1])
        # without forces the equation ∂l/∂g1 = μ_k is the law μ_{k+1} = μ_k
        return after.at[2 * s : 2 * s + k].set(mu) if free else after

    def unpack(state, u, t, h, params):
        on_q, v = lifted(state, u, h)
        row = dict(unreduced.unpack(on_q, v, t, h, params))
        x, _, _, g = quotient.split(state)
        row.pop("q")
        _, w, mu = connection.trivialize_covector(on_q[:n], row.pop("p"))
        return {"x": x, "w": w, "mu": mu, "g": g, "vertical": h * u[s:n]} | row

    def start(data, h, params):
        state, u = unreduced.start(data, h, params)
        x, g = connection.split(state[:n])
        rate, along = connection.split(u[:n])
        return lowered(state, g), jnp.concatenate([rate, quotient.vertical(x, rate, along, h), u[n:]])

    own = {"discrete_lagrangian": rule, "constraint": constraint}
    own = {name: function for name, function in own.items() if isinstance(function, UserFunction)}

    def check(data, h, params):
        if own:
            system.refuse_asymmetric(own, data, h, params)

    other = {name: field for name, field in unreduced.fields.items() if name not in ("q", "p")}
    return StepEquation(
        start=start,
        residual=residual,
        advance=advance,
        unpack=unpack,
        state_size=unreduced.state_size,
        unknowns=unreduced.unknowns,
        fields=quotient.fields() | other,
        labels=tuple(f"horizontal equation {i}" for i in range(s))
        + tuple(f"vertical equation {a}" for a in range(k))
        + unreduced.labels[n:],
        needs_leaving_step=unreduced.needs_leaving_step,
        check=check,
    )
