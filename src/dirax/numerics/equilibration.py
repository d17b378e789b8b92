"""Equilibration: rows and columns of a matrix scaled to unit size, so that the units of equations and unknowns do not matter.

`xp` is NumPy or `jax.numpy` throughout, and matrices may have leading axes.
"""

import functools
from types import ModuleType
from typing import Any

import numpy as np

ROUNDS = 3
"""Scaling the columns unbalances the rows again, less each time; after three rounds by no more than a factor of two or so."""


MANY = 32
"""Matrices side by side that are many."""


def equilibrated(matrix: Any, xp: ModuleType = np, rounds: int = ROUNDS) -> tuple[Any, Any]:
    """The matrix (…, k, l) with rows, then columns, divided by their largest entries where these are not zero, several times
    over; and the units (…, 1, l) that this gives the unknowns: a solution of the scaled equations times them is one of the given.

    Columns come out with a largest entry of exactly 1, as a decision about ranks or pivots wants them.
    """
    units = xp.ones((*matrix.shape[:-2], 1, matrix.shape[-1]))
    for _ in range(rounds):
        matrix = matrix / _nonzero(xp, _largest(xp, matrix, -1))
        sizes = _nonzero(xp, _largest(xp, matrix, -2))
        matrix, units = matrix / sizes, units / sizes
    return matrix, units


def balancing_scales(sizes: Any, xp: ModuleType = np) -> tuple[Any, Any]:
    """Scales (…, k, 1) and (…, 1, l) by which the rows and the columns of a matrix with entries of these `sizes` are to be
    divided: by square roots from both sides at once (Ruiz 2001), which treats equations and unknowns alike, so that a
    pseudo-inverse in these units does not depend on which of them were called rows."""
    *lead, k, l = sizes.shape
    rows, columns = xp.ones((*lead, k, 1)), xp.ones((*lead, 1, l))
    for _ in range(ROUNDS):
        left = sizes / rows / columns
        rows = rows * xp.sqrt(_nonzero(xp, _maximum(xp, left, -1)))
        columns = columns * xp.sqrt(_nonzero(xp, _maximum(xp, left, -2)))
    return rows, columns


def condition_number(matrix: Any, xp: ModuleType = np) -> Any:
    """That of the equilibrated matrix, ≥ 1."""
    values = xp.linalg.svd(equilibrated(matrix, xp)[0], compute_uv=False)
    return values[..., 0] / values[..., -1]


def _largest(xp: ModuleType, matrix: Any, axis: int) -> Any:
    return _maximum(xp, xp.abs(matrix), axis)


def _maximum(xp: ModuleType, sizes: Any, axis: int) -> Any:
    """The largest of sizes that are not negative, along an axis; of many small matrices NumPy finds it far quicker column by
    column."""
    if xp is np and sizes.ndim > 2 and len(sizes) > MANY and sizes.shape[axis]:
        return np.expand_dims(functools.reduce(np.maximum, np.moveaxis(sizes, axis, 0)), axis)
    return xp.max(sizes, axis=axis, keepdims=True, initial=0.0)


def _nonzero(xp: ModuleType, sizes: Any) -> Any:
    return xp.where(sizes > 0.0, sizes, 1.0)
