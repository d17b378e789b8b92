"""A stage of a step looked at in numbers: all that sizes are found of."""

import numpy as np

from dirax.engines.step_program import KEPT, WRITTEN, StepProgram, nodes_array
from dirax.program.evaluation.in_floats import Floats, in_floats
from dirax.program.evaluation.in_numpy import Values
from dirax.program.graph_derivatives import jacobian
from dirax.program.memo import Memo, Same
from dirax.program.rounding import rounding_nodes


class StageLook:
    """(u, state, t, h, parameters, sizes), with an axis of entries, ↦ residual (entries, k), its derivatives by the unknowns and
    by h (entries, k, k + 1), the sizes of its terms (entries, k), with unknowns of these sizes, and the state after the stage
    (entries, s)."""

    def __init__(self, program: StepProgram, index: int):
        self.program, self.equation = program, program.equations[index]
        e, graph = self.equation, program.graph.copy()
        inputs = [*e.unknowns, program.shared.h]
        rows = jacobian(graph, e.residual, inputs) if program.sizes_are_written else []
        self.slopes = [row.get(j, graph.zero) for row in rows for j in range(len(inputs))]
        self.sizes = [graph.input(f"size{i}") for i in range(len(e.unknowns))]
        errors = dict(zip(e.unknowns, self.sizes, strict=True))
        self.terms, self.graph, self.inputs = rounding_nodes(graph, e.residual, errors), graph, inputs
        self.looked = False
        self._floats: Floats | None = None

    def __call__(self, u, state, t, h, leaves: np.ndarray, sizes: np.ndarray) -> list[np.ndarray]:
        k = len(self.equation.unknowns)
        if len(u) == 1 and self.looked and (function := self._in_floats()):
            try:
                values = np.array(function(np.concatenate([u[0], state[0], t, h, leaves[0], sizes[0]]).tolist()))[None]
                residual, slopes, terms, end = np.split(values, np.cumsum([k, k * (k + 1), k]), axis=1)
                return [residual, slopes.reshape(1, k, k + 1), terms, end]
            except (ArithmeticError, ValueError):  # NumPy goes on with infinities
                pass
        self.looked = True
        graph = self.graph if self.slopes else self.graph.copy()  # to which derivatives in numbers are added
        return self.program.in_numbers(self._read, graph, self.equation, u, state, t, h, leaves, more=[(self.sizes, sizes)])

    def _read(self, known: Values) -> list[np.ndarray]:
        e, k = self.equation, len(self.equation.unknowns)
        written = bool(self.slopes)
        slopes = known.read(nodes_array(self.slopes).reshape(k, k + 1)) if written else known.slopes(e.residual, self.inputs)
        return [
            known.read(nodes_array(e.residual)),
            slopes,
            known.read(nodes_array(self.terms)),
            known.read(nodes_array(e.advance)),
        ]

    def _in_floats(self) -> Floats | None:
        """As a function of floats, which is compiled for a second look and not for one."""
        if self._floats is None and self.slopes:
            e, shared = self.equation, self.program.shared
            given = [*e.unknowns, *e.state, shared.t, shared.h, *shared.params, *self.sizes]
            self._floats = in_floats(self.graph, given, [*e.residual, *self.slopes, *self.terms, *e.advance], most=WRITTEN)
        return self._floats


_known: Memo[StageLook] = Memo(KEPT)


def stage_look(program: StepProgram, stage: int) -> StageLook:
    """That of a stage, made once for each of the equations."""
    index = program.stages[stage][0]
    return _known.get((Same(program), index), lambda: StageLook(program, index))
