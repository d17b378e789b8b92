"""The vertical velocity of a given momentum: the root γ of ∂l/∂γ = μ as a function that can be differentiated."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import jaxprs_in_params
from jaxtyping import Array, Float

from dirax.program.linear_solves import solve
from dirax.program.user_functions import is_traced

NEWTON_STEPS = 6
"""Newton steps for γ where ∂l/∂γ is not linear in it; the step that carries h ẋ carries their error with it."""

SAMPLES = 5


def vertical_velocity(momentum: Callable, k: int) -> Callable:
    """The function (μ, guess, *values) ↦ γ (k,) with momentum(γ, *values) = μ.

    Closed where `momentum` is linear in γ, which is found from the function itself; else Newton's method is unrolled from
    the guess. Its derivatives are those of the implicit function theorem: none of the inertia ∂μ/∂γ, which must be
    invertible, and none of Newton's steps.
    """
    linear: dict[Any, bool] = {}  # by the structure of the values

    def equation(gamma, values):
        """The momentum, and the group inertia (k, k) as its columns."""
        along = lambda gamma: momentum(gamma, *values)
        columns = [jax.jvp(along, (gamma,), (unit,)) for unit in jnp.eye(k)]
        return columns[0][0], [column for _, column in columns]

    @jax.custom_jvp
    def vertical(mu, guess, *values):
        def update(gamma):
            found, columns = equation(gamma, values)
            return gamma + solve_small(columns, mu - found)

        structure = jax.tree.structure(values)
        if structure not in linear:
            inertia = lambda gamma, *values: jnp.stack(equation(gamma, values)[1])
            linear[structure] = independent(inertia, 0, (guess, *values))
        if linear[structure]:
            return update(jnp.zeros_like(guess))
        gamma = guess
        for _ in range(NEWTON_STEPS):
            gamma = update(gamma)
        return gamma

    @vertical.defjvp
    def derivative(primals, tangents):
        gamma, values = vertical(*primals), primals[2:]
        change = jax.jvp(lambda *values: momentum(gamma, *values), values, tangents[2:])[1]
        return gamma, solve_small(equation(gamma, values)[1], tangents[0] - change)

    return vertical


def solve_small(columns: list[Float[Array, " k"]], right: Float[Array, " k"]) -> Float[Array, " k"]:
    """The solution of the equations with a matrix of these columns; one equation by the reciprocal, whose derivatives need
    no other division."""
    return right * (1.0 / columns[0]) if len(columns) == 1 else solve(jnp.stack(columns, axis=1), right)


def independent(function: Callable, argument: int, values: tuple) -> bool:
    """Whether function(*values) does not depend on one of its arguments: a NaN there goes wherever the argument does.

    Never a wrong yes: where a branch of the function could hide the NaN, or nothing can be evaluated, the answer is no.
    Traced values are replaced by random ones.
    """
    random = np.random.default_rng(0)

    def concrete(leaf):
        if not is_traced(leaf):
            return leaf
        kind = np.dtype(leaf.dtype)
        return random.uniform(0.3, 1.7, leaf.shape) if np.issubdtype(kind, np.floating) else np.ones(leaf.shape, kind)

    if _branches(jax.make_jaxpr(function)(*jax.tree.map(concrete, values)).jaxpr):
        return False
    with jax.ensure_compile_time_eval():
        compiled = jax.jit(function)
        for _ in range(SAMPLES):
            sample = list(jax.tree.map(concrete, values))
            sample[argument] = np.full(np.shape(sample[argument]), np.nan)
            result = compiled(*sample)
            if is_traced(result):
                return False
            if np.all(np.isfinite(result)):
                return True
    return False


def _branches(jaxpr) -> bool:
    """Whether real numbers are chosen by conditions anywhere in it."""
    for equation in jaxpr.eqns:
        real = any(jnp.issubdtype(getattr(v.aval, "dtype", bool), jnp.floating) for v in equation.outvars)
        if real and equation.primitive.name in ("select_n", "cond", "while", "scan", "clamp", "sort"):
            return True
        if any(_branches(inner) for inner in jaxprs_in_params(equation.params)):
            return True
    return False
