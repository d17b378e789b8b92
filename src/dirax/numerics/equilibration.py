"""Equilibration: rows and columns of a matrix scaled to unit size, so that the units of equations and unknowns do not matter.

`xp` is NumPy or `jax.numpy` throughout, and matrices may have leading axes.
"""

import functools
import math
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
    pseudo-inverse in these units does not depend on which of them were called rows. After so few rounds a row that is the
    roundoff of zero stays small."""
    *lead, k, l = sizes.shape
    rows, columns = xp.ones((*lead, k, 1)), xp.ones((*lead, 1, l))
    for _ in range(ROUNDS):
        left = sizes / rows / columns
        rows = rows * xp.sqrt(_nonzero(xp, _maximum(xp, left, -1)))
        columns = columns * xp.sqrt(_nonzero(xp, _maximum(xp, left, -2)))
    return rows, columns


def balancing_scales_of_entries(sizes: np.ndarray, row: np.ndarray, column: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
    """The same (…, k) of square matrices of which the sizes (…, entries) at these rows and columns are not zero."""
    rows, columns = np.ones((*sizes.shape[:-1], k)), np.ones((*sizes.shape[:-1], k))
    lines = []
    for scales, places in ((rows, row), (columns, column)):
        order = np.argsort(places, kind="stable")
        lines.append((scales, order, *np.unique(places[order], return_index=True)))
    for _ in range(ROUNDS):
        left = sizes / rows[..., row] / columns[..., column]
        for scales, order, there, starts in lines:
            scales[..., there] *= np.sqrt(_nonzero(np, np.maximum.reduceat(left[..., order], starts, axis=-1)))
    return rows, columns


def geometric_scales(sizes: Any, xp: ModuleType = np) -> tuple[Any, Any]:
    """Powers of two (…, k, 1) and (…, 1, l) by which rows and columns of a matrix with entries of these `sizes` are to be
    divided so that the geometric mean of those that are not zero is about 1 in each (Curtis and Reid 1972).

    It does for a saddle point [M, Wᵀ; W, 0] what largest entries cannot: M and W come out of one size, however small M is. The
    logarithms are those of least squares, found at once and not by iteration: with other units of rows and columns, by powers
    of two, the divided matrix is the same to the last bit.
    """
    *lead, k, l = sizes.shape
    exponents = xp.where(sizes > 0.0, xp.frexp(sizes)[1].astype(int), NOTHING)
    if not k * l or 0 in lead:
        rows, columns = xp.zeros((*lead, k, 1), int), xp.zeros((*lead, 1, l), int)
    elif xp is np and math.prod(lead) <= REMEMBERED:
        each = [_remembered(one.tobytes(), k, l) for one in exponents.reshape(-1, k, l)]
        rows, columns = (np.reshape(a, (*lead, *a[0].shape)) for a in zip(*each, strict=True))
    else:
        rows, columns = _mean_exponents(exponents, xp)
    if k * l and (xp is not np or np.any(np.abs(columns) > WIDEST)):  # no exponents of floats: rows share them
        middle = lambda e: (xp.max(e, axis=(-2, -1), keepdims=True) + xp.min(e, axis=(-2, -1), keepdims=True)) // 2
        wide = xp.any(xp.abs(columns) > WIDEST, axis=(-2, -1), keepdims=True)
        shift = xp.where(wide, (middle(columns) - middle(rows)) // 2, 0)
        rows, columns = rows + shift, columns - shift
    power = lambda exponents: xp.ldexp(xp.ones(exponents.shape), exponents)  # XLA's exp2 is not exact
    return power(rows), power(columns)


WIDEST = 1000
"""Exponents of scales that floats have, and their reciprocals."""

NOTHING = -(2**20)
"""Stands for the exponent of zero."""


REMEMBERED = 4
"""Matrices at a time of which each is looked for among those before."""


@functools.lru_cache(256)
def _remembered(exponents: bytes, k: int, l: int) -> tuple[np.ndarray, np.ndarray]:
    """Those of one matrix: the next one of an iteration, or of a run, mostly has the same exponents."""
    return _mean_exponents(np.frombuffer(exponents, int).reshape(k, l), np)


NOISE = 20
"""An entry that is smaller than others of its row, and of its column, by so many powers of two hardly counts: it may be the
roundoff of zero."""

WEAK = 2.0**-20
"""What it counts: where nothing else connects two parts of a matrix, it says their units."""


def _mean_exponents(exponents: Any, xp: ModuleType) -> tuple[Any, Any]:
    """The exponents of `geometric_scales` from those of the entries (…, k, l)."""

    def weighted(weights):
        rows, columns = _least_squares(exponents, weights, xp)
        scaled = xp.where(exponents > NOTHING, exponents - rows - columns, NOTHING)
        largest = lambda axis: xp.max(scaled, axis=axis, keepdims=True)
        noise = (scaled < largest(-1) - NOISE) & (scaled < largest(-2) - NOISE)
        return xp.where(noise & (exponents > NOTHING), WEAK, 1.0), rows, columns

    if xp is np:
        weights, *found = weighted(1.0)
        return tuple(found) if np.all(weights == 1.0) else _least_squares(exponents, weights, xp)
    from jax import lax  # imported when it is used

    begun = xp.ones(exponents.shape), exponents[..., :1], exponents[..., :1, :]
    return lax.fori_loop(0, 2, lambda _, found: weighted(found[0]), begun)[1:]  # which is compiled once


def _least_squares(exponents: Any, weights: Any, xp: ModuleType) -> tuple[Any, Any]:
    """Whole numbers near the r_i and c_j for which Σ w_ij (e_ij − r_i − c_j)² is least; a row has a weight of 1."""
    there = xp.where(exponents > NOTHING, weights, 0.0)
    logs = xp.where(exponents > NOTHING, exponents, 0).astype(float)
    turned, sums = (lambda a: xp.swapaxes(a, -1, -2)), (lambda a, axis: xp.sum(a, axis=axis, keepdims=True))
    in_rows, in_columns = (xp.maximum(sums(there, axis), 1.0) for axis in (-1, -2))
    means, coupled = sums(there * logs, -2) / in_columns, (there / in_columns) @ turned(there)
    one = xp.broadcast_to(xp.eye(logs.shape[-2]), coupled.shape)
    connected = _connected(coupled + one, xp)
    # the scales of rows that are connected may have a common factor: with the sum of their logarithms zero the equations have
    # one solution, and with that of the first of them zero it moves with the units by whole numbers
    rows = xp.linalg.solve(one * in_rows - coupled + connected, sums(there * (logs - means), -1))
    rows = rows - xp.take_along_axis(rows, xp.argmax(connected, axis=-1)[..., None], axis=-2)
    columns = sums(there * (logs - rows), -2) / in_columns
    return tuple(xp.round(a - ODD).astype(int) for a in (rows, columns))


ODD = 0.07
"""Logarithms are rounded where roundoff does not decide: means of whole numbers are not at a half of one after this."""


def _connected(adjacent: Any, xp: ModuleType) -> Any:
    """1 for rows (…, k, k) that are connected over others, with themselves too, and 0 for those that are not."""
    found = (adjacent > 0.0).astype(float)
    for _ in range((found.shape[-1] - 1).bit_length()):
        if xp is np and np.all(found):
            break
        found = (found @ found > 0.0).astype(float)
    return found


def diagonal_units(matrix: Any, xp: ModuleType = np) -> Any:
    """The units (k,) of coordinates in which a symmetric matrix has ±1 on its diagonal, or zero: in these a positive definite one
    is as well conditioned as in any, up to a factor k (van der Sluis 1969)."""
    return xp.sqrt(_nonzero(xp, xp.abs(xp.diagonal(matrix))))


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
    """That of matrices whose rows and columns have units of their own, ≥ 1; infinite for a singular one."""
    rows, columns = geometric_scales(xp.abs(matrix), xp)
    with np.errstate(all="ignore"):
        scaled = matrix / rows / columns
    finite = xp.all(xp.isfinite(scaled), axis=(-2, -1), keepdims=True)  # what floats cannot say counts as singular
    values = xp.linalg.svd(xp.where(finite, scaled, 0.0), compute_uv=False)
    largest, least = values[..., 0], values[..., -1]
    return xp.where(least == 0.0, xp.inf, largest / _nonzero(xp, least))


def _largest(xp: ModuleType, matrix: Any, axis: int) -> Any:
    return _maximum(xp, xp.abs(matrix), axis)


def _maximum(xp: ModuleType, sizes: Any, axis: int) -> Any:
    """The largest of sizes that are not negative, along an axis."""
    if xp is np and sizes.ndim > 2 and sizes.shape[axis]:
        return np.expand_dims(largest_of_few(sizes, axis), axis)
    return xp.max(sizes, axis=axis, keepdims=True, initial=0.0)


def largest_of_few(numbers: np.ndarray, axis: int = -1) -> np.ndarray:
    """`np.max` along an axis, the last one or that before it; of many small arrays it is found far quicker column by column."""
    if numbers.ndim > -axis and len(numbers) > MANY:
        return functools.reduce(np.maximum, np.moveaxis(numbers, axis, 0))
    return np.max(numbers, axis=axis)


def _nonzero(xp: ModuleType, sizes: Any) -> Any:
    return xp.where(sizes > 0.0, sizes, 1.0)
