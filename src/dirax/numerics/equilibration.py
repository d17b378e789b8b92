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


BALANCED = 8
"""Rounds after which geometric means of rows and columns no longer change by a factor of two."""


def geometric_scales(sizes: Any, xp: ModuleType = np) -> tuple[Any, Any]:
    """Powers of two (…, k, 1) and (…, 1, l) by which rows and columns of a matrix with entries of these `sizes` are to be
    divided so that the geometric mean of those that are not zero is about 1 in each (Curtis and Reid 1972).

    It does for a saddle point [M, Wᵀ; W, 0] what largest entries cannot: M and W come out of one size, however small M is."""
    there = sizes > 0.0
    logs = xp.where(there, xp.log2(xp.where(there, sizes, 1.0)), 0.0)
    mean = lambda a, axis: (
        xp.sum(xp.where(there, a, 0.0), axis=axis, keepdims=True)
        / xp.maximum(xp.sum(there.astype(float), axis=axis, keepdims=True), 1.0)
    )
    columns = xp.zeros((*sizes.shape[:-2], 1, sizes.shape[-1]))
    rows = mean(logs, -1)
    for _ in range(BALANCED):
        columns = mean(logs - rows, -2)
        rows = mean(logs - columns, -1)
    return xp.exp2(xp.round(rows)), xp.exp2(xp.round(columns))


LEAST_SIZE, BETWEEN = 2.0**-400, 0.7310585786300049


def power_of_two(sizes: Any, xp: ModuleType = np) -> Any:
    """The power of two nearest to each size, from `LEAST_SIZE`, for zero too, to its reciprocal.

    It doubles where a size passes BETWEEN times a power of two, which is no number that one would choose: roundoff does not
    decide which it is."""
    _, exponents = xp.frexp(xp.clip(sizes, LEAST_SIZE, 1.0 / LEAST_SIZE) / BETWEEN)
    return xp.ldexp(xp.ones_like(sizes), exponents - 1)


def balanced_inverse(matrix: Any, xp: ModuleType = np) -> Any:
    """A⁻¹ of matrices (…, k, k), whatever the units of rows and columns; NaN of a singular one."""
    rows, columns = geometric_scales(xp.abs(matrix), xp)
    scaled = matrix / rows / columns
    found = _inverted(scaled) if xp is np else xp.linalg.inv(scaled)
    turned = lambda a: xp.swapaxes(a, -1, -2)
    return found / turned(columns) / turned(rows)


def balanced_condition(matrix: np.ndarray) -> float:
    """The condition number of a matrix whose rows and columns have units of their own."""
    rows, columns = geometric_scales(np.abs(matrix))
    return float(np.linalg.cond(matrix / rows / columns))


def _inverted(matrices: np.ndarray) -> np.ndarray:
    try:
        return np.linalg.inv(matrices)
    except np.linalg.LinAlgError:  # one of them is singular
        found = np.full(matrices.shape, np.nan)
        for k in np.ndindex(matrices.shape[:-2]):
            try:
                found[k] = np.linalg.inv(matrices[k])
            except np.linalg.LinAlgError:
                continue
        return found


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
