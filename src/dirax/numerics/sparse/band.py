"""BandElimination: partial pivoting in the band of a sparse matrix."""

from functools import cache
from typing import Any

import numpy as np

from dirax.numerics.loops.kernel import Kernel
from dirax.numerics.sparse import kernels
from dirax.numerics.sparse.orders import whole


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

    def __init__(self, pattern: Any, order: np.ndarray, rows: np.ndarray, below: int, above: int):
        self.size, self.order, self.rows = pattern.shape[0], whole(order), whole(rows)
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
        return whole(turned.indptr), whole(places), whole(turned.data - 1)

    @property
    def solve_tables(self) -> tuple[np.ndarray, ...]:
        """What a solution has to know besides the factors."""
        return self.order, self.rows

    def factors(self, xp: Any, tables: tuple, values: Any, size: Any) -> tuple:
        """U, L, the inverse pivots and the exchanged rows, by NumPy or by JAX."""
        n, numbers = self.size, np.float64
        shapes = [
            (((n + self.below) * self.width,), numbers), ((n * max(self.below, 1),), numbers), ((n,), numbers), ((n,), np.int32),
        ]  # fmt: skip
        return tuple(self.kernels[0].by(xp, shapes, *tables, values, size))

    def solution(self, xp: Any, tables: tuple, factors: tuple, right: Any, size: Any, transposed: bool) -> Any:
        """The solution with the matrix or its transpose."""
        shapes = [((count,), np.float64) for count in (self.size + self.width + self.below, self.size)]
        return self.kernels[1 + transposed].by(xp, shapes, *tables, *factors, right, size)[-1]

    @property
    def seconds(self) -> float:
        """How long its loops have run for all matrices that are factored so."""
        return sum(kernel.seconds for kernel in self.kernels)

    @property
    def stats(self) -> dict[str, Any]:
        """What `Solution.stats` says of it."""
        solver = "tridiagonal" if self.below <= 1 and self.above <= 1 else "band"
        return {"solver": solver, "bandwidth": [self.below, self.above], "fill": self.size * self.width}

    @property
    def operations(self) -> int:
        """Multiplications of a factorization."""
        return self.size * self.below * self.width
