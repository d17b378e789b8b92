"""ExchangedElimination: rows are exchanged where a pivot would be small, for sparse matrices of any pattern."""

from functools import cached_property
from typing import Any

import numpy as np

from dirax.numerics.loops.kernel import Kernel
from dirax.numerics.sparse import exchanged_kernels
from dirax.numerics.sparse.orders import least_fill, whole

_factor = Kernel(exchanged_kernels.exchanged_factor, 15)
_solve = Kernel(exchanged_kernels.exchanged_solve, 2), Kernel(exchanged_kernels.exchanged_solve_transposed, 2)


class ExchangedElimination:
    """Elimination of columns in an order, with the largest pivots of each, in units of their rows, or those of `rows`, the
    equations beside the unknowns, where they are large enough. `matched` are rows with which the diagonal is full."""

    def __init__(self, pattern: Any, rows: np.ndarray, matched: np.ndarray):
        order, most = least_fill(pattern, matched)
        self.size, self.order, self.rows = pattern.shape[0], whole(order), whole(rows[order])
        self.most = most + self.size  # a column is written with its pivot before it is left out

    def tables(self, place_of: Any) -> tuple[np.ndarray, ...]:
        """What the factorization has to know: where values are, of which `place_of` has the numbers from 1."""
        columns = place_of.tocsc()[:, self.order]
        columns.sort_indices()
        return whole(columns.indptr), whole(columns.indices), whole(columns.data - 1), self.rows, np.array([self.most])

    @property
    def solve_tables(self) -> tuple[np.ndarray, ...]:
        """What a solution has to know besides the factors."""
        return (self.order,)

    def factors(self, xp: Any, tables: tuple, values: Any, size: Any) -> tuple:
        """L, U, the inverse pivots and the rows in turn, by NumPy or by JAX; nothing of them where `size` is [0]."""
        n, entries = self.size, ((self.most,), np.int32)
        numbers = (n,), np.float64
        ints, starts, triangle = ((n,), np.int32), ((n + 1,), np.int64), ((self.most,), np.float64)
        work = [numbers, numbers, ints, ints, ints, ((n,), np.int64), ints]
        found = [starts, entries, triangle, starts, entries, triangle, numbers, ints]
        return tuple(_factor.by(xp, [*work, *found], *tables, values, size)[len(work) :])

    def solution(self, xp: Any, tables: tuple, factors: tuple, right: Any, size: Any, transposed: bool) -> Any:
        """The solution with the matrix or its transpose."""
        numbers = (self.size,), np.float64
        return _solve[transposed].by(xp, [numbers, numbers], *tables, *factors, right, size)[-1]

    @property
    def seconds(self) -> float:
        """How long its loops have run for all matrices that are factored so."""
        return sum(kernel.seconds for kernel in (_factor, *_solve))

    @property
    def stats(self) -> dict[str, Any]:
        """What `Solution.stats` says of it."""
        return {"solver": "exchanged rows", "fill": 2 * self.most + self.size}

    @cached_property
    def operations(self) -> int:
        """Multiplications of a factorization, about."""
        share = self.most / max(self.size, 1)
        return int(self.size * share * (share + 1))
