"""How large numbers count as that may be zero up to a rounding: a defect is compared with its terms, which may all vanish."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Float

from dirax.numerics.arrays import Numbers
from dirax.numerics.tolerances import EQUATION_RANK, SOLVED_ROUNDOFF
from dirax.program.linear_solves import scaled_inverse
from dirax.program.tracing import gradient, jacobian

MOST = 200
"""Numbers up to which a matrix of all of them is made for this."""


def as_large(metric: Float[Numbers, "n n"], x: Float[Numbers, " n"], more: Any = 0.0) -> Float[Numbers, " n"]:
    """How large each coordinate would be that alone had all terms of the energy xᵀ metric x and `more`; 0 where the metric is
    degenerate in it."""
    metric = jnp.abs(metric)
    energy, own = jnp.abs(x) @ metric @ jnp.abs(x) + more, jnp.diagonal(metric)
    return jnp.sqrt(jnp.where(own > 0.0, energy / jnp.where(own > 0.0, own, 1.0), 0.0))


def power_of(energy: Callable, x: Float[Numbers, " n"], velocity: Float[Numbers, " n"], params: Any) -> Float[Numbers, " 2"]:
    """The rate of `energy(x, params)` along a velocity, and the sum of the absolute values of its terms."""
    terms = gradient(lambda x: energy(x, params))(x) * velocity
    return jnp.stack([jnp.sum(terms), jnp.sum(jnp.abs(terms))])


def as_large_as_kinetic(slope: Callable, x: Float[Numbers, " n"]) -> Float[Numbers, " n"]:
    """The same in the derivative at x of `slope`, a momentum or a velocity as a function of the other; 0 for many numbers."""
    return as_large(jacobian(slope)(x), x) if x.size <= MOST else jnp.zeros_like(x)


def as_large_as_energy(slope: Callable, x: Float[Numbers, " n"]) -> Float[Numbers, " n"]:
    """The same of an energy with the gradient `slope`, of which all terms count, those that are linear in x too."""
    return as_large(jacobian(slope)(x), x, jnp.abs(slope(x)) @ jnp.abs(x)) if x.size <= MOST else jnp.zeros_like(x)


def of_solution(
    matrix: Callable, solution: Float[Numbers, " l"], right: Any = None, tolerance: float = EQUATION_RANK
) -> Float[Numbers, " l"]:
    """The sizes of the unknowns of linear equations of a `matrix()` (k, l) that `scaled_inverse` solved: those that are zero come
    out as roundoff of the others, in the units in which it was found, and of the terms of the sizes `right` (k,) that their
    right-hand sides have; of many, for which no matrix is made, in one unit."""
    if solution.size > MOST:
        return jnp.abs(solution) + SOLVED_ROUNDOFF * jnp.max(jnp.abs(solution), initial=0.0)
    inverse, units = scaled_inverse(matrix(), tolerance)
    of_right = 0.0 if right is None else jnp.abs(inverse) @ right
    return jnp.abs(solution) + SOLVED_ROUNDOFF * (units * jnp.max(jnp.abs(solution) / units, initial=0.0) + of_right)
