"""Linear equations A(x) y = b(x) for the rates y = (ẋ, u) of a system: their solutions, and the conditions on x for one.

What of A is constant is eliminated once and for all. Of the other equations, rows R and columns P whose square part is regular at
one point, as many as the rank, give the solution around it, and the other rows Z what is left over,

    A_RP y_P = b_R,   s = b_Z − A_ZP y_P,

smooth in x; s(x) = 0 is the condition b ∈ im A wherever A keeps its rank.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from dirax.numerics.tolerances import PIVOT
from dirax.program.linear_solves import solve
from dirax.program.tracing import once

THRESHOLD = 0.1
"""A pivot is at least this fraction of the largest entry left, in units of the rows and columns; among these, a sparse one."""

VANISHING = 1e-3
"""A square part whose smallest singular value is less, in units of its usual rows and columns, is no good choice there."""

REGULAR = 0.05
"""About the same of the pivots that were chosen at a point, from which on others are looked at."""


class Explicit(NamedTuple):
    """Equations with their constant part solved: y = w + K c with c (f,) free, functions of (x, params).

    `family` gives (w, K), `rest` the other equations (A', b') of c; `rank` counts those that were solved.
    """

    family: Callable
    rest: Callable
    rank: int


def explicit(equations: Callable, entries: np.ndarray, size: int) -> Explicit:
    """The equations (x, params) ↦ (A, b) solved for those of the first `size` unknowns that rows with constant coefficients
    of these determine. `entries` (r, n) are those of A, NaN where they depend on x."""
    constant = np.flatnonzero(np.all(np.isfinite(entries[:, :size]), axis=1))
    rows, columns = pivots(entries[constant, :size])
    rows = constant[rows]
    others, free = (np.setdiff1d(np.arange(n), taken) for n, taken in zip(entries.shape, (rows, columns), strict=True))
    inverse = np.linalg.inv(entries[np.ix_(rows, columns)])

    @once
    def family(x, params):
        matrix, right = equations(x, params)
        top = inverse @ jnp.concatenate([right[rows, None], -matrix[rows][:, free]], axis=1)
        whole = _whole(top, columns, free)
        return whole[:, 0], whole[:, 1:]

    @once
    def rest(x, params):
        (matrix, right), (w, basis) = equations(x, params), family(x, params)
        return matrix[others] @ basis, right[others] - matrix[others] @ w

    return Explicit(family, rest, len(rows))


def pivots(matrix: np.ndarray, rank: int | None = None, usual: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns, as many as the rank of the matrix, whose square part is regular; sparse ones first (Markowitz).

    Entries are measured by the rows and columns of `usual`, of the sizes that they have elsewhere, or of the matrix."""
    by_row, by_column = _sizes(np.abs(matrix) if usual is None else usual)
    left, rows, columns = matrix / by_row / by_column, [], []
    while left.size and (rank is None or len(rows) < rank):
        sizes = np.abs(left)
        if sizes.max() <= (PIVOT if rank is None else 0.0):
            break
        there = sizes > PIVOT
        fill = (there.sum(axis=1, keepdims=True) - 1) * (there.sum(axis=0, keepdims=True) - 1)
        i, j = np.unravel_index(np.argmin(np.where(sizes >= THRESHOLD * sizes.max(), fill, np.inf)), left.shape)
        rows.append(i)
        columns.append(j)
        left = left - np.outer(left[:, j], left[i] / left[i, j])
        left[i], left[:, j] = 0.0, 0.0
    return np.array(rows, int), np.array(columns, int)


