"""Discrete Routh reduction: the momentum μ is fixed and the group variable eliminated, n − dim G unknowns a step."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.program.user_functions import UserFunction, evaluated
from dirax.reduction.reduced import ReducedLagrangeDirac
from dirax.schemes.constraint_rows import ConstraintRows
from dirax.schemes.lagrange_dirac import LagrangeDAlembert, discrete_lagrange_dalembert
from dirax.schemes.quotient import Quotient
from dirax.schemes.reduced import lagrange_poincare_dirac
from dirax.schemes.reduced_lagrangian import ReducedDiscreteLagrangian
from dirax.schemes.step import AbstractScheme, Shape, StepEquation
from dirax.schemes.vertical import vertical_velocity

SINGULAR = 1e-13
"""A group inertia with singular values below this, when its rows and columns have unit size, is singular."""


class DiscreteRouth(AbstractScheme):
    """The discrete Routh equations on the quotient: γ from ∂l_d/∂γ(x_k, ẋ, γ) = μ, and the discrete Euler–Lagrange
    equations of the discrete Routhian r_μ(x_k, ẋ) = l_d − ⟨μ, hγ⟩ in the shape alone.

    `discrete_lagrangian`, `constraint` and `momentum` as in `LagrangeDAlembert`, whose trajectory on a system made by
    `dx.reduce` this is, to roundoff. γ has a closed form where L is quadratic in the group velocity (found from L itself),
    else Newton's method is unrolled from the γ of the step before. The group inertia ∂²l_d/∂γ² must be invertible: where
    it is not, μ is a singular value.

    Constraints and forces that do no work along the group stay, as forces on the shape: the one-forms vanish on the
    vertical directions, ⟨ω^r(q), ξ_Q(q)⟩ = 0, and ⟨f, ξ_Q(q)⟩ = 0 (holonomic constraints that are invariant have this
    property). Others move μ, by the nonholonomic momentum equation: a run refuses them with `ValueError`, which says by how
    much and where; `LagrangeDAlembert` steps such systems on the quotient. Looked at: the initial data and points near them;
    under a JAX transformation nothing is.
    """

    discrete_lagrangian: str | UserFunction
    constraint: str | UserFunction
    momentum: str

    def __init__(
        self,
        discrete_lagrangian: str | Callable = "midpoint",
        constraint: str | Callable = "midpoint",
        momentum: str | None = None,
    ):
        scheme = LagrangeDAlembert(discrete_lagrangian, constraint, momentum)
        self.discrete_lagrangian, self.constraint, self.momentum = scheme.discrete_lagrangian, scheme.constraint, scheme.momentum

    def step_equation(self, system: Any, shape: Shape) -> StepEquation:
        if not isinstance(system, ReducedLagrangeDirac):
            raise TypeError(
                f"dx.DiscreteRouth steps a system made by dx.reduce, but a {type(system).__name__} was given: name its "
                "symmetry, dx.reduce(system, dx.LinearConnection(fibre=[…]))."
            )
        unreduced = discrete_lagrange_dalembert(system.system, shape, self.discrete_lagrangian, self.constraint, self.momentum)
        reduced = lagrange_poincare_dirac(system, shape, unreduced, self.discrete_lagrangian, self.constraint)
        return discrete_routh(system, shape, reduced, self.discrete_lagrangian)


def discrete_routh(system: ReducedLagrangeDirac, shape: Shape, reduced: StepEquation, rule) -> StepEquation:
    """The StepEquation of the discrete Routh equations: the reduced equations without the vertical ones and without γ,
    which ∂l/∂γ = μ determines. State (x, w, μ, g, …, γ), unknowns (ẋ, μ, λ, v̂, σ) with ẋ and v̂ (n − k,) of the shape."""
    quotient, l = Quotient(system.connection, shape.n), ReducedDiscreteLagrangian(system, shape.n, rule)
    connection, k, s, n = system.connection, quotient.k, quotient.s, shape.n
    rows = ConstraintRows(system.system, shape)
    free, projected, size, head = system.free, rows.holonomic > 0, reduced.state_size, s + rows.count

    vertical = vertical_velocity(lambda gamma, t, x, rate, h, params: l.momentum(t, x, rate, gamma, h, params), k)
    along = vertical_velocity(
        lambda along, t, x, rate, params: connection.split(
            system.system.legendre(connection.join(x, jnp.zeros(k)), connection.join(rate, along), params, t)
        )[1],
        k,
    )

    def vertical_part(u, state, t, h, params):
        x, _, mu, _ = quotient.split(state)
        return vertical(mu, state[size:], t, x, u[:s], h, params)

    def whole(u, state, t, h, params):
        """The unknowns of the reduced equations."""
        x, _, mu, _ = quotient.split(state)
        gamma = vertical_part(u, state, t, h, params)
        parts = [u[:s], gamma, u[s:head]]
        if projected:
            rate = u[head : head + s]
            guess = quotient.group_rate(x, rate, gamma, h)
            parts += [connection.join(rate, along(mu, guess, t, x, rate, params)), u[head + s :]]
        return jnp.concatenate(parts)

    def residual(u, state, t, h, params):
        if free:  # the derivatives of the Routhian are those of l at fixed γ, since ∂l/∂γ = μ
            x, w, _, _ = quotient.split(state)
            return w + l.slots(t, x, u, vertical_part(u, state, t, h, params), h, params)[0]
        missed = reduced.residual(whole(u, state, t, h, params), state[:size], t, h, params)
        kept = [missed[:s], missed[n : n + rows.count]]
        if projected:
            kept += [connection.split(missed[k + head : k + head + n])[0], missed[k + head + n :]]
        return jnp.concatenate(kept)

    def advance(u, state, t, h, params):
        x, _, mu, g = quotient.split(state)
        if not free:
            v = whole(u, state, t, h, params)
            after = reduced.advance(v, state[:size], t, h, params)
            return jnp.concatenate([after.at[2 * s : 2 * s + k].set(mu), v[s:n]])
        gamma = vertical_part(u, state, t, h, params)
        inside = l.finite(t, x, u, gamma, h, params)
        w = jnp.where(inside, l.slots(t, x, u, gamma, h, params)[1], jnp.nan)
        return jnp.concatenate([x + h * u, w, mu, g + h * quotient.group_rate(x, u, gamma, h), gamma])

    def unpack(state, u, t, h, params):
        return reduced.unpack(state[:size], whole(u, state, t, h, params), t, h, params)

    def start(data, h, params):
        state, u = reduced.start(data, h, params)
        kept = [u[:s], u[n : n + rows.count]]
        if projected:
            kept += [connection.split(u[k + head : k + head + n])[0], u[k + head + n :]]
        return jnp.concatenate([state, u[s:n]]), jnp.concatenate(kept)

    def inertia(data, h, params):
        """∂²l/∂γ² (k, k) at initial data, over h."""
        q = data["q"] if "q" in data else data["q0"]
        v = (data["q1"] - q) / h if "q1" in data else system.complete(data, params, False)["v"]
        (x, _), (rate, along) = connection.split(q), connection.split(v)
        gamma = quotient.vertical(x, rate, along, h)
        return jax.jacfwd(lambda gamma: l.momentum(data.get("t", 0.0), x, rate, gamma, h, params))(gamma)

    def check(data, h, params):
        reduced.check(data, h, params)
        matrix = np.asarray(evaluated(inertia, data, h, params))
        units = np.sqrt(np.max(np.abs(matrix), axis=1))
        scaled = matrix / np.outer(units, units) if np.all(units > 0) else matrix
        rank = int(np.linalg.matrix_rank(scaled, tol=SINGULAR)) if np.all(np.isfinite(scaled)) else k
        if rank < k:
            raise ValueError(
                f"μ has a singular value at the initial data: the group inertia ∂²l_d/∂γ² = {matrix.tolist()} has rank {rank} of "
                f"{k} there, so that ∂l_d/∂γ = μ does not determine γ. Start elsewhere, or use dx.LagrangeDAlembert, which "
                "keeps γ among its unknowns."
            )
        moved = system.moves_momentum(data, params)
        if moved:
            raise ValueError(
                f"dx.DiscreteRouth fixes μ, which {moved}; μ then obeys an equation of its own (for constraints the "
                "nonholonomic momentum equation): use dx.LagrangeDAlembert on the reduced system, which solves it."
            )

    why = "which needs the group inertia ∂²l/∂γ² to be invertible: μ is not to be a singular value of the momentum map"
    labels = list(reduced.labels[n:])
    if projected:
        labels = labels[: rows.count] + labels[rows.count + k :]
    return StepEquation(
        start=start,
        residual=residual,
        advance=advance,
        unpack=unpack,
        state_size=size + k,
        unknowns=reduced.unknowns - k * (1 + projected),
        fields=reduced.fields,
        labels=(*(f"discrete Routh equation {i}, {why}" for i in range(s)), *labels),
        needs_leaving_step=reduced.needs_leaving_step,
        check=check,
    )
