"""The order of the pivots of a matrix of nodes, fixed beforehand.

An entry that is large at some points of a run is zero at others: a constraint's, by a coordinate, where the body has turned. The
pivots of matrices [M, ∓Gᵀ; G, 0] with a positive definite M are never so, masses first and then constraints, each on the
diagonal (a quasidefinite matrix has LDLᵀ: Vanderbei, SIAM J. Optim. 5, 1995), and such a matrix is half as much work.
"""

import numpy as np

from dirax.engines.blocks import blocks
from dirax.program.equal_nodes import PRIME, values_modulo_prime
from dirax.program.graph import Graph

ADMISSIBLE = 0.9
"""A pivot is considered if it is at least this much of the largest entry of its column at the sample points: less than that saves
a twentieth of the operations, and fails where masses of 100 and .1 stand in a matrix."""

SAMPLES = 7
ROUNDOFF = 1e-9
"""What is left of an entry of the diagonal at the sample points, beside it, if it is only roundoff."""

Order = list[list[tuple[int, int]]]
"""(row, column) of each pivot, in parts of which none has unknowns of those after it."""


def pivot_order(g: Graph, matrix: list[list[int]], parts: list[tuple[list[int], list[int]]] | None = None) -> Order:
    """The order of the pivots of each of the `parts` (rows, columns) of a matrix, its blocks if they are not given: the least
    fill-in (Markowitz) on the diagonal of parts that are quasidefinite, and else among entries that are not small at random
    points.

    The points depend on nothing but the graph, so that the order, and with it every bit of a trajectory, does not depend
    on initial data, parameters or neighbours in a batch.
    """
    k = len(matrix)
    there = np.array([[entry != g.zero for entry in row] for row in matrix], bool).reshape(k, k)
    constant = np.array([[g.is_constant(entry) for entry in row] for row in matrix], bool).reshape(k, k)
    values = _samples(g, matrix)
    values = np.where(np.isfinite(values), values, 0.0)
    found = []
    for rows, columns in blocks(there) if parts is None else parts:
        block = np.ix_(rows, columns)
        inside = values[:, *block]
        largest = np.abs(inside).max(axis=2, keepdims=True)  # the units of the equations
        signs = symmetric_signs(g, [[matrix[i][j] for j in columns] for i in rows])
        order = _order_on_diagonal(there[block], signs, inside)
        order = order or _order_of_block(there[block], constant[block], inside / np.where(largest > 0, largest, 1.0))
        found.append([(rows[i], columns[j]) for i, j in order])
    return found


def _order_of_block(there: np.ndarray, constant: np.ndarray, values: np.ndarray) -> list[tuple[int, int]]:
    """The order of a matrix: where it is not zero, where it is constant, and its values at the sample points, at which entries
    that always cancel are seen to do so."""
    k = len(there)
    rows, columns, order = np.arange(k), np.arange(k), []
    while len(rows):
        here = np.ix_(rows, columns)
        i, j = np.nonzero(there[here])
        if not len(i):  # structurally singular: any order, the guard will see it
            order.extend(zip(rows.tolist(), columns.tolist(), strict=True))
            break
        present = np.abs(values[:, *here])
        largest = present.max(axis=1)
        shares = np.median(present / np.where(largest > 0, largest, 1.0)[:, None], axis=0)[i, j]
        fill = (there[here].sum(axis=1) - 1)[i] * (there[here].sum(axis=0) - 1)[j]
        best = np.lexsort((i, j, -np.round(shares, 3), ~constant[here][i, j], fill, shares < ADMISSIBLE))[0]
        i, j = rows[i[best]], columns[j[best]]
        order.append((int(i), int(j)))
        rows, columns = rows[rows != i], columns[columns != j]
        others, along = rows[there[rows, j]], columns[there[i, columns]]
        block, pivot = np.ix_(others, along), values[:, i, j]
        multipliers = values[:, others, j] / np.where(pivot != 0, pivot, 1.0)[:, None]
        values[:, *block] -= multipliers[:, :, None] * values[:, i, along][:, None]
        there[block] = True
    return order


def symmetric_signs(g: Graph, matrix: list[list[int]]) -> list[int] | None:
    """Signs s of the rows with which the matrix s_i A_ij is symmetric, whatever its inputs are, or None."""
    k, signs = len(matrix), [0] * len(matrix)
    value = values_modulo_prime(g, g.reachable([entry for row in matrix for entry in row]))
    for first in range(k):
        signs[first] = signs[first] or 1
        waiting = [first]
        while waiting:
            i = waiting.pop()
            for j in range(k):
                a, b = value[matrix[i][j]], value[matrix[j][i]]
                if a == b == 0:
                    continue
                sign = signs[i] if a == b else -signs[i]
                if (a != b and a + b != PRIME) or signs[j] == -sign:
                    return None
                if not signs[j]:
                    signs[j] = sign
                    waiting.append(j)
    return signs


def _order_on_diagonal(there: np.ndarray, signs: list[int] | None, values: np.ndarray) -> list[tuple[int, int]]:
    """The order of a matrix that is symmetric but for the `signs` of its rows, and at the sample points quasidefinite, as masses
    with constraints are: the least fill-in among what is positive on the diagonal, and what is not, once all that is positive
    beside it has been eliminated, so that its pivot is negative. None of them vanishes wherever the matrix is of that kind. There
    are no pivots for other matrices."""
    if signs is None or not np.isfinite(values).all():
        return []
    k, there, order = len(there), there.copy(), []
    diagonal = np.diagonal(values, axis1=1, axis2=2) * signs
    most = 1.0 if np.sign(diagonal).sum() > 0.0 else -1.0
    values, diagonal = most * values * np.array(signs)[:, None], most * diagonal
    positive = diagonal.min(axis=0) > 0.0
    waits_for = [set(np.flatnonzero(there[i] & positive & ~positive[i]).tolist()) for i in range(k)]
    left = set(range(k))
    while left:
        i = min((i for i in sorted(left) if left.isdisjoint(waits_for[i])), key=lambda i: there[i].sum())
        left.remove(i)
        pivot = values[:, i, i] if positive[i] else -values[:, i, i]
        if not (pivot > ROUNDOFF * np.abs(diagonal[:, i])).all():
            return []
        others = np.flatnonzero(there[i] & (np.arange(k) != i))
        block = np.ix_(others, others)
        values[:, *block] -= values[:, others, i, None] * (values[:, i, others] / values[:, i, i, None])[:, None]
        there[block], there[i], there[:, i] = True, False, False
        order.append((i, i))
    return order


def _samples(g: Graph, matrix: list[list[int]]) -> np.ndarray:
    """The values (SAMPLES, k, k) of the entries."""
    k, random = len(matrix), np.random.default_rng(20230331)
    flat = np.array(matrix, np.int64).ravel()
    entries, number = np.unique(flat, return_inverse=True)
    names = sorted(str(g.value[n]) for n in g.reachable(entries.tolist()) if g.op[n] == "input")
    points = {name: random.uniform(0.3, 1.7, SAMPLES) for name in names}
    points["h"] = np.full(SAMPLES, 0.01)
    with np.errstate(all="ignore"):
        columns = g.evaluate(entries.tolist(), points)
    values = np.stack([np.broadcast_to(np.asarray(c, dtype=float), SAMPLES) for c in columns], axis=1)
    return values[:, number].reshape(SAMPLES, k, k)
