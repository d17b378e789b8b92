"""BorderedElimination: a sparse matrix with a few rows and columns that are full."""

from functools import cached_property
from typing import Any

import numpy as np

MOST = 8
"""Rows and columns of a border."""


def full_lines(pattern: Any) -> tuple[np.ndarray, np.ndarray]:
    """The rows and the columns of a pattern that have far more entries than others; none where they are more than a few."""
    most = 64 + 4 * int(np.sqrt(pattern.shape[0]))
    rows, columns = (np.flatnonzero(np.bincount(of, minlength=pattern.shape[0]) > most) for of in pattern.nonzero())
    none = np.zeros(0, int)
    return (rows, columns) if len(rows) + len(columns) <= MOST else (none, none)


class BorderedElimination:
    """Elimination of a matrix [A C; R D] with the rows and columns of its border last: `core` factors A, and D − R A⁻¹ C, of a
    few rows, is inverted."""

    def __init__(self, size: int, core: Any, rows: np.ndarray, columns: np.ndarray):
        self.size, self.core, self.border, self.columns = size, core, rows, columns  # the border has as many columns as rows
        others = lambda lines: np.setdiff1d(np.arange(size), lines)
        self.inner_rows, self.inner_columns = others(rows), others(columns)

    def tables(self, place_of: Any) -> tuple[np.ndarray, ...]:
        """What the factorization has to know: where the values of C, R and D are, 0 for none, counted from 1; and what the core
        knows."""
        own, border, columns = place_of.tocsr(), self.border, self.columns
        inner, below = own[self.inner_rows], own[border]
        parts = inner[:, columns], below[:, self.inner_columns], below[:, columns]
        numbers = (part.toarray().astype(np.int64) for part in parts)
        return *numbers, *self.core.solve_tables, *self.core.tables(inner[:, self.inner_columns].tocsr())

    @property
    def solve_tables(self) -> tuple[np.ndarray, ...]:
        """What a solution has to know besides the factors."""
        return self.core.solve_tables

    def factors(self, xp: Any, tables: tuple, values: Any, size: Any) -> tuple:
        """A⁻¹C, (D − R A⁻¹C)⁻¹, R and the factors of the core, by NumPy or by JAX."""
        numbers, known, rest = tables[:3], tables[3 : 3 + len(self.solve_tables)], tables[3 + len(self.solve_tables) :]
        beside, below, corner = (xp.concatenate([xp.zeros(1), values])[places] for places in numbers)
        inner = size - len(self.border)
        core = self.core.factors(xp, rest, values, inner)
        solved = lambda column: self.core.solution(xp, known, core, column, inner, False)
        lifted = xp.stack([solved(beside[:, j]) for j in range(len(self.border))], axis=1)
        return lifted, _inverse(corner - below @ lifted, xp), below, *core

    def solution(self, xp: Any, tables: tuple, factors: tuple, right: Any, size: Any, transposed: bool) -> Any:
        """The solution with the matrix or its transpose."""
        (lifted, inverse, below), core, inner = factors[:3], factors[3:], size - len(self.border)
        solved = lambda b: self.core.solution(xp, tables, core, b, inner, transposed)
        if transposed:
            last = inverse.T @ (right[self.columns] - lifted.T @ right[self.inner_columns])
            first = solved(right[self.inner_columns] - below.T @ last)
            return xp.concatenate([first, last])[np.argsort(np.concatenate([self.inner_rows, self.border]))]
        first = solved(right[self.inner_rows])
        last = inverse @ (right[self.border] - below @ first)
        return xp.concatenate([first - lifted @ last, last])[np.argsort(np.concatenate([self.inner_columns, self.columns]))]

    @property
    def seconds(self) -> float:
        """How long its loops have run for all matrices that are factored so."""
        return self.core.seconds

    @property
    def stats(self) -> dict[str, Any]:
        """What `Solution.stats` says of it."""
        stats = self.core.stats
        return stats | {"border": len(self.border), "fill": stats["fill"] + 2 * self.size * len(self.border)}

    @cached_property
    def operations(self) -> int:
        """Multiplications of a factorization, about."""
        width = len(self.border)
        return self.core.operations + width * self.core.stats["fill"] + width**2 * self.size


def _inverse(matrix: Any, xp: Any) -> Any:
    try:
        return xp.linalg.inv(matrix)
    except np.linalg.LinAlgError:
        return xp.full(matrix.shape, xp.inf)
