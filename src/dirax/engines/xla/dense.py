"""The linear solver of small dense matrices, which are those of most steps."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import lu_factor, lu_solve
from jaxtyping import Array, Float

from dirax.engines.linear_solver import AbstractLinearSolver

LARGEST_INVERSE = 8
"""Largest number of unknowns for which the inverse is written out in array operations; beyond it LAPACK is faster."""


class Dense(AbstractLinearSolver):
    """Elimination with partial pivoting: by LAPACK for more than LARGEST_INVERSE unknowns, in array operations, which XLA fuses
    with what is around them, for fewer."""

    def factorise(self, matrix: Float[Array, "k k"]) -> Any:
        """LAPACK's factors; or (the inverse of the matrix with its rows in some order, that order); or the inverse."""
        k = matrix.shape[0]
        return lu_factor(matrix) if k > LARGEST_INVERSE else _gauss_jordan_inverse(matrix) if k > 3 else _cofactor_inverse(matrix)

    def solve(self, factors: Any, right: Float[Array, " k"]) -> Float[Array, " k"]:
        """x with matrix·x = right."""
        k = right.shape[0]
        if k > LARGEST_INVERSE:
            return lu_solve(factors, right)
        if k > 3:
            inverse, order = factors
            return jnp.sum(inverse * right[order][None, :], axis=1)
        return jnp.sum(factors * right[None, :], axis=1)


def _cofactor_inverse(matrix):
    """The inverse of a 1×1, 2×2 or 3×3 matrix by its cofactors, which fuses into one kernel."""
    if matrix.shape[0] == 1:
        return 1.0 / matrix
    if matrix.shape[0] == 2:
        (a, b), (c, d) = matrix
        return jnp.array([[d, -b], [-c, a]]) / (a * d - b * c)
    x, y, z = matrix
    columns = jnp.stack([jnp.cross(y, z), jnp.cross(z, x), jnp.cross(x, y)], axis=1)
    return columns / jnp.sum(x * columns[:, 0])


def _gauss_jordan_inverse(matrix):
    """The inverse of the matrix with its rows in `order`, and that order: elimination in place with partial pivoting, a few
    array operations a column."""
    k = matrix.shape[0]
    row, column = np.arange(k)[:, None], np.arange(k + 1)[None, :]
    # the last column says which row of the matrix stands here
    table = jnp.concatenate([matrix, jnp.arange(k, dtype=matrix.dtype)[:, None]], axis=1)
    for c in range(k):
        if c < k - 1:
            pivot = c + jnp.argmax(jnp.abs(table[c:, c]))
            upper, lower = table[c : c + 1], jax.lax.dynamic_slice_in_dim(table, pivot, 1)
            table = jnp.where(row == c, lower, jnp.where(row == pivot, upper, table))
        scaled = jnp.where(column == c, 1.0, table[c : c + 1]) / table[c, c]
        reduced = jnp.where(column == c, 0.0, table) - table[:, c : c + 1] * scaled
        table = jnp.where(column == k, table, jnp.where(row == c, scaled, reduced))
    return table[:, :k], table[:, k].astype(int)
