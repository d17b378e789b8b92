"""FixedElimination: pivots are taken in an order found once, of least fill, as long as they are large enough."""

from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp

from dirax.numerics.loops.kernel import Kernel
from dirax.numerics.sparse import kernels
from dirax.numerics.sparse.exchanged import ExchangedElimination
from dirax.numerics.sparse.orders import fill, minimum_degree, whole

_factor = Kernel(kernels.fixed_factor, 7)
_solve = Kernel(kernels.fixed_solve, 2), Kernel(kernels.fixed_solve_transposed, 2)


class FixedElimination:
    """Elimination whose pivots are taken in an order found once: of least fill, and what has no diagonal after its neighbours,
    so that its pivot is made by theirs (the multipliers of a saddle point).

    A pivot that is small beside its column sends the matrix to the elimination that exchanges rows, for which `matched` are rows
    with which the diagonal is full.
    """

    def __init__(self, pattern: Any, matched: np.ndarray):
        both = sp.csr_matrix(pattern + pattern.T)
        self.size = pattern.shape[0]
        order = _after_neighbours(both, pattern.diagonal(), minimum_degree(both))
        self.order = whole(order)
        self.fill = fill(both, order)
        self.exchanged = ExchangedElimination(pattern, np.arange(self.size), matched)

    def tables(self, place_of: Any) -> tuple[np.ndarray, ...]:
        """What the factorization has to know: where values are, of which `place_of` has the numbers from 1, and the fill."""
        entries = place_of[self.order][:, self.order].tocoo()
        pivot = np.minimum(entries.row, entries.col)
        places = np.where(entries.row >= entries.col, entries.row, -1 - entries.col)
        by_pivot = np.argsort(pivot, kind="stable")
        starts = np.concatenate([[0], np.cumsum(np.bincount(pivot, minlength=self.size))])
        own = whole(starts), whole(places[by_pivot]), whole(entries.data[by_pivot] - 1), *self.fill
        return *own, *self.exchanged.tables(place_of)

    @property
    def solve_tables(self) -> tuple[np.ndarray, ...]:
        """What a solution has to know besides the factors."""
        return self.order, self.order, *self.fill[:2], *self.exchanged.solve_tables

    def factors(self, xp: Any, tables: tuple, values: Any, size: Any) -> tuple:
        """L, U and the inverse pivots, whether they are none (`size` or [0]), and those with exchanged rows where they are none;
        by NumPy or by JAX."""
        numbers, triangle = ((self.size,), np.float64), ((len(self.fill[1]),), np.float64)
        shapes = [numbers, numbers, numbers, triangle, triangle, numbers, ((1,), np.int64)]
        *_, lower, upper, inverse, left = _factor.by(xp, shapes, *tables[:8], values, size)
        return lower, upper, inverse, left, *self.exchanged.factors(xp, tables[8:], values, left)

    def solution(self, xp: Any, tables: tuple, factors: tuple, right: Any, size: Any, transposed: bool) -> Any:
        """The solution with the matrix or its transpose."""
        *own, left = factors[:4]
        numbers = (self.size,), np.float64
        found = _solve[transposed].by(xp, [numbers, numbers], *tables[:4], *own, right, size - left)[-1]
        return xp.where(left > 0, self.exchanged.solution(xp, tables[4:], factors[4:], right, left, transposed), found)

    @property
    def seconds(self) -> float:
        """How long its loops have run for all matrices that are factored so."""
        return sum(kernel.seconds for kernel in (_factor, *_solve)) + self.exchanged.seconds

    @property
    def stats(self) -> dict[str, Any]:
        """What `Solution.stats` says of it."""
        return {"solver": "fixed order", "fill": 2 * len(self.fill[1]) + self.size}

    @cached_property
    def operations(self) -> int:
        """Multiplications of a factorization."""
        counts = np.diff(self.fill[0])
        return int(np.sum(counts * (counts + 1)))


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
