"""What a kernel is to do, and when in a run each of its nodes is known."""

from collections.abc import Iterable
from dataclasses import dataclass, field

from dirax.engines.native.loops.record import Record
from dirax.engines.newton_step import Corrections
from dirax.engines.step_program import Inputs, TracedEquation
from dirax.program.graph import Graph

RUN, STEP, NEWTON = 1, 2, 3
"""When a node's value is known: once a run, once a step, once an iteration for the first block of unknowns; NEWTON + 1 for the
second, and so on."""


@dataclass
class Plan:
    """What a kernel does: the equations, which of them each stage solves and with which fraction of h."""

    graph: Graph
    shared: Inputs
    equations: list[TracedEquation]
    corrections: list[Corrections]
    stages: list[tuple[int, float]]
    rules: dict[str, str] = field(
        default_factory=dict
    )  # how the row of a step is made of its stages', by field; "first" if not said
    compensated: bool = False
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
        """The saved arrays, each as the nodes of the first stage's row."""
        return fields_of(self.equations[self.stages[0][0]])

    def rule(self, name: str) -> str:
        """How a field's row is made of those of the stages."""
        return self.rules.get(name, "first")

    @property
    def every_stage(self) -> bool:
        """Whether stages after the first have a part in a row."""
        return len(self.stages) > 1 and any(self.rule(name) != "first" for name, _ in self.fields)

    def saving(self, index: int) -> list[tuple[int, str, list[int]]]:
        """(number, rule, nodes) of the fields in whose row the equation has a part."""
        equation, first = self.equations[index], index == self.stages[0][0]
        found = [(f, self.rule(name), nodes) for f, (name, nodes) in enumerate(fields_of(equation))]
        return [(f, rule, nodes) for f, rule, nodes in found if nodes and (first or (self.every_stage and rule != "first"))]

    @property
    def outputs(self) -> list[int]:
        """Every node that the kernel computes for its own sake."""
        out = []
        for equation, correction in zip(self.equations, self.corrections, strict=True):
            out += [*equation.guess, *equation.residual, *equation.advance]
            out += [node for parts in correction.blocks for one in parts for node in one.outputs]
        out += [node for nodes in self.increments for node in nodes if node is not None]
        return out + [node for index in range(len(self.equations)) for *_, nodes in self.saving(index) for node in nodes]

    def levels(self) -> dict[int, int]:
        """Node → RUN, STEP or NEWTON with the number of its block (0 for constants)."""
        g = self.graph
        of_input = {node: STEP for e in self.equations for node in (*e.state, *e.previous)}
        blocks = [numbered for c in self.corrections for numbered in enumerate(c.blocks)]
        for number, one in ((number, one) for number, parts in blocks for one in parts):
            of_input |= dict.fromkeys([*one.unknowns, *one.right], NEWTON + number)
        of_stage = STEP if len(self.stages) > 1 else RUN
        of_input |= {node: of_stage for c in self.corrections for node in c.sizes}
        of_input |= dict.fromkeys(self.shared.params, RUN)
        of_input |= {self.shared.t: STEP, self.shared.h: of_stage}
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
