"""How a sparse matrix of known pattern is factored: in a band with exchanged rows, or in a fixed order that makes little fill."""

from functools import cache, cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse import csgraph
from scipy.sparse.linalg import spilu

from dirax.numerics.loops.kernel import Kernel
from dirax.numerics.sparse import kernels

WIDEST_BAND = 40
"""Diagonals, those of exchanged rows with them, up to which a matrix is factored in its band."""

_count, _list = Kernel(kernels.count_fill, 3), Kernel(kernels.list_fill, 6)


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


def elimination(pattern: Any) -> "BandElimination | FixedElimination":
    """The way to factor matrices of this pattern. Raises `StructurallySingular`.

    Equations stand beside the unknowns of the same numbers, or beside those that they are matched with, where that makes a
    narrower band.
    """
    own = np.arange(pattern.shape[0])
    choices = [_in_band(pattern, rows) for rows in (own, matched_rows(pattern))]
    width, order, rows, below, above = min(choices, key=lambda choice: choice[0])
    if width <= WIDEST_BAND:
        return BandElimination(pattern, order, rows[order], below, above)
    rows = own if _has_pivots(pattern) else choices[1][2]
    turned = pattern[rows]
    return FixedElimination(pattern, rows, sp.csr_matrix(turned + turned.T))


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


def _whole(array: Any, kind: type = np.int32) -> np.ndarray:
    return np.ascontiguousarray(array, kind)


@cache
def _band_kernels(below: int, width: int) -> tuple[Kernel, Kernel, Kernel]:
    sizes = {"BELOW": below, "WIDTH": width}
    return (
        Kernel(kernels.band_factor, 4, **sizes),
        Kernel(kernels.band_solve, 2, **sizes),
        Kernel(kernels.band_solve_transposed, 2, **sizes),
    )


class BandElimination:
    """Elimination with partial pivoting in the band that the unknowns have in `order` and the equations in `rows`."""

    work_of_factor = 0
    """How many of the results of a factorization are no factors."""

    def __init__(self, pattern: Any, order: np.ndarray, rows: np.ndarray, below: int, above: int):
        self.size, self.order, self.rows = pattern.shape[0], _whole(order), _whole(rows)
        self.below, self.above = below, above
        self.width = 2 * below + above + 1 if below else above + 1
        self.kernels = _band_kernels(below, self.width)

    def tables(self, place_of: Any) -> tuple[np.ndarray, ...]:
        """What the factorization has to know of where values are: `place_of` is the pattern with the numbers of its entries,
        from 1, in the array of values."""
        turned = place_of[self.rows][:, self.order].tocsr()
        turned.sort_indices()
        counts = np.diff(turned.indptr)
        first = np.maximum(np.arange(self.size) - self.below, 0)
        places = turned.indices - np.repeat(first, counts)
        return _whole(turned.indptr), _whole(places), _whole(turned.data - 1)

    @property
    def factor_shapes(self) -> list[tuple[tuple[int, ...], type]]:
        """Shapes and types of U, L, the inverse pivots and the exchanged rows."""
        n = self.size
        return [
            (((n + self.below) * self.width,), np.float64), ((n * max(self.below, 1),), np.float64), ((n,), np.float64),
            ((n,), np.int32),
        ]  # fmt: skip

    @property
    def solve_tables(self) -> tuple[np.ndarray, ...]:
        """What a solution has to know besides the factors."""
        return self.order, self.rows

    @property
    def work(self) -> tuple[int, ...]:
        """Sizes of the arrays of numbers that a solution needs."""
        return (self.size + self.width + self.below,)

    @property
    def stats(self) -> dict[str, Any]:
        """What `Solution.stats` says of it."""
        solver = "tridiagonal" if self.below <= 1 and self.above <= 1 else "band"
        return {"solver": solver, "bandwidth": [self.below, self.above], "fill": self.size * self.width}

    @property
    def operations(self) -> int:
        """Multiplications of a factorization."""
        return self.size * self.below * self.width


_fixed_kernels = (
    Kernel(kernels.fixed_factor, 5), Kernel(kernels.fixed_solve, 2), Kernel(kernels.fixed_solve_transposed, 2),
)  # fmt: skip