def _sizes(entries: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The largest entry of each row (r, 1), and then of each column (1, f), 1 where all are zero."""
    positive = lambda sizes: np.where(sizes > 0.0, sizes, 1.0)
    by_row = positive(entries.max(axis=1, keepdims=True, initial=0.0))
    return by_row, positive((entries / by_row).max(axis=0, keepdims=True, initial=0.0))


def _whole(top, columns: np.ndarray, free: np.ndarray):
    """Solution and kernel of all unknowns, (n, 1 + f), where those of the solved `columns` are `top` and the others free."""
    return jnp.concatenate([top, np.eye(free.size, free.size + 1, 1)])[np.argsort(np.concatenate([columns, free]))]


@dataclass(frozen=True)
class Solved:
    """Equations of c (f,) with constant rank around a point, functions of (x, params): a `solution`, zero where it is free;
    the `conditions` s for there to be one, `count` of them; `kernel`, a basis (f, f − rank) of what is left free; `pivots`, the
    rows and the columns that were chosen."""

    solution: Callable
    conditions: Callable
    count: int
    kernel: Callable
    pivots: tuple[tuple[int, ...], tuple[int, ...]]

    def regular(self, matrix: np.ndarray, usual: np.ndarray) -> bool:
        """Whether the equations can be solved by these pivots where A is `matrix`, whose entries elsewhere are of the sizes
        `usual`."""
        by_row, by_column = _sizes(usual)
        core = (matrix / by_row / by_column)[np.ix_(*map(list, self.pivots))]
        return not core.size or bool(np.all(np.isfinite(core)) and np.linalg.svd(core, compute_uv=False)[-1] > VANISHING)


def solved(equations: Callable, matrix: np.ndarray, rank: int, entries: np.ndarray, usual: np.ndarray | None = None) -> Solved:
    """The equations (x, params) ↦ (A, b) around a point where A is `matrix` (r, f) and has this rank; `entries` (r, f) are
    those of A, NaN where they depend on x; `usual` as in `pivots`."""
    rows, columns = pivots(matrix, rank, usual)

    @once
    def whole(x, params):
        matrix, right = equations(x, params)
        return _by_pivots(matrix, right, matrix[rows][:, columns], rows, columns, entries)

    return _of(whole, matrix.shape[0] - len(rows), rows, columns)


def switching(choices: list[Solved], equations: Callable, entries: np.ndarray, usual: np.ndarray) -> Solved:
    """The equations solved by the first choice of pivots where it is regular, by the most regular one elsewhere: also inside a
    compiled run, along which a pivot may vanish."""
    if len(choices) == 1:
        return choices[0]
    places = [tuple(np.array(indices, int) for indices in choice.pivots) for choice in choices]
    by_row, by_column = _sizes(usual)
    rank = len(places[0][0])

    def regularity(core, rows, columns):
        """About the smallest singular value of the square part, in units of its usual rows and columns; 0 for one that is not."""
        scaled = lax.stop_gradient(core) / by_row[rows] / by_column[:, columns]
        if rank == 1:
            return jnp.abs(scaled[0, 0])
        inverse = jnp.max(jnp.abs(solve(scaled, jnp.eye(rank))))
        return jnp.where(jnp.isfinite(inverse), 1.0 / inverse, 0.0)

    @once
    def whole(x, params):
        matrix, right = equations(x, params)
        cores = [matrix[rows][:, columns] for rows, columns in places]
        sizes = [regularity(core, *place) for core, place in zip(cores, places, strict=True)]
        sizes[0] = jnp.where(sizes[0] >= REGULAR, jnp.inf, sizes[0])
        best, found = sizes[0], None
        for size, core, (rows, columns) in zip(sizes, cores, places, strict=True):
            chosen = size >= best
            # where it is not chosen nothing is divided by it, in derivatives neither
            own = _by_pivots(matrix, right, jnp.where(chosen, core, jnp.eye(rank)), rows, columns, entries)
            found = own if found is None else tuple(jnp.where(chosen, a, b) for a, b in zip(own, found, strict=True))
            best = jnp.maximum(best, size)
        assert found is not None
        return found

    return _of(whole, choices[0].count, *places[0])


def _by_pivots(matrix, right, core, rows: np.ndarray, columns: np.ndarray, entries: np.ndarray):
    """(solution and kernel (f, 1 + f − rank), conditions) by the square part `core` in these rows and columns."""
    (r, f), rank = matrix.shape, len(rows)
    others, free = np.setdiff1d(np.arange(r), rows), np.setdiff1d(np.arange(f), columns)
    zero = np.all(entries[others] == 0.0, axis=1)
    sides = jnp.concatenate([right[rows, None], -matrix[rows][:, free]], axis=1)
    top = solve(core, sides, apart=True) if rank > 1 else sides / core if rank else sides
    missed = matrix[others][:, columns] @ top[:, 0] if rank else jnp.zeros(others.size)
    return _whole(top, columns, free), right[others] - jnp.where(zero, 0.0, missed)


def _of(whole: Callable, count: int, rows: np.ndarray, columns: np.ndarray) -> Solved:
    return Solved(
        lambda x, params: whole(x, params)[0][:, 0],
        lambda x, params: whole(x, params)[1],
        count,
        lambda x, params: whole(x, params)[0][:, 1:],
        (tuple(rows.tolist()), tuple(columns.tolist())),
    )
