"""What a kernel of collocation steps does: the relation at one node as scalar expressions, and how its unknowns are iterated."""

from dataclasses import dataclass, field

from dirax.engines.native.loops.newton_step import Factors, pivot_order
from dirax.engines.native.loops.record import Record
from dirax.engines.step_program import Inputs
from dirax.program.graph import Graph
from dirax.program.graph_derivatives import jacobian
from dirax.schemes.collocation_tables import Tableau


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
        factors = Factors(g, matrix, pivot_order(g, matrix))
        self.stable = factors.stable
        self.solved = [g.sub(old, change) for old, change in zip(before, factors.solve(g, at), strict=True)]
        needed = set(g.reachable(self.solved))
        self.carried = [i for i, node in enumerate(r.second) if node in needed]
        self.gain = self._gain()

    def _gain(self) -> list[dict[int, int]] | None:
        g, r = self.graph, self.relation
        moving = [*r.first, *r.unknowns, self.shared.t]
        if not self.carried or depends(g, [*self.solved, self.stable], moving):
            return None
        if depends(g, [r.rates[i] for i in self.carried], r.unknowns):
            return None
        rows = jacobian(g, self.solved, r.second)
        return None if depends(g, [n for row in rows for n in row.values()], [*moving, *r.second]) else rows

    @property
    def record(self) -> Record:
        """What is kept of a trajectory: the iterates of the step before among the unknowns, and sums with their errors."""
        r = self.relation
        return Record(len(r.first) + len(r.second), 1, self.tableau.stages * len(r.first), True)


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
