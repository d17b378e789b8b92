"""The Newton correction as nodes: the Jacobian, and its elimination with a pivot order fixed beforehand."""

from dataclasses import dataclass
from functools import reduce

import numpy as np

from dirax.engines.step_program import KEPT, StepProgram
from dirax.program.graph import Graph
from dirax.program.memo import Memo, Same

ADMISSIBLE = 0.1
"""A pivot is considered if it is at least this much of the largest entry of its column at the sample points."""

GUARD = 1e-4
"""In a run, a pivot smaller than this beside its column sends the step to partial pivoting."""

FORGIVEN = 1e-6
"""The same for an update of Newton's method, which is measured by the residual after it: 1e6 roundings in it do no harm."""

SAMPLES = 7


@dataclass
class Correction:
    """change = J⁻¹ residual; `stable` says at run time whether the fixed pivots were large enough.

    `again` is J⁻¹ applied to another right-hand side, the inputs `right`, from the same `factors`.
    """

    jacobian: list[list[int]]
    change: list[int]
    stable: int
    order: list[tuple[int, int]]
    right: list[int]
    again: list[int]
    factors: list[int]
    sizes: list[int]
    """The inputs that say how large the unknowns are."""
    rows: list[int]
    """How large the terms of the equations are, Σ|J_ij|(|u_j| + size_j), which has their units."""


def newton_correction(g: Graph, program: StepProgram, index: int) -> Correction:
    """The correction of one Newton iteration of an equation of a step, in a graph that begins as that of the step."""
    equation = program.equations[index]
    k = len(equation.unknowns)
    if k == 0:
        return Correction([], [], g.true, [], [], [], [], [], [])
    matrix, order = elimination(program, index)
    sizes = [g.input(f"size{i}") for i in range(k)]
    present = [g.add(g.make("abs", u), size) for u, size in zip(equation.unknowns, sizes, strict=True)]
    terms = lambda row: [g.mul(g.make("abs", entry), u) for entry, u in zip(row, present, strict=True) if entry != g.zero]
    rows = [reduce(g.add, terms(row), g.zero) for row in matrix]
    factors = Factors(g, matrix, order, rows, FORGIVEN)
    right = [g.input(f"right{i}") for i in range(k)]
    again = factors.solve(g, right)
    return Correction(
        matrix, factors.solve(g, equation.residual), factors.stable, order, right, again, sorted(factors.nodes), sizes, rows
    )


_known: Memo[tuple] = Memo(KEPT)


def elimination(program: StepProgram, index: int) -> tuple[list[list[int]], list[tuple[int, int]]]:
    """The Jacobian of an equation of a step, and the order of its pivots. Raises `GraphTooLarge`."""

    def made():
        g, rows = program.graph, program.jacobians[index]
        matrix = [[row.get(j, g.zero) for j in range(len(rows))] for row in rows]
        return matrix, pivot_order(g, matrix)

    return _known.get((Same(program), index), made)


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


class Factors:
    """Elimination of a matrix in a given pivot order: multipliers, upper rows, reciprocal pivots and the guard, for which rows
    are divided by their `sizes` if these are given."""

    def __init__(
        self,
        g: Graph,
        matrix: list[list[int]],
        order: list[tuple[int, int]],
        sizes: list[int] | None = None,
        least: float = GUARD,
    ):
        self.order = order
        self.upper = [{j: entry for j, entry in enumerate(row) if entry != g.zero} for row in matrix]
        self.multipliers: list[tuple[int, int, int]] = []
        self.inverses: dict[int, int] = {}
        self.stable = g.true
        a, remaining = self.upper, set(range(len(matrix)))
        for i, j in order:
            remaining.discard(i)
            pivot = a[i].get(j, g.zero)
            self.inverses[i] = g.recip(pivot)
            guard = g.constant(least) if sizes is None else g.mul(g.constant(least), sizes[i])
            for other in sorted(remaining):
                entry = a[other].pop(j, None)
                if entry is None:
                    continue
                factor = g.mul(entry, self.inverses[i])
                small = g.make("le", g.mul(guard, g.make("abs", factor)), g.one if sizes is None else sizes[other])
                self.stable = g.make("and", self.stable, small)
                self.multipliers.append((other, i, factor))
                for c, upper in a[i].items():
                    if c != j:
                        a[other][c] = g.sub(a[other].get(c, g.zero), g.mul(factor, upper))

    @property
    def nodes(self) -> set[int]:
        """What has to be kept for another right-hand side."""
        kept = {factor for *_, factor in self.multipliers} | set(self.inverses.values())
        return kept | {entry for i, j in self.order for c, entry in self.upper[i].items() if c != j}

    def solve(self, g: Graph, right: list[int]) -> list[int]:
        """The solution for a right-hand side."""
        b = list(right)
        for row, pivot_row, factor in self.multipliers:
            b[row] = g.sub(b[row], g.mul(factor, b[pivot_row]))
        x: dict[int, int] = {}
        for i, j in reversed(self.order):
            total = b[i]
            for c, upper in sorted(self.upper[i].items()):
                if c != j:
                    total = g.sub(total, g.mul(upper, x[c]))
            x[j] = g.mul(total, self.inverses[i])
        return [x[j] for j in range(len(right))]

    def bounds(self, g: Graph, right: list[int]) -> list[int]:
        """Bounds of the solution for right-hand sides of these sizes, from the sizes of the factors."""
        size = lambda node: g.make("abs", node)
        b, x = list(right), {}
        for row, pivot_row, factor in self.multipliers:
            b[row] = g.add(b[row], g.mul(size(factor), b[pivot_row]))
        for i, j in reversed(self.order):
            total = b[i]
            for c, upper in sorted(self.upper[i].items()):
                if c != j:
                    total = g.add(total, g.mul(size(upper), x[c]))
            x[j] = g.mul(total, size(self.inverses[i]))
        return [x[j] for j in range(len(right))]