class FixedElimination:
    """Elimination whose pivots are taken in an order found once: of least fill, and what has no diagonal after its neighbours,
    so that its pivot is made by theirs (the multipliers of a saddle point)."""

    work_of_factor = 2

    def __init__(self, pattern: Any, rows: np.ndarray, both: Any):
        self.size = pattern.shape[0]
        order = _after_neighbours(both, pattern[rows].diagonal(), _minimum_degree(both))
        self.order, self.rows, self.kernels = _whole(order), _whole(rows[order]), _fixed_kernels
        symmetric = both[order][:, order].tocsr()
        symmetric.sort_indices()
        n = self.size
        size, starts, columns = np.array([n]), _whole(symmetric.indptr), _whole(symmetric.indices)
        parent, mark, counts = np.zeros(n, np.int32), np.zeros(n, np.int32), np.zeros(n, np.int64)
        _count(starts, columns, size, parent, mark, counts)
        self.fill_starts = np.concatenate([[0], np.cumsum(counts)])
        total = int(self.fill_starts[-1])
        self.fill_rows, self.left = np.zeros(total, np.int32), np.zeros(total, np.int32)
        self.left_starts, self.left_places = np.zeros(n + 1, np.int64), np.zeros(total, np.int64)
        _list(
            starts, columns, parent, self.fill_starts, size, mark, np.zeros(n, np.int64),
            self.fill_rows, self.left_starts, self.left, self.left_places,
        )  # fmt: skip

    def tables(self, place_of: Any) -> tuple[np.ndarray, ...]:
        """What the factorization has to know: where values are, of which `place_of` has the numbers from 1, and the fill."""
        entries = place_of[self.rows][:, self.order].tocoo()
        pivot = np.minimum(entries.row, entries.col)
        places = np.where(entries.row >= entries.col, entries.row, -1 - entries.col)
        by_pivot = np.argsort(pivot, kind="stable")
        starts = np.concatenate([[0], np.cumsum(np.bincount(pivot, minlength=self.size))])
        return (
            _whole(starts), _whole(places[by_pivot]), _whole(entries.data[by_pivot] - 1),
            self.fill_starts, self.fill_rows, self.left_starts, self.left, self.left_places,
        )  # fmt: skip

    @property
    def factor_shapes(self) -> list[tuple[tuple[int, ...], type]]:
        """Shapes and types of two work arrays, L, U and the inverse pivots."""
        n, total = self.size, len(self.fill_rows)
        return [((n,), np.float64)] * 2 + [((total,), np.float64)] * 2 + [((n,), np.float64)]

    @property
    def solve_tables(self) -> tuple[np.ndarray, ...]:
        """What a solution has to know besides the factors."""
        return self.order, self.rows, self.fill_starts, self.fill_rows

    @property
    def work(self) -> tuple[int, ...]:
        """Sizes of the arrays of numbers that a solution needs."""
        return (self.size,)

    @property
    def stats(self) -> dict[str, Any]:
        """What `Solution.stats` says of it."""
        return {"solver": "fixed order", "fill": 2 * len(self.fill_rows) + self.size}

    @cached_property
    def operations(self) -> int:
        """Multiplications of a factorization."""
        counts = np.diff(self.fill_starts)
        return int(np.sum(counts * (counts + 1)))


def _minimum_degree(both: Any) -> np.ndarray:
    """An order of unknowns in which elimination makes little fill, as SuperLU finds it before it factors anything."""
    size = both.shape[0]
    numbers = sp.csc_matrix((np.ones(both.nnz), both.indices, both.indptr), both.shape)
    numbers = sp.csc_matrix(numbers + 1e3 * sp.identity(size, format="csc"))
    options: Any = {"SymmetricMode": True}
    found = spilu(numbers, 1.0, 1.0, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    order = np.empty(size, int)
    order[found.perm_c] = np.arange(size)
    return order


def _after_neighbours(both: Any, diagonal: np.ndarray, order: np.ndarray) -> np.ndarray:
    """The order in which an unknown without a diagonal comes after all its neighbours."""
    without = np.flatnonzero(~np.asarray(diagonal, bool))
    if not len(without):
        return order
    place = np.empty(len(order))
    place[order] = np.arange(len(order))
    has = np.ones(len(order), bool)
    has[without] = False
    near = both[without].tocoo()
    inner = has[near.col]
    latest = np.zeros(len(without))
    np.maximum.at(latest, near.row[inner], place[near.col[inner]])
    place[without] = np.maximum(place[without], latest + 0.5)
    return np.argsort(place, kind="stable")
