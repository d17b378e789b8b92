"""Whether a large sparse matrix is singular: decided by its elimination."""

from typing import Any

import numpy as np
import scipy.sparse as sp

from dirax.numerics.tolerances import EQUATION_RANK, TINY

ROUNDS = 4
"""Solutions with the matrix and its transpose by which the smallest singular value is found, up to a small factor."""

NEAR = 1e-9
"""How near another matrix is, relative to every entry, whose direction is taken for that of a singular one."""


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
    """The smallest singular value of a matrix, up to a small factor, and its direction; of one with pivots that are zero 0, and
    the direction of a matrix near it."""
    found = _smallest(equations, matrix)
    if found is None:
        near = matrix.copy()
        near.data *= 1.0 + NEAR * np.random.default_rng(1).uniform(-1.0, 1.0, len(near.data))
        found = 0.0, (_smallest(equations, near) or (0.0, np.ones(matrix.shape[0])))[1]
    return found


def _smallest(equations: Any, matrix: Any) -> tuple[float, np.ndarray] | None:
    """The same where it can be factored, else None."""
    solve = equations.in_numpy(equations.values_of(matrix))
    x, smallest = np.random.default_rng(0).normal(size=matrix.shape[0]), np.inf
    direction = x
    with np.errstate(all="ignore"):
        for _ in range(ROUNDS):
            x = solve(x / np.linalg.norm(x))
            size = np.linalg.norm(x)
            if not np.isfinite(size) or size > 1 / TINY:
                return None
            smallest, direction = min(smallest, float(1 / size)), x / size
            x = solve(direction, True)
            if not np.all(np.isfinite(x)):
                return None
    return smallest, direction


def _inverse(sizes: np.ndarray) -> np.ndarray:
    return 1.0 / np.where(sizes > 0, sizes, 1.0)
