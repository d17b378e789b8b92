"""The corrections of Newton's method as nodes: the Jacobian, and its elimination with a pivot order fixed beforehand."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce

import numpy as np

from dirax.engines.blocks import blocks
from dirax.engines.pivot_order import Order, pivot_order, symmetric_signs
from dirax.engines.step_program import KEPT, StepProgram, TracedEquation
from dirax.program.graph import Graph
from dirax.program.memo import Memo, Same

GUARD = 1e-4
"""In a run, a pivot smaller than this beside its column sends the step to partial pivoting."""

FORGIVEN = 1e-6
"""The same for an update of Newton's method, which is measured by the residual after it: 1e6 roundings in it do no harm."""


@dataclass
class Correction:
    """change = J⁻¹ residual for a part of the unknowns of an equation; `stable` says at run time whether the fixed pivots were
    large enough.

    `again` is J⁻¹ applied to another right-hand side, the inputs `right`, from the same `factors`.
    """

    places: list[int]
    """Which of the equation's unknowns these are."""
    unknowns: list[int]
    residual: list[int]
    jacobian: list[list[int]]
    change: list[int]
    stable: int
    right: list[int]
    again: list[int]
    factors: list[int]
    rows: list[int]
    """How large the terms of the equations are, Σ|J_ij|(|u_j| + size_j), which has their units."""
    linear: bool
    """Whether the Jacobian does not depend on the unknowns: the second update leaves roundoff alone."""

    @property
    def outputs(self) -> list[int]:
        """What an update of the first kind takes."""
        return [*self.change, *self.factors, self.stable]


@dataclass
class Corrections:
    """How the unknowns of an equation are found: block after block, each with the unknowns of those before it known. A block has
    several parts where its equations hold the unknowns of later parts only weakly: an update goes over them in turn.

    `jacobian` and `order` are the whole matrix and the order of its pivots.
    """

    jacobian: list[list[int]]
    order: Order
    sizes: list[int]
    """The inputs that say how large the unknowns are."""
    blocks: list[list[Correction]]


def newton_corrections(g: Graph, program: StepProgram, index: int, whole: bool = False) -> Corrections:
    """The corrections of Newton's method of an equation of a step, in a graph that begins as that of the step; with the `whole`
    Jacobian, or without the entries that the step says are weak."""
    equation = program.equations[index]
    if not equation.unknowns:
        return Corrections([], [], [], [])
    matrix, order = elimination(program, index)
    pivots = [[part] for part in order] if whole else _parts(program, index)
    sizes = [g.input(f"size{i}") for i in range(len(matrix))]
    present = [g.add(g.make("abs", u), size) for u, size in zip(equation.unknowns, sizes, strict=True)]
    return Corrections(
        matrix, order, sizes, [[_correction(g, equation, matrix, part, present) for part in block] for block in pivots]
    )


def _correction(
    g: Graph, equation: TracedEquation, matrix: list[list[int]], order: list[tuple[int, int]], present: list[int]
) -> Correction:
    """That of a part of a block; `present` are the sizes of all unknowns and their values together."""
    equations, places = sorted(i for i, _ in order), sorted(j for _, j in order)
    inside = [(equations.index(i), places.index(j)) for i, j in order]
    own, signs = _mirrored(g, [[matrix[i][j] for j in places] for i in equations], inside)
    residual = [_signed(g, sign, equation.residual[i]) for i, sign in zip(equations, signs, strict=True)]
    rows = terms_of_rows(g, own, [present[j] for j in places])
    factors = Factors(g, own, [inside], rows, FORGIVEN)
    right = [g.input(f"right{i}") for i in equations]
    unknowns, again = [equation.unknowns[j] for j in places], factors.solve(g, right)
    change = factors.solve(g, residual)
    linear = set(g.reachable([entry for row in own for entry in row])).isdisjoint(unknowns)
    return Correction(places, unknowns, residual, own, change, factors.stable, right, again, sorted(factors.nodes), rows, linear)


def _mirrored(g: Graph, matrix: list[list[int]], order: list[tuple[int, int]]) -> tuple[list[list[int]], list[int]]:
    """(matrix, signs): where pivots are on the diagonal of a matrix that is symmetric but for the signs of its rows, that of the
    rows times their signs, its lower half by the nodes of the upper one."""
    k = len(matrix)
    signs = symmetric_signs(g, matrix) if all(i == j for i, j in order) else None
    if signs is None:
        return matrix, [1] * k
    upper = [[_signed(g, signs[i], matrix[i][j]) if j >= i else g.zero for j in range(k)] for i in range(k)]
    return [[upper[min(i, j)][max(i, j)] for j in range(k)] for i in range(k)], signs


def _signed(g: Graph, sign: int, node: int) -> int:
    return node if sign > 0 else g.neg(node)


def terms_of_rows(g: Graph, matrix: list[list[int]], present: list[int]) -> list[int]:
    """How large the terms of equations are, Σ|J_ij|·present_j, from the rows of the Jacobian and how large the unknowns are."""
    terms = lambda row: [g.mul(g.make("abs", entry), p) for entry, p in zip(row, present, strict=True) if entry != g.zero]
    return [reduce(g.add, terms(row), g.zero) for row in matrix]


_known: Memo[tuple] = Memo(KEPT)


def elimination(program: StepProgram, index: int) -> tuple[list[list[int]], Order]:
    """The Jacobian of an equation of a step, and the order of its pivots by blocks. Raises `GraphTooLarge`."""

    def made():
        matrix = _jacobian(program, index)
        return matrix, pivot_order(program.graph, matrix, _blocks(program, index, matrix))

    return _known.get((Same(program), index), made)


