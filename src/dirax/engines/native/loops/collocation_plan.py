"""What a kernel of collocation steps does: the relation at one node as scalar expressions, and how its unknowns are iterated."""

import functools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar

from dirax.engines.native.loops.record import Record
from dirax.engines.newton_step import Factors
from dirax.engines.pivot_order import pivot_order
from dirax.engines.step_program import Inputs
from dirax.program.graph import Graph
from dirax.program.graph_derivatives import jacobian
from dirax.program.rounding import rounding_nodes
from dirax.schemes.collocation_tables import Quadrature, Tableau

Rows = list[dict[int, int]]
"""Rows of a matrix, {column: node}."""


@dataclass
class TracedRelation:
    """A `StageRelation` as nodes: its inputs a, b, y, and ḃ and ρ as functions of them, of the time and of the parameters."""

    first: list[int]
    second: list[int]
    unknowns: list[int]
    rates: list[int]
    relation: list[int]


@dataclass
class CollocationPlan:
    """A fixed-point iteration for the rates y at the nodes, all nodes side by side.

    `solved` (α,) is y by one step of Newton's method at each node by itself, from a, b and the y before; where ρ is affine in y
    it is y, and does not need the one before. `carried` numbers the entries of b that ρ depends on. The others are sums that
    are formed once, at the end.

    With a `gain` ∂y/∂b (α, β) of parameters alone, and ḃ independent of y, the equation is one of second order, ä = F(a): then
    the iteration is for F, a_i = a_0 + c_i h ȧ_0 + h² Σ_j (A²)_ij F_j, which gains h² each time.
    """

    graph: Graph
    shared: Inputs
    relation: TracedRelation
    tableau: Tableau
    rows: list[tuple[str, list[int]]]
    solved: list[int] = field(default_factory=list)
    stable: int = -1
    gain: list[dict[int, int]] | None = None
    carried: list[int] = field(default_factory=list)
    terms: list[int] = field(default_factory=list)
    """How large what the iterates are made of is, however it cancels."""

    def __post_init__(self):
        g, r = self.graph, self.relation
        slopes = jacobian(g, r.relation, r.unknowns)
        at = r.relation
        if not depends(g, [n for row in slopes for n in row.values()], r.unknowns):
            at = substituted(g, at, dict.fromkeys(r.unknowns, g.zero))
            before = [g.zero] * len(r.unknowns)
        else:
            before = r.unknowns
        matrix = [[row.get(j, g.zero) for j in range(len(r.unknowns))] for row in slopes]
        factors = Factors(g, matrix, pivot_order(g, matrix), _row_units(g, matrix))
        self.stable = factors.stable
        self.solved = [g.sub(old, change) for old, change in zip(before, factors.solve(g, at), strict=True)]
        needed = set(g.reachable(self.solved))
        self.carried = [i for i, node in enumerate(r.second) if node in needed]
        self.gain = self._gain()
        self.terms = rounding_nodes(g, self.solved if self.gain is None else [self._gained(row) for row in self.gain])

    def _gained(self, row: dict[int, int]) -> int:
        g = self.graph
        return functools.reduce(g.add, (g.mul(slope, self.relation.rates[i]) for i, slope in sorted(row.items())), g.zero)

    def _gain(self) -> list[dict[int, int]] | None:
        g, r = self.graph, self.relation
        moving = [*r.first, *r.unknowns, self.shared.t]
        if not self.carried or depends(g, [*self.solved, self.stable], moving):
            return None
        if depends(g, [r.rates[i] for i in self.carried], r.unknowns):
            return None
        rows = jacobian(g, self.solved, r.second)
        return None if depends(g, [n for row in rows for n in row.values()], [*moving, *r.second]) else rows

    @functools.cached_property
    def pencil(self) -> tuple[list[dict[int, int]], ...]:
        """ρ_y, ρ_a + ρ_b ∂ḃ/∂y and ρ_b ∂ḃ/∂a, rows {column: node}: with the first, with h and with h² of Newton's method for
        all nodes. Raises `GraphTooLarge`."""
        g, r = self.graph, self.relation
        carried = [r.rates[i] for i in self.carried]
        by_carried = jacobian(g, r.relation, [r.second[i] for i in self.carried])

        through = functools.partial(_through, g, g.add, by_carried)
        linear = through(jacobian(g, carried, r.unknowns), [dict(row) for row in jacobian(g, r.relation, r.first)])
        square = through(jacobian(g, carried, r.first), [{} for _ in r.relation])
        return jacobian(g, r.relation, r.unknowns), linear, square

    @property
    def record(self) -> Record:
        """What is kept of a trajectory."""
        return record_of(self.relation, self.tableau)

    @property
    def outputs(self) -> list[int]:
        """Every node that the kernel computes for its own sake."""
        return [*self.solved, *self.relation.rates, *(node for _, nodes in self.rows for node in nodes)]

    @property
    def identity(self) -> tuple:
        """What tells two plans of equal graphs apart."""
        own = (self.relation, self.solved, self.stable, self.gain, self.carried, self.terms)
        return *own, self.rows, self.shared, self.tableau.stages, self.tableau.matrix.tolist()


