"""The inverses of many matrices side by side, to be applied to vectors: small ones as arrays, large ones by sparse factors."""

import contextlib
from typing import Any

import numpy as np

from dirax.numerics.equilibration import balancing_scales, balancing_scales_of_entries, geometric_scales

LARGE = 64
"""Rows from which on a matrix is factored and not inverted."""

DOUBTFUL = 1e12
"""Condition numbers from which on other scales are tried: geometric means follow the roundoff of zeros, of which the Jacobian of
a machine at rest has many, as large ones do."""

PROBES = 8
"""Vectors of random signs by which the sizes are found that a large inverse gives."""

Inverses = np.ndarray
"""(matrices, k, k), NaN where there is none; of large matrices objects (matrices,), None where nothing is known."""


def no_inverses(count: int, k: int) -> Inverses:
    """Those of which none is known."""
    return np.full(count, None) if k >= LARGE else np.full((count, k, k), np.nan)


def unknown(inverses: Inverses) -> np.ndarray:
    """Which ones are not known, (matrices,)."""
    return np.array([one is None for one in inverses], bool) if inverses.ndim == 1 else np.isnan(inverses[:, 0, 0])


def inverted(matrices: np.ndarray, alone: bool = False) -> Inverses:
    """Those of matrices (matrices, k, k) whose rows and columns have units in common; or each `alone`, in units of its own, so
    that its bits do not depend on the others."""
    if matrices.shape[-1] >= LARGE:
        return _factored(matrices, alone)
    with np.errstate(all="ignore"):
        own = np.abs(matrices)
        found, grown = _scaled_inverses(matrices, *geometric_scales(_sizes(matrices, alone)))
        if len(some := np.flatnonzero(grown > DOUBTFUL)):
            others, less = _scaled_inverses(matrices[some], *balancing_scales(own[some]))
            better = less < grown[some]
            found[some[better]] = others[better]
    return found


def _sizes(numbers: np.ndarray, alone: bool) -> np.ndarray:
    """Those of the numbers (matrices, …) that are finite, of each matrix or (1, …) of all together."""
    finite, own = np.isfinite(numbers), np.abs(numbers)
    return np.where(finite, own, 0.0) if alone else np.max(own, axis=0, where=finite, initial=0.0)[None]


def _factored(matrices: np.ndarray, alone: bool) -> Inverses:
    """Those of large matrices, of which the entries alone are looked at that are not zero in all of them."""
    count, k, _ = matrices.shape
    column, row = np.nonzero(np.any(matrices != 0.0, axis=0).T)
    numbers, found = matrices[:, row, column], no_inverses(count, k)
    with np.errstate(all="ignore"):
        rows, columns = balancing_scales_of_entries(_sizes(numbers, alone), row, column, k)
        scaled = numbers / rows[:, row] / columns[:, column]
    rows, columns = (np.broadcast_to(a, (count, k)) for a in (rows, columns))
    found[:] = [_Factored(a, row, column, r, c) for a, r, c in zip(scaled, rows, columns, strict=True)]
    return found


def _scaled_inverses(matrices: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Those of matrices to be divided by these scales, and about the condition number of each."""
    scaled = matrices / rows / columns
    try:
        found = np.linalg.inv(scaled)
    except np.linalg.LinAlgError:
        found = np.stack([_inverse(matrix) for matrix in scaled])
    grown = np.max(np.abs(scaled), axis=(1, 2), initial=0.0) * np.max(np.abs(found), axis=(1, 2), initial=0.0)
    return found / np.swapaxes(columns, 1, 2) / np.swapaxes(rows, 1, 2), grown


@np.errstate(all="ignore")
def solved(matrices: np.ndarray, sides: np.ndarray) -> np.ndarray:
    """Solutions of linear systems (matrices, k, k) with one right-hand side (matrices, k) or several (matrices, k, r); NaN where
    a matrix is singular."""
    columns = sides if sides.ndim == matrices.ndim else sides[..., None]
    try:
        found = np.linalg.solve(matrices, columns)
    except np.linalg.LinAlgError:
        regular, found = np.linalg.slogdet(matrices)[0] != 0.0, np.full(columns.shape, np.nan)
        found[regular] = np.linalg.solve(matrices[regular], columns[regular])
    return found.reshape(sides.shape)


def applied(inverses: Inverses, vectors: np.ndarray) -> np.ndarray:
    """A⁻¹v of vectors (matrices, k)."""
    if inverses.ndim > 1:
        return np.einsum("rij,rj->ri", inverses, vectors)
    return np.stack([inverse(v) for inverse, v in zip(inverses, vectors, strict=True)]) if len(vectors) else vectors


def applied_sizes(inverses: Inverses, sizes: np.ndarray) -> np.ndarray:
    """|A⁻¹|s of sizes (matrices, k); of large matrices about that: how far A⁻¹v goes for vectors of these sizes."""
    if inverses.ndim > 1:
        return np.einsum("rij,rj->ri", np.abs(inverses), sizes)
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (PROBES, sizes.shape[1]))
    moved = lambda inverse, s: np.max(np.abs(inverse((signs * s).T)), axis=1)
    return np.stack([moved(inverse, s) for inverse, s in zip(inverses, sizes, strict=True)]) if len(sizes) else sizes


class _Factored:
    """v ↦ A⁻¹v, (k, …), of a matrix whose entries are given, column by column, divided by the scales of its rows and columns; NaN
    for a singular one."""

    def __init__(self, entries: np.ndarray, row: np.ndarray, column: np.ndarray, rows: np.ndarray, columns: np.ndarray):
        from scipy.sparse import csc_matrix  # imported when they are used
        from scipy.sparse.linalg import splu

        self.rows, self.columns, self.factors = rows, columns, None
        if np.all(np.isfinite(entries)):
            there, size = entries != 0.0, len(rows)
            starts = np.searchsorted(column[there], np.arange(size + 1))
            with contextlib.suppress(RuntimeError):  # it is singular
                self.factors: Any = splu(csc_matrix((entries[there], row[there], starts), (size, size)))

    def __call__(self, v: np.ndarray) -> np.ndarray:
        if self.factors is None or not np.all(np.isfinite(v)):
            return np.full_like(v, np.nan)
        return (self.factors.solve((v.T / self.rows).T).T / self.columns).T


def _inverse(matrix: np.ndarray) -> np.ndarray:
    try:
        return np.linalg.inv(matrix)
    except np.linalg.LinAlgError:
        return np.full_like(matrix, np.nan)
