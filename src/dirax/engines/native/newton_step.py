"""The Newton correction as nodes: the Jacobian, and its elimination with a pivot order fixed beforehand."""

from dataclasses import dataclass

import numpy as np

from dirax.engines.native.graph import Graph
from dirax.engines.native.operations import jacobian
from dirax.engines.native.trace import TracedEquation

ADMISSIBLE = 0.1
"""A pivot is considered if it is at least this much of the largest entry of its column at the sample points."""

GUARD = 1e-4
"""In a run, a pivot smaller than this beside its column sends the step to partial pivoting."""

SAMPLES = 7


@dataclass
class Correction:
    """change = J⁻¹ residual; `stable` says at run time whether the fixed pivots were large enough."""

    jacobian: list[list[int]]
    change: list[int]
    stable: int
    order: list[tuple[int, int]]


def newton_correction(g: Graph, equation: TracedEquation) -> Correction:
    """The correction of one Newton iteration of an equation."""
    k = len(equation.unknowns)
    rows = jacobian(g, equation.residual, equation.unknowns)
    matrix = [[row.get(j, g.zero) for j in range(k)] for row in rows]
    order = pivot_order(g, matrix)
    change, stable = eliminate(g, matrix, equation.residual, order)
    return Correction(matrix, change, stable, order)


def pivot_order(g: Graph, matrix: list[list[int]]) -> list[tuple[int, int]]:
    """(row, column) of each pivot: the least fill-in (Markowitz) among entries that are not small at random points.

    The points depend on nothing but the graph, so that the order, and with it every bit of a trajectory, does not depend
    on initial data, parameters or neighbours in a batch.
    """
    k = len(matrix)
    pattern = np.array([[entry != g.zero for entry in row] for row in matrix]).reshape(k, k)
    values = np.abs(_samples(g, matrix))
    rows, columns, order = set(range(k)), set(range(k)), []
    values = np.where(np.isfinite(values), values, 0.0)
    while rows:
        best = None
        for j in sorted(columns):
            candidates = [i for i in sorted(rows) if pattern[i, j]]
            largest = np.max(values[:, candidates, j], axis=1) if candidates else None
            for i in candidates:
                assert largest is not None
                share = float(np.median(values[:, i, j] / np.where(largest > 0, largest, 1.0)))
                fill = (sum(pattern[i, c] for c in columns) - 1) * (len(candidates) - 1)
                cost = (share < ADMISSIBLE, fill, not g.is_constant(matrix[i][j]), -round(share, 3), j, i)
                best = min(best, (cost, i, j)) if best else (cost, i, j)
        if best is None:  # structurally singular: any order, the guard will see it
            order.extend(zip(sorted(rows), sorted(columns), strict=True))
            break
        _, i, j = best
        order.append((i, j))
        rows.remove(i)
        columns.remove(j)
        for other in rows:
            if pattern[other, j]:
                _eliminate_samples(values, pattern, i, j, other, columns)
    return order


def _eliminate_samples(values, pattern, i: int, j: int, other: int, columns: set[int]) -> None:
    """Sizes after elimination, as bounds of magnitude: |a| + |m b|."""
    pivot = np.where(values[:, i, j] > 0, values[:, i, j], 1.0)
    multiplier = values[:, other, j] / pivot
    for c in columns:
        if pattern[i, c]:
            values[:, other, c] = np.abs(values[:, other, c]) + multiplier * values[:, i, c]
            pattern[other, c] = True


def _samples(g: Graph, matrix: list[list[int]]) -> np.ndarray:
    k, random = len(matrix), np.random.default_rng(20230331)
    flat = [entry for row in matrix for entry in row]
    names = sorted(str(g.value[n]) for n in g.reachable(flat) if g.op[n] == "input")
    points = {name: random.uniform(0.3, 1.7, SAMPLES) for name in names}
    points["h"] = np.full(SAMPLES, 0.01)
    with np.errstate(all="ignore"):
        columns = g.evaluate(flat, points)
    return np.stack([np.broadcast_to(np.asarray(c, dtype=float), SAMPLES) for c in columns], axis=1).reshape(SAMPLES, k, k)


def eliminate(g: Graph, matrix: list[list[int]], right: list[int], order) -> tuple[list[int], int]:
    """Solution and guard of matrix x = right by elimination in the given pivot order."""
    a = [{j: entry for j, entry in enumerate(row) if entry != g.zero} for row in matrix]
    b, stable, inverses = list(right), g.true, {}
    remaining = set(range(len(matrix)))
    guard = g.constant(GUARD)
    for i, j in order:
        remaining.discard(i)
        pivot = a[i].get(j, g.zero)
        inverses[i] = inverse = g.recip(pivot)
        size = g.make("abs", pivot)
        for other in sorted(remaining):
            entry = a[other].pop(j, None)
            if entry is None:
                continue
            small = g.make("le", g.mul(guard, g.make("abs", entry)), size)
            stable = g.make("and", stable, small)
            factor = g.mul(entry, inverse)
            for c, upper in a[i].items():
                if c != j:
                    total = g.sub(a[other].get(c, g.zero), g.mul(factor, upper))
                    a[other][c] = total
            b[other] = g.sub(b[other], g.mul(factor, b[i]))
    x: dict[int, int] = {}
    for i, j in reversed(order):
        total = b[i]
        for c, upper in sorted(a[i].items()):
            if c != j:
                total = g.sub(total, g.mul(upper, x[c]))
        x[j] = g.mul(total, inverses[i])
    return [x[j] for j in range(len(matrix))], stable
