"""What a kernel is to do, and when in a run each of its nodes is known."""

from collections.abc import Iterable
from dataclasses import dataclass, field

from dirax.engines.native.loops.newton_step import Correction
from dirax.engines.native.loops.record import Record
from dirax.engines.step_program import Inputs, TracedEquation
from dirax.program.graph import Graph

RUN, STEP, NEWTON = 1, 2, 3
"""When a node's value is known: once a run, once a step, once an iteration."""


@dataclass
class Plan:
    """What a kernel does: the equations, which of them each stage solves and with which fraction of h."""

    graph: Graph
    shared: Inputs
    equations: list[TracedEquation]
    corrections: list[Correction]
    stages: list[tuple[int, float]]
    compensated: bool = False
    every_stage: bool = False  # a row for each stage of a step, of the equation that it solves; `every` is then 1
    increments: list[list[int | None]] = field(default_factory=list)

    @property
    def state_size(self) -> int:
        return len(self.equations[0].state)

    @property
    def record(self) -> Record:
        """What is kept of a lane."""
        history = max(len(e.unknowns) for e in self.equations)
        return Record(self.state_size, len(self.stages), history, self.compensated)

    @property
    def fields(self) -> list[tuple[str, list[int]]]:
        """The saved arrays, each as the nodes of a row; they come from the first stage."""
        return fields_of(self.equations[self.stages[0][0]])

    @property
    def outputs(self) -> list[int]:
        """Every node that the kernel computes for its own sake."""
        out = []
        for equation, correction in zip(self.equations, self.corrections, strict=True):
            out += [*equation.guess, *equation.residual, *equation.advance]
            out += [*correction.change, *correction.factors, correction.stable]
        out += [node for nodes in self.increments for node in nodes if node is not None]
        saving = self.equations if self.every_stage else [self.equations[self.stages[0][0]]]
        return out + [node for equation in saving for _, nodes in fields_of(equation) for node in nodes]

    def levels(self) -> dict[int, int]:
        """Node → RUN, STEP or NEWTON (0 for constants)."""
        g = self.graph
        of_input = {node: STEP for e in self.equations for node in (*e.state, *e.previous)}
        of_input |= {node: NEWTON for e in self.equations for node in e.unknowns}
        of_input |= {node: NEWTON for c in self.corrections for node in c.right}
        of_input |= dict.fromkeys(self.shared.params, RUN)
        of_input |= {self.shared.t: STEP, self.shared.h: STEP if len(self.stages) > 1 else RUN}
        level = {}
        for node in range(len(g)):
            inside = max((level[a] for a in g.args[node]), default=0)
            level[node] = of_input.get(node, inside)
        return level


def fields_of(equation: TracedEquation) -> list[tuple[str, list[int]]]:
    """The saved arrays of an equation, each as the nodes of a row."""
    return [(name, equation.rows[name].ravel().tolist()) for name in sorted(equation.rows)]


def frontier(g: Graph, level: dict[int, int], outputs: Iterable[int], at: int) -> list[int]:
    """The nodes of level ≤ `at` that the outputs need directly: themselves, or as operands of nodes of a higher level."""
    found, seen, stack = set(), set(), list(outputs)
    while stack:
        node = stack.pop()
        if node in seen or g.is_constant(node):
            continue
        seen.add(node)
        if level[node] <= at:
            found.add(node)
        else:
            stack.extend(g.args[node])
    return sorted(found)
