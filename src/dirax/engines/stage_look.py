"""A stage of a step looked at in numbers: all that sizes are found of."""

import functools
from collections.abc import Sequence

import numpy as np

from dirax.engines.step_program import KEPT, StepProgram, nodes_array
from dirax.program.evaluation.in_floats import Floats, in_floats
from dirax.program.evaluation.in_numpy import Slopes, Values
from dirax.program.evaluation.read_again import ReadAgain
from dirax.program.graph_derivatives import jacobian
from dirax.program.memo import Memo, Same
from dirax.program.rounding import rounding_nodes

RESIDUAL, SLOPES, TERMS, END = range(4)
"""What there is to look at."""

FEW = 4
"""Entries up to which floats are quicker than arrays."""


class StageLook:
    """(u, state, t, h, parameters, sizes), with an axis of entries, ↦ what is asked for of: the residual (entries, k), its
    derivatives by the unknowns and by h (entries, k, k + 1), the sizes of its terms (entries, k), with unknowns of these sizes,
    and the state after the stage (entries, s)."""

    def __init__(self, program: StepProgram, index: int):
        self.program, self.equation = program, program.equations[index]
        e, h, known = self.equation, program.shared.h, program.jacobians[index] if program.sizes_are_written else []
        graph = program.graph.copy()
        self.inputs = [*e.unknowns, h]
        by_h = jacobian(graph, e.residual, [h]) if known else []
        rows = zip(known, by_h, strict=True)
        k = len(e.unknowns)
        self.slopes = [n for row, last in rows for n in (*(row.get(j, graph.zero) for j in range(k)), last.get(0, graph.zero))]
        self.sizes = [graph.input(f"size{i}") for i in range(k)]
        errors = dict(zip(e.unknowns, self.sizes, strict=True))
        self.terms, self.graph = rounding_nodes(graph, e.residual, errors), graph
        self._reads = ReadAgain(graph)
        self.runs = 0
        """In how many runs it was looked at: it is compiled for the second one."""
        self._floats: Floats | None = None

    def __call__(self, u, state, t, h, leaves: np.ndarray, sizes: np.ndarray, only: tuple[int, ...]) -> list[np.ndarray]:
        k = len(self.equation.unknowns)
        if len(u) <= FEW and self.runs > 1 and self.slopes:
            try:
                given = np.concatenate([u, state, t[:, None], h[:, None], leaves, sizes], axis=1).tolist()
                values = np.array([self._in_floats(one) for one in given])
                residual, slopes, terms, end = np.split(values, np.cumsum([k, k * (k + 1), k]), axis=1)
                found = residual, slopes.reshape(-1, k, k + 1), terms, end
                return [found[i] for i in only]
            except (ArithmeticError, ValueError):  # NumPy goes on with infinities
                pass
        read = self._read if self.slopes else self._swept
        return self.program.in_numbers(
            lambda known: read(known, only), self.graph, self.equation, u, state, t, h, leaves, more=[(self.sizes, sizes)]
        )

    def _nodes(self, what: int) -> list[int]:
        return (self.equation.residual, self.slopes, self.terms, self.equation.advance)[what]

    def _read(self, known: Values, only: tuple[int, ...]) -> list[np.ndarray]:
        k = len(self.equation.unknowns)
        found = [self._reads(known, nodes_array(self._nodes(what))) for what in only]
        return [a.reshape(-1, k, k + 1) if what == SLOPES else a for what, a in zip(only, found, strict=True)]

    def _swept(self, known: Values, only: tuple[int, ...]) -> list[np.ndarray]:
        """The same of a large step, whose derivatives are not written as nodes."""
        e, tape, found = self.equation, self._plan.tape, {}
        if SLOPES in only:
            found[SLOPES] = known.slopes(e.residual, self.inputs, self._plan)
        elif tape is not None:
            values = tape.numbers(known.given(tape.numbers))
            known.bind(nodes_array([*e.residual, *self.terms, *e.advance]), values)
        return [found[what] if what in found else known.read(nodes_array(self._nodes(what))) for what in only]

    @functools.cached_property
    def _plan(self) -> Slopes:
        """How the derivatives are found in numbers, and all else with them."""
        return Slopes(self.graph, self.equation.residual, self.inputs, [*self.terms, *self.equation.advance])

    def _in_floats(self, given: Sequence[float]) -> Sequence[float]:
        """All of it by floats."""
        if self._floats is None:
            e, shared = self.equation, self.program.shared
            inputs = [*e.unknowns, *e.state, shared.t, shared.h, *shared.params, *self.sizes]
            self._floats = in_floats(self.graph, inputs, [*e.residual, *self.slopes, *self.terms, *e.advance])
        return self._floats(given)


_known: Memo[StageLook] = Memo(KEPT)


def stage_look(program: StepProgram, stage: int) -> StageLook:
    """That of a stage, made once for each of the equations."""
    index = program.stages[stage][0]
    return _known.get((Same(program), index), lambda: StageLook(program, index))
