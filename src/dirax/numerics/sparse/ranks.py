"""Whether a large sparse matrix is singular: decided by its elimination."""

from typing import Any

import numpy as np
import scipy.sparse as sp

from dirax.numerics.tolerances import EQUATION_RANK, TINY

ROUNDS = 4
"""Solutions with the matrix and its transpose by which the smallest singular value is found, up to a small factor."""


def free_direction(equations: Any, matrix: Any) -> np.ndarray | None:
    """The direction that a matrix, rows and columns scaled to 1, takes to nothing; None where it is regular.

    `equations` say how matrices of its pattern are factored (`dirax.program.sparse_equations.SparseEquations`).
    """
    rows = _inverse(np.asarray(abs(matrix).max(axis=1).todense()).ravel())
    scaled = sp.diags(rows) @ matrix
    columns = _inverse(np.asarray(abs(scaled).max(axis=0).todense()).ravel())
    scaled = sp.csr_matrix(scaled @ sp.diags(columns))
    smallest, direction = smallest_singular_value(equations, scaled)
    return None if smallest > EQUATION_RANK else columns * direction


def smallest_singular_value(equations: Any, matrix: Any) -> tuple[float, np.ndarray]:
    """The smallest singular value of a matrix, up to a small factor, and its direction, as far as they are numbers."""
    solve = equations.in_numpy(equations.values_of(matrix))
    x, smallest = np.random.default_rng(0).normal(size=matrix.shape[0]), np.inf
    direction = x
    with np.errstate(all="ignore"):
        for _ in range(ROUNDS):
            x = solve(x / np.linalg.norm(x))
            size = np.linalg.norm(x)
            if not np.isfinite(size) or size > 1 / TINY:
                return 0.0, np.where(np.isfinite(x), x, 1.0)
            smallest, direction = min(smallest, float(1 / size)), x / size
            x = solve(direction, True)
    return smallest, direction


def _inverse(sizes: np.ndarray) -> np.ndarray:
    return 1.0 / np.where(sizes > 0, sizes, 1.0)
