"""How large unknowns are, by one linearization of the step in scalars: where that leaves no doubt, it is all that
has to be found.

The inverse of the Jacobian is bounded by the sizes of its triangular factors, whose pivots are those of a kernel. There is doubt
where these are too small, where an unknown is not known to 4·STALLED of what it comes to, and where the step is so far from
linear that what solves its linearization says nothing: `sizes.py` looks closer then, as it does for trajectories at which
Newton's method stops too early.
"""

from dataclasses import dataclass
from functools import reduce

import numpy as np

from dirax.engines.newton_step import Factors, elimination
from dirax.engines.stage_look import RESIDUAL, SLOPES, TERMS, stage_look
from dirax.engines.step_program import KEPT, StepProgram, TracedEquation, nodes_array
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

LOOSE = 2.0**8
"""What is too much for the size of an unknown, beside the least value at which it would matter: a bound that is far too large."""

OFF, FAR = 2.0**-4, 2.0**16
"""Residuals of a first guess that is off, beside their terms; and sizes of unknowns there, beside their values, that may be those
of the guess alone."""

LEFT = 0.5
"""What is left of a residual, or OFF of its terms, at the solution of a linearization that says how large unknowns are."""

SOLVED = 1e-10
"""What a solution with good pivots leaves of a right-hand side, relative to its terms."""


@dataclass(frozen=True)
class Linearized:
    """Nodes of a graph: the unknowns and h; the residual, its derivatives by the unknowns and by h, the sizes of its terms."""

    unknowns: list[int]
    h: int
    residual: list[int]
    matrix: list[list[int]]
    by_h: list[int]
    terms: list[int]

    @classmethod
    def of(cls, g: Graph, equation: TracedEquation, h: int, matrix: list[list[int]]) -> "Linearized":
        """Those of an equation with this Jacobian, in its graph."""
        by_h = [row.get(0, g.zero) for row in jacobian(g, equation.residual, [h])]
        return cls(equation.unknowns, h, equation.residual, matrix, by_h, rounding_nodes(g, equation.residual))

    @classmethod
    def inputs(cls, g: Graph, there: list[list[bool]]) -> "Linearized":
        """Inputs of a graph, and zeros where the Jacobian has none."""
        new = lambda name: [g.input(f"{name}{i}") for i in range(len(there))]
        matrix = [[g.input(f"j{i},{j}") if entry else g.zero for j, entry in enumerate(row)] for i, row in enumerate(there)]
        return cls(new("u"), g.input("h"), new("r"), matrix, new("h"), new("e"))


