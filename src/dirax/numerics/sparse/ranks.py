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
    scaled, columns = _scaled_to_one(matrix)
    smallest, direction = smallest_singular_value(equations, scaled)
    if smallest > EQUATION_RANK:
        return None
    balanced, units = _balanced(matrix)  # largest entries cannot balance a saddle point with small masses
    scaled, columns = _scaled_to_one(balanced)
    smallest, direction = smallest_singular_value(equations, scaled)
    return None if smallest > EQUATION_RANK else units * columns * direction


def _scaled_to_one(matrix: Any) -> tuple[Any, np.ndarray]:
    """With rows, then columns, divided by their largest entries; and what the columns were multiplied with."""
    rows = _inverse(np.asarray(abs(matrix).max(axis=1).todense()).ravel())
    scaled = sp.diags(rows) @ matrix
    columns = _inverse(np.asarray(abs(scaled).max(axis=0).todense()).ravel())
    return sp.csr_matrix(scaled @ sp.diags(columns)), columns


def _balanced(matrix: Any) -> tuple[Any, np.ndarray]:
    """With rows and columns multiplied by powers of two such that the logarithms of the entries are least squares (Curtis and
    Reid 1972); and those of the columns."""
    from scipy.sparse.linalg import lsqr  # imported when it is used

    entries, size = sp.coo_matrix(matrix), matrix.shape[0]
    there = entries.data != 0.0
    rows, columns, number = entries.row[there], entries.col[there], np.arange(np.sum(there))
    logarithms = np.frexp(np.abs(entries.data[there]))[1].astype(float)
    ones = np.ones(2 * len(number))
    design = sp.csr_matrix((ones, (np.tile(number, 2), np.concatenate([rows, size + columns]))), (len(number), 2 * size))
    found = np.ldexp(1.0, -np.round(lsqr(design, logarithms, atol=1e-9, btol=1e-9)[0]).astype(int))
    return sp.csr_matrix(sp.diags(found[:size]) @ matrix @ sp.diags(found[size:])), found[size:]


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
