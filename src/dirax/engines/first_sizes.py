"""How large unknowns and equations are, by one linearization of the step in scalars: where that leaves no doubt, it is all that
has to be found.

The inverse of the Jacobian is bounded by the sizes of its triangular factors, whose pivots are those of a kernel. There is doubt
where these are too small, and where an unknown is not known to 4·STALLED of what it comes to: `sizes.py` looks closer then, as it
does for trajectories at which Newton's method stops too early.
"""

from functools import reduce

import numpy as np

from dirax.engines.newton_step import Factors, elimination
from dirax.engines.step_program import KEPT, StepProgram, TracedEquation
from dirax.engines.stopping import STALLED
from dirax.numerics.equilibration import LEAST_SIZE
from dirax.numerics.tolerances import EPSILON
from dirax.program.evaluation.in_numpy import Values, in_parts
from dirax.program.graph import Graph
from dirax.program.graph_derivatives import jacobian
from dirax.program.memo import Memo, Same
from dirax.program.rounding import rounding_nodes

TYPICAL = 2.0**-6
"""What a rounding comes to beside its bound, which all roundings of all terms would have to reach together."""

NOTHING = 2.0**-40
"""What is not the size of an unknown, beside the value at which it would matter: zero with the roundoff of zero."""

SOLVED = 1e-10
"""What a solution with good pivots leaves of a right-hand side, relative to its terms."""


class FirstSizes:
    """The sizes of one equation as nodes of a graph, which gains them: of the `unknowns`, of the `equations`, and `sure`, 1 where
    there is no doubt and 0 where there is; from its Jacobian, and the order of the pivots."""

    def __init__(self, graph: Graph, equation: TracedEquation, h: int, matrix: list[list[int]], order: list[tuple[int, int]]):
        g, unknowns, residual = graph, equation.unknowns, equation.residual
        self.graph = g
        size = lambda node: g.make("abs", node)
        total = lambda nodes: reduce(g.add, nodes, g.zero)
        rows, by_h = [{j: n for j, n in enumerate(row) if n != g.zero} for row in matrix], jacobian(g, residual, [h])
        factors = Factors(g, matrix, order)
        change = factors.solve(g, residual)
        solution = [size(g.sub(u, d)) for u, d in zip(unknowns, change, strict=True)]
        products = lambda row, values: [g.mul(size(row[j]), value) for j, value in enumerate(values) if j in row]
        rounded = rounding_nodes(g, residual)
        terms = [total([e, *products(row, solution)]) for e, row in zip(rounded, rows, strict=True)]
        known = factors.bounds(g, terms)
        moved = factors.bounds(g, [size(g.mul(h, row.get(0, g.zero))) for row in by_h])
        least = g.constant(LEAST_SIZE)
        own = [total([g.mul(g.constant(TYPICAL), a), size(u), least]) for a, u in zip(known, unknowns, strict=True)]
        equations = [g.add(total(products(row, own)), least) for row in rows]

        sure = g.make("finite", total([*own, *equations]))
        below = lambda a, b: g.make("and", sure, g.make("le", a, b))
        for a, m, u in zip(known, moved, solution, strict=True):
            blurred = g.mul(g.constant(EPSILON), a)
            reached = g.add(u, g.make("sqrt", g.mul(m, a)))
            sure = below(blurred, g.mul(g.constant(4.0 * STALLED), reached))
        for j, size_of in enumerate(own):
            matters = self._matters([(e, row[j]) for e, row in zip(rounded, rows, strict=True) if j in row])
            sure = below(g.mul(g.constant(NOTHING), matters), size_of)
        for r, row in zip(residual, matrix, strict=True):
            of_row = [g.mul(a, d) for a, d in zip(row, change, strict=True)]
            sure = below(size(g.sub(total(of_row), r)), g.mul(g.constant(SOLVED), total([size(r), *map(size, of_row)])))
        self.unknowns, self.equations, self.sure = own, equations, g.select(sure, g.one, g.zero)

    def _matters(self, where: list[tuple[int, int]]) -> int:
        """The least size at which an unknown matters in an equation with these terms and this derivative by it, or ∞."""
        g, least = self.graph, self.graph.constant(np.inf)
        for terms, slope in where:
            size = g.div(terms, g.make("abs", slope))
            least = g.make("min", least, g.select(g.make("lt", g.zero, size), size, least))
        return least

    @property
    def outputs(self) -> list[int]:
        """All of them."""
        return [*self.unknowns, *self.equations, self.sure]


_known: Memo[FirstSizes] = Memo(KEPT)


def first_sizes(program: StepProgram, index: int, *arguments: np.ndarray) -> np.ndarray:
    """The outputs of an equation of a step, (entries, 2k + 1); (u, state, t, h, parameters) have an axis of entries."""
    e, shared = program.equations[index], program.shared
    found = elimination(program, index)
    made = _known.get((Same(program), index), lambda: FirstSizes(program.graph.copy(), e, shared.h, *found))
    node = lambda nodes: np.asarray(nodes, dtype=np.int64)

    def part(arguments: list[np.ndarray]) -> list[np.ndarray]:
        known = Values(made.graph, len(arguments[0]))
        for nodes, array in zip((e.unknowns, e.state, shared.t, shared.h, shared.params), arguments, strict=True):
            known.bind(node(nodes), array)
        return [known.read(node(made.outputs))]

    return in_parts(part, list(arguments))[0]