class FirstSizes:
    """The sizes of one equation as nodes of a graph, which gains them: of the `unknowns`, and `sure`, 1 where there is no
    doubt and 0 where there is; `order` is that of the pivots. Where `asked` is 1, `sure` holds if the residual at the `solution`
    of the linearized step is nowhere above `most`."""

    def __init__(self, g: Graph, given: Linearized, order: list[list[tuple[int, int]]]):
        unknowns, residual, matrix, rounded, h = given.unknowns, given.residual, given.matrix, given.terms, given.h
        self.graph = g
        size = lambda node: g.make("abs", node)
        total = lambda nodes: reduce(g.add, nodes, g.zero)
        rows = [{j: n for j, n in enumerate(row) if n != g.zero} for row in matrix]
        factors = Factors(g, matrix, order)
        change = factors.solve(g, residual)
        self.solution = [g.sub(u, d) for u, d in zip(unknowns, change, strict=True)]
        solution = [size(u) for u in self.solution]
        products = lambda row, values: [g.mul(size(row[j]), value) for j, value in enumerate(values) if j in row]
        terms = [total([e, *products(row, solution)]) for e, row in zip(rounded, rows, strict=True)]
        known = factors.bounds(g, terms)
        moved = factors.bounds(g, [size(g.mul(h, slope)) for slope in given.by_h])
        least = g.constant(LEAST_SIZE)
        own = [total([g.mul(g.constant(TYPICAL), a), size(u), least]) for a, u in zip(known, unknowns, strict=True)]

        sure = g.make("finite", total(own))
        below = lambda a, b: g.make("and", sure, g.make("le", a, b))
        for a, m, u in zip(known, moved, solution, strict=True):
            blurred = g.mul(g.constant(EPSILON), a)
            reached = g.add(u, g.make("sqrt", g.mul(m, a)))
            sure = below(blurred, g.mul(g.constant(4.0 * STALLED), reached))
        for j, size_of in enumerate(own):
            matters = self._matters([(e, row[j]) for e, row in zip(rounded, rows, strict=True) if j in row])
            sure = below(g.mul(g.constant(NOTHING), matters), size_of)
            sure = below(size_of, g.mul(g.constant(LOOSE), matters))
        off = reduce(
            lambda a, b: g.make("or", a, b),
            [g.make("lt", g.mul(g.constant(OFF), e), size(r)) for e, r in zip(rounded, residual, strict=True)],
            g.false,
        )
        asked = g.false
        for a, u, v in zip(own, unknowns, solution, strict=True):
            large = lambda known, a=a: g.make("and", off, g.make("lt", g.mul(g.constant(FAR), known), a))
            sure = g.make("and", sure, g.make("not", large(g.make("max", size(u), v))))
            asked = g.make("or", asked, large(size(u)))
        for r, row in zip(residual, matrix, strict=True):
            of_row = [g.mul(a, d) for a, d in zip(row, change, strict=True)]
            sure = below(size(g.sub(total(of_row), r)), g.mul(g.constant(SOLVED), total([size(r), *map(size, of_row)])))
        self.unknowns, self.sure, self.asked = own, g.select(sure, g.one, g.zero), g.select(asked, g.one, g.zero)
        self.most = [
            g.make("max", g.mul(g.constant(OFF), e), g.mul(g.constant(LEFT), size(r)))
            for e, r in zip(rounded, residual, strict=True)
        ]

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
        return [*self.unknowns, self.sure, self.asked, *self.solution, *self.most]


_known: Memo[tuple[FirstSizes, Linearized]] = Memo(KEPT)


def first_sizes(
    program: StepProgram, stage: int, u: np.ndarray, state, t, h: np.ndarray, leaves
) -> tuple[np.ndarray, np.ndarray]:
    """The sizes of the unknowns of a stage of a step, (entries, k), and whether they are sure, (entries,); the arguments have an
    axis of entries."""
    matrix, order = elimination(program, program.stages[stage][0])

    def made() -> tuple[FirstSizes, Linearized]:
        g, zero = Graph(), program.graph.zero
        given = Linearized.inputs(g, [[entry != zero for entry in row] for row in matrix])
        return FirstSizes(g, given, order), given

    first, given = _known.get((Same(program), program.stages[stage][0]), made)
    residual, slopes, terms = stage_look(program, stage)(u, state, t, h, leaves, np.abs(u), (RESIDUAL, SLOPES, TERMS))

    def part(arguments: list[np.ndarray]) -> list[np.ndarray]:
        known = Values(first.graph, len(arguments[0]))
        nodes = given.unknowns, given.h, given.residual, given.matrix, given.by_h, given.terms
        for own, array in zip(nodes, arguments, strict=True):
            known.bind(nodes_array(own), array)
        return [known.read(nodes_array(first.outputs))]

    (found,) = in_parts(part, [u, h, residual, slopes[..., :-1], slopes[..., -1], terms])
    k = u.shape[1]
    sizes, sure, (solution, most) = found[:, :k], found[:, k] == 1.0, np.split(found[:, k + 2 :], 2, axis=1)
    asked = np.flatnonzero(sure & (found[:, k + 1] == 1.0))
    if len(asked):
        at = (a[asked] for a in (state, t, h, leaves, np.abs(solution)))
        (after,) = stage_look(program, stage)(solution[asked], *at, only=(RESIDUAL,))
        sure[asked] = np.all(np.abs(after) <= most[asked], axis=1)
    return sizes, sure