@dataclass
class TracedMean:
    """A `MeanRelation` as nodes: inputs a, b, ȧ and means with the slopes and the rates as functions of them; and what is added
    at the end of a step as a function of a, b, of those after the sums (`after`) and of ȧ."""

    first: list[int]
    second: list[int]
    unknowns: list[int]
    means: list[int]
    after: list[int]
    slopes: list[int]
    rates: list[int]
    settled: list[int]


@dataclass
class MeanPlan:
    """A fixed-point iteration for the rates at the nodes by the means of slopes over the step: all points of the quadrature
    side by side, then all nodes."""

    graph: Graph
    shared: Inputs
    relation: TracedMean
    tableau: Tableau
    quadrature: Quadrature
    rows: list[tuple[str, list[int]]]
    terms: list[int] = field(default_factory=list)
    gain: ClassVar[None] = None

    def __post_init__(self):
        g, r = self.graph, self.relation
        sizes = {node: g.make("abs", node) for node in r.first}
        step = g.make("abs", self.shared.h)
        for _ in range(2):  # a at a node is made of rates, and has their roundings beside its own
            errors = sizes | dict(zip(r.means, rounding_nodes(g, r.slopes, sizes), strict=True))
            self.terms = rounding_nodes(g, r.rates[: len(r.first)], errors)
            sums = zip(r.first, self.terms, strict=True)
            sizes = {node: g.add(g.make("abs", node), g.mul(step, term)) for node, term in sums}

    @functools.cached_property
    def pencil(self) -> tuple[list[dict[int, int]], ...]:
        """1 − φ_m σ_y, −(φ_a + φ_m σ_a) and nothing, rows {column: node}, of the rates φ and the slopes σ: with the first, with h
        and with h² of Newton's method for all nodes. Raises `GraphTooLarge`."""
        g, r, n = self.graph, self.relation, len(self.relation.first)
        by_mean = jacobian(g, r.rates[:n], r.means)

        less = functools.partial(_through, g, g.sub, by_mean)
        own = [{j: g.neg(entry) for j, entry in row.items()} for row in jacobian(g, r.rates[:n], r.first)]
        constant = less(jacobian(g, r.slopes, r.unknowns), [{i: g.one} for i in range(n)])
        return constant, less(jacobian(g, r.slopes, r.first), own), [{} for _ in range(n)]

    @property
    def record(self) -> Record:
        """What is kept of a trajectory."""
        return record_of(self.relation, self.tableau)

    @property
    def outputs(self) -> list[int]:
        """Every node that the kernel computes for its own sake."""
        r = self.relation
        return [*r.slopes, *r.rates, *r.settled, *(node for _, nodes in self.rows for node in nodes)]

    @property
    def identity(self) -> tuple:
        """What tells two plans of equal graphs apart."""
        return self.relation, self.terms, self.rows, self.shared, self.tableau.matrix.tolist(), self.quadrature.means.tolist()


def _row_units(g: Graph, matrix: list[list[int]]) -> list[int] | None:
    """The roots of the entries m_ii of a matrix whose rows are paired with its columns, as forces with velocities: in these units
    of both the diagonal is 1. None where one of them is zero."""
    diagonal = [matrix[i][i] for i in range(len(matrix))]
    return None if g.zero in diagonal else [g.make("sqrt", g.make("abs", entry)) for entry in diagonal]


def record_of(relation: TracedRelation | TracedMean, tableau: Tableau) -> Record:
    """The iterates of the step before among the unknowns, and sums with their errors."""
    return Record(len(relation.first) + len(relation.second), 1, tableau.stages * len(relation.first), True)


def _through(g: Graph, plus: Callable[[int, int], int], by: Rows, slopes: Rows, begun: Rows) -> Rows:
    """Rows {column: node} that are begun, plus or minus the product of the rows `by` with those of `slopes`."""
    for row, factors in zip(begun, by, strict=True):
        for i, factor in factors.items():
            for j, slope in slopes[i].items():
                row[j] = plus(row.get(j, g.zero), g.mul(factor, slope))
    return begun


def depends(g: Graph, nodes: list[int], inputs: list[int]) -> bool:
    """Whether some node depends on some input."""
    return not set(inputs).isdisjoint(g.reachable(nodes))


def substituted(g: Graph, nodes: list[int], values: dict[int, int]) -> list[int]:
    """The nodes with inputs replaced by other nodes."""
    new = dict(values)
    for node in g.reachable(nodes):
        if node not in new:
            args = [new[a] for a in g.args[node]]
            changed = any(a != b for a, b in zip(args, g.args[node], strict=True))
            new[node] = g.make(g.op[node], *args) if changed else node
    return [new[node] for node in nodes]