def _parts(program: StepProgram, index: int) -> list[Order]:
    """For each block of unknowns the order of the pivots of each of its parts."""
    g, equation = program.graph, program.equations[index]
    matrix, order = elimination(program, index)
    if not equation.weak:
        return [[part] for part in order]
    weak = {(i, j) for rows, columns in equation.weak for i in rows for j in columns}
    there = np.array([[entry != g.zero and (i, j) not in weak for j, entry in enumerate(row)] for i, row in enumerate(matrix)])
    found = []
    for block in order:
        rows, columns = sorted(i for i, _ in block), sorted(j for _, j in block)
        parts = [([rows[i] for i in r], [columns[j] for j in c]) for r, c in blocks(there[np.ix_(rows, columns)])]
        found.append(pivot_order(g, matrix, parts) if len(parts) > 1 else [block])
    return found


def _jacobian(program: StepProgram, index: int) -> list[list[int]]:
    g, rows = program.graph, program.jacobians[index]
    return [[row.get(j, g.zero) for j in range(len(rows))] for row in rows]


def _blocks(program: StepProgram, index: int, matrix: list[list[int]]) -> list[tuple[list[int], list[int]]]:
    """(rows, columns) of the blocks of unknowns; all together where the equations of one cannot be evaluated before the unknowns
    of later ones are known: an equation may have one in it by which its derivative is zero, such as the sign of it."""
    g, equation = program.graph, program.equations[index]
    found, later = blocks(np.array(matrix, int).reshape(len(matrix), len(matrix)) != g.zero), set(equation.unknowns)
    for rows, columns in found[:-1]:
        later -= {equation.unknowns[j] for j in columns}
        if not later.isdisjoint(g.reachable([equation.residual[i] for i in rows])):
            return [(list(range(len(matrix))), list(range(len(matrix))))]
    return found


class Factors:
    """Elimination of a matrix in a given pivot order, block after block: multipliers, upper rows, reciprocal pivots and the
    guard, for which rows are divided by their `sizes` if these are given. Blocks are not eliminated from those after them."""

    def __init__(
        self,
        g: Graph,
        matrix: list[list[int]],
        order: Order,
        sizes: list[int] | None = None,
        least: float = GUARD,
    ):
        self.order = order
        self.upper = [{j: entry for j, entry in enumerate(row) if entry != g.zero} for row in matrix]
        self.multipliers: list[list[tuple[int, int, int]]] = []
        self.inverses: dict[int, int] = {}
        self.stable = g.true
        for block in order:
            self.multipliers.append([])
            self._eliminate(g, block, sizes, least)

    def _eliminate(self, g: Graph, block: list[tuple[int, int]], sizes: list[int] | None, least: float) -> None:
        a, remaining, columns = self.upper, {i for i, _ in block}, {j for _, j in block}
        for i, j in block:
            remaining.discard(i)
            columns.discard(j)
            pivot = a[i].get(j, g.zero)
            self.inverses[i] = g.recip(pivot)
            guard = g.constant(least) if sizes is None else g.mul(g.constant(least), sizes[i])
            known: dict[tuple[int, ...], int] = {}
            for other in sorted(remaining):
                entry = a[other].pop(j, None)
                if entry is None:
                    continue
                factor = g.mul(entry, self.inverses[i])
                small = g.make("le", g.mul(guard, g.make("abs", factor)), g.one if sizes is None else sizes[other])
                self.stable = g.make("and", self.stable, small)
                self.multipliers[-1].append((other, i, factor))
                for c, upper in a[i].items():
                    if c in columns:
                        old = a[other].get(c, g.zero)
                        both = old, *sorted((entry, upper))  # of symmetric matrices half of the entries
                        if both not in known:
                            known[both] = g.sub(old, g.mul(factor, upper))
                        a[other][c] = known[both]

    @property
    def nodes(self) -> set[int]:
        """What has to be kept for another right-hand side."""
        kept = {factor for block in self.multipliers for *_, factor in block} | set(self.inverses.values())
        return kept | {entry for block in self.order for i, j in block for c, entry in self.upper[i].items() if c != j}

    def solve(self, g: Graph, right: list[int]) -> list[int]:
        """The solution for a right-hand side."""
        return self._substituted(g, right, g.sub, lambda node: node)

    def bounds(self, g: Graph, right: list[int]) -> list[int]:
        """Bounds of the solution for right-hand sides of these sizes, from the sizes of the factors."""
        return self._substituted(g, right, g.add, lambda node: g.make("abs", node))

    def _substituted(self, g: Graph, right: list[int], less: Callable[[int, int], int], of: Callable[[int], int]) -> list[int]:
        """Forwards and backwards in each block, which the unknowns of those before it are moved to the right of."""
        b, x = list(right), {}
        for block, multipliers in zip(self.order, self.multipliers, strict=True):
            for i, _ in block:
                for c, entry in sorted(self.upper[i].items()):
                    b[i] = less(b[i], g.mul(of(entry), x[c])) if c in x else b[i]
            own = {j for _, j in block}
            for row, pivot_row, factor in multipliers:
                b[row] = less(b[row], g.mul(of(factor), b[pivot_row]))
            for i, j in reversed(block):
                total = b[i]
                for c, upper in sorted(self.upper[i].items()):
                    if c != j and c in own:
                        total = less(total, g.mul(of(upper), x[c]))
                x[j] = g.mul(total, of(self.inverses[i]))
        return [x[j] for j in range(len(right))]
