"""A scalar program for one entry as a Python function of floats: no array is made for a number, with the bits of `in_numpy`."""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from dirax.program.evaluation.tape import by_tape
from dirax.program.graph import Graph
from dirax.program.interpreter import Nodes
from dirax.program.operations import BOOLEAN, NUMPY

MOST_NODES = 400
"""Nodes up to which it is worth while: Python takes some 30 ns for each, and 20 µs to compile it."""

LONGEST = 150
"""Characters of an expression up to which it stands inside another one."""

TEXTS = {
    **{"add": "({}+{})", "sub": "({}-{})", "mul": "({}*{})", "neg": "(-{})", "recip": "(1.0/{})", "abs": "abs({})"},
    **{"lt": "({}<{})", "le": "({}<={})", "eq": "({}=={})", "ne": "({}!={})", "finite": "isfinite({})", "sqrt": "sqrt({})"},
    **{"and": "({} and {})", "or": "({} or {})", "not": "(not {})", "select": "({1} if {0} else {2})"},
}
"""Operations that Python's own floats do as NumPy's do, or not at all: they raise where NumPy has an infinity or a NaN."""

Floats = Callable[[Sequence[float]], tuple[float, ...]]


def in_floats(graph: Graph, inputs: Sequence[int], outputs: Sequence[int], between: Sequence[Any] = ()) -> Floats:
    """(values of the inputs) ↦ values of the outputs, with the opaque computations `between` of a scalar program; for a
    large one by a tape. The function raises `ArithmeticError` or `ValueError` where a float has no such operation."""
    needed = set(graph.reachable([*outputs, *(n for step in between for operand in step.operands for n in _flat(operand))]))
    if len(needed) > MOST_NODES:
        return by_tape(graph, inputs, outputs, between)
    return _Writer(graph, needed, inputs, outputs, between).function()


class _Writer:
    """The text of the function."""

    def __init__(self, graph: Graph, needed: set[int], inputs: Sequence[int], outputs: Sequence[int], between: Sequence[Any]):
        self.graph, self.inputs, self.outputs, self.between = graph, inputs, outputs, between
        operands = [n for step in between for operand in step.operands for n in _flat(operand)]
        self.uses = Counter([a for node in needed for a in graph.args[node]])
        self.uses.update(outputs)
        self.uses.update(operands * 2)  # their values are wanted where they are computed
        self.texts = {node: f"x{node}" for node in inputs}
        self.names: dict[str, Any] = {"isfinite": math.isfinite, "sqrt": math.sqrt, "inf": math.inf, "nan": math.nan}
        self.lines: list[str] = []

    def function(self) -> Floats:
        known = f"({''.join(f'x{node},' for node in self.inputs)}) = given" if self.inputs else "pass"
        for number, step in enumerate(self.between):
            operands = [n for operand in step.operands for n in _flat(operand)]
            self._need(operands)
            results = [n for result in step.results for n in _flat(result)]
            self.names[f"between{number}"] = _of_floats(step)
            left = "".join(f"x{node}," for node in results)
            call = f"between{number}(({''.join(f'{self.texts[n]},' for n in operands)}))"
            self.lines.append(f"({left}) = {call}" if results else call)
            self.texts.update({node: f"x{node}" for node in results})
        self._need(self.outputs)
        self.lines.append(f"return ({''.join(f'{self.texts[n]},' for n in self.outputs)})")
        body = [known, *self.lines]
        if any(name.startswith(("f_", "between")) for name in self.names):  # an infinity is no matter for a warning
            self.names["errstate"] = np.errstate
            body = [known, "with errstate(all='ignore'):", *(f" {line}" for line in self.lines)]
        exec("def function(given):\n" + "\n".join(f" {line}" for line in body), self.names)
        return self.names["function"]

    def _need(self, nodes: Sequence[int]) -> None:
        for node in self.graph.reachable(nodes, self.texts):
            text = self._expression(node)
            if (self.uses[node] > 1 and self.graph.args[node]) or len(text) > LONGEST:
                self.lines.append(f"x{node} = {text}")
                text = f"x{node}"
            self.texts[node] = text

    def _expression(self, node: int) -> str:
        op, operands = self.graph.op[node], [self.texts[a] for a in self.graph.args[node]]
        if not operands:
            value = self.graph.value[node]
            return f"({value!r})" if isinstance(value, bool | float) else "nan"
        if op in TEXTS:
            return TEXTS[op].format(*operands)
        self.names[f"f_{op}"] = NUMPY[op]
        return f"{'bool' if op in BOOLEAN else 'float'}(f_{op}({', '.join(operands)}))"


def _flat(nodes: Nodes) -> list[int]:
    return nodes.ravel().tolist()


def _of_floats(step: Any) -> Callable[[tuple[float, ...]], list[float]]:
    """An opaque computation of floats in order, as a list of floats."""
    shapes = [(1, *operand.shape) for operand in step.operands]
    ends = np.cumsum([0, *(operand.size for operand in step.operands)]).tolist()

    def function(given: tuple[float, ...]) -> list[float]:
        arrays = [np.array(given[a:b], float).reshape(s) for a, b, s in zip(ends, ends[1:], shapes, strict=False)]
        return [x for result in step.function(arrays) for x in np.asarray(result, float).ravel().tolist()]

    return function
