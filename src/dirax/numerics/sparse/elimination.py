"""How a sparse matrix of known pattern is factored: in a band, in a fixed order that makes little fill, or with exchanged rows;
rows and columns that are full apart.

Each way has `tables` and `solve_tables`, what it knows of the pattern; `factors` and `solution` from them, by NumPy or by JAX;
`stats`, the multiplications that a factorization takes, `operations`, and the `seconds` that it took so far.
"""

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
import scipy.sparse as sp
from scipy.sparse import csgraph

from dirax.numerics.sparse.band import BandElimination
from dirax.numerics.sparse.border import MOST, BorderedElimination, full_lines
from dirax.numerics.sparse.exchanged import ExchangedElimination
from dirax.numerics.sparse.fixed import FixedElimination

Elimination: TypeAlias = BandElimination | FixedElimination | ExchangedElimination | BorderedElimination

NARROW, WIDEST_BAND = 40, 128
"""Diagonals, those of exchanged rows with them, up to which a matrix is factored in its band without looking further, and up to
which at all."""

IN_BAND = 6.0
"""Multiplications in a band in the time of one that follows indices: .16 to .21 ns beside 1.2."""


class StructurallySingular(ValueError):
    """Raised for a pattern in which some equations have not enough unknowns between them; `rows` are those left over."""

    def __init__(self, rows: np.ndarray):
        self.rows = rows
        super().__init__(f"the equations {rows[:8].tolist()} have not enough unknowns")


def matched_rows(pattern: Any) -> np.ndarray:
    """For each unknown an equation that it stands in, every equation once. Raises `StructurallySingular`."""
    matched = csgraph.maximum_bipartite_matching(pattern, perm_type="row")
    if np.any(matched < 0):
        raise StructurallySingular(np.setdiff1d(np.arange(pattern.shape[0]), matched))
    return matched.astype(int)


def elimination(pattern: Any) -> Elimination:
    """The way to factor matrices of this pattern. Raises `StructurallySingular`.

    Equations stand beside the unknowns of the same numbers, or beside those that they are matched with, where that makes a
    narrower band. Such a match says nothing of how large entries are, so that pivots are not taken in a fixed order then.
    """
    own, matched = np.arange(pattern.shape[0]), matched_rows(pattern)
    if (bordered := _bordered(pattern, own if np.all(pattern.diagonal()) else matched)) is not None:
        return bordered
    width, order, rows, below, above = min((_in_band(pattern, rows) for rows in (own, matched)), key=lambda choice: choice[0])
    band = BandElimination(pattern, order, rows[order], below, above)
    if width <= NARROW:
        return band
    other = FixedElimination(pattern, matched) if _has_pivots(pattern) else ExchangedElimination(pattern, matched, matched)
    return band if width <= WIDEST_BAND and band.operations <= IN_BAND * other.operations else other


def numbered(size: int, rows: np.ndarray, columns: np.ndarray) -> Any:
    """The pattern of matrices (size, size) with values at these rows and columns, which it numbers from 1 in their order."""
    pattern = sp.csr_matrix((np.arange(1, len(rows) + 1), (rows, columns)), (size, size))
    pattern.sort_indices()
    return pattern


def places(pattern: Any) -> Any:
    """Where a pattern has entries, in the same order."""
    return sp.csr_matrix((np.ones(pattern.nnz, bool), pattern.indices, pattern.indptr), pattern.shape)


def solver_of(size: int, rows: np.ndarray, columns: np.ndarray) -> Callable[[np.ndarray], Callable[[np.ndarray], np.ndarray]]:
    """(values) ↦ (right-hand side ↦ solution) of matrices (size, size) with their values at these rows and columns, in NumPy.
    Raises `StructurallySingular`."""
    pattern = numbered(size, rows, columns)
    made = elimination(places(pattern))
    tables, solve_tables, number = made.tables(pattern), made.solve_tables, np.array([size], np.int64)

    def factored(values: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        factors = made.factors(np, tables, np.ascontiguousarray(values, float), number)
        return lambda right: made.solution(np, solve_tables, factors, np.ascontiguousarray(right, float), number, False)

    return factored


def _bordered(pattern: Any, rows: np.ndarray) -> BorderedElimination | None:
    """With a border, if some lines are full: these and those that they are beside with these `rows`, so that what is left has a
    full diagonal too."""
    full_rows, full_columns = full_lines(pattern)
    columns = np.union1d(full_columns, np.flatnonzero(np.isin(rows, full_rows)))
    if not 0 < len(columns) <= MOST:
        return None
    inner = np.setdiff1d(np.arange(len(rows)), columns)
    core = pattern[np.sort(rows[inner])][:, inner]
    return BorderedElimination(len(rows), elimination(sp.csr_matrix(core)), rows[columns], columns)


def _in_band(pattern: Any, rows: np.ndarray) -> tuple[int, np.ndarray, np.ndarray, int, int]:
    """(diagonals with those of exchanged rows, order of the unknowns, rows beside them, diagonals below, above)."""
    turned, own = pattern[rows], np.arange(len(rows))
    both = sp.csr_matrix(turned + turned.T)
    orders = own, csgraph.reverse_cuthill_mckee(both, symmetric_mode=True).astype(int)
    found = [(order, *_width(turned, order)) for order in orders]
    order, below, above = min(found, key=lambda choice: 2 * choice[1] + choice[2])
    return 2 * below + above + 1, order, rows, below, above


def _has_pivots(pattern: Any) -> bool:
    """Whether each unknown stands in the equation of its number, or has neighbours that do, with which it is symmetric."""
    without = np.flatnonzero(~pattern.diagonal())
    return (pattern[without] != pattern.T.tocsr()[without]).nnz == 0


def _width(pattern: Any, order: np.ndarray) -> tuple[int, int]:
    """Diagonals below and above the main one, with rows and columns in this order."""
    place = np.empty(len(order), int)
    place[order] = np.arange(len(order))
    entries = pattern.tocoo()
    away = place[entries.row] - place[entries.col]
    return int(np.max(away, initial=0)), int(np.max(-away, initial=0))
