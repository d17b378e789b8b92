"""Formulas on the graph: the same code on expressions that it runs on arrays of JAX."""

import functools
from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np

from dirax.program.formula import Formula
from dirax.program.graph import Graph
from dirax.program.interpreter import Interpreter, Nodes, rule

Operand: TypeAlias = "Expression | float"
NodeOf: TypeAlias = Callable[[Graph, Formula, list[int]], int]


class Expression:
    """A node of a graph with operators."""

    def __init__(self, graph: Graph, node: int):
        self.graph, self.node = graph, node

    def _of(self, other: Operand) -> int:
        return other.node if isinstance(other, Expression) else self.graph.constant(float(other))

    def _make(self, op: str, *nodes: int) -> "Expression":
        return Expression(self.graph, self.graph.make(op, *nodes))

    def __neg__(self):
        return self._make("neg", self.node)

    def __add__(self, other: Operand):
        return self._make("add", self.node, self._of(other))

    def __radd__(self, other: float):
        return self._make("add", self._of(other), self.node)

    def __sub__(self, other: Operand):
        return self._make("sub", self.node, self._of(other))

    def __rsub__(self, other: float):
        return self._make("sub", self._of(other), self.node)

    def __mul__(self, other: Operand):
        return self._make("mul", self.node, self._of(other))

    def __rmul__(self, other: float):
        return self._make("mul", self._of(other), self.node)

    def __truediv__(self, other: Operand):
        return Expression(self.graph, self.graph.div(self.node, self._of(other)))

    def __lt__(self, other: Operand):
        return self._make("lt", self.node, self._of(other))


class Expressions:
    """What a formula calls `xp`, for expressions of one graph."""

    def __init__(self, graph: Graph):
        self.graph = graph

    def _make(self, op: str, *operands: Operand) -> Expression:
        nodes = [x.node if isinstance(x, Expression) else self.graph.constant(float(x)) for x in operands]
        return Expression(self.graph, self.graph.make(op, *nodes))

    def where(self, condition: Expression, yes: Operand, no: Operand) -> Expression:
        return self._make("select", condition, yes, no)

    def equal(self, a: Operand, b: Operand) -> Expression:
        return self._make("eq", a, b)

    def sqrt(self, x: Operand) -> Expression:
        return self._make("sqrt", x)

    def sin(self, x: Operand) -> Expression:
        return self._make("sin", x)

    def cos(self, x: Operand) -> Expression:
        return self._make("cos", x)

    def arctan2(self, y: Operand, x: Operand) -> Expression:
        return self._make("atan2", y, x)


def written(graph: Graph, formula: Formula, operands: list[int]) -> int:
    """The node of a formula of nodes."""
    return formula.value(Expressions(graph), tuple(Expression(graph, node) for node in operands)).node


def slopes(graph: Graph, formula: Formula, operands: list[int], node_of: NodeOf = written) -> list[int | None]:
    """The nodes of its derivatives by each operand; None for zero."""
    known = zip(formula.slopes(), operands, strict=True)
    wanted = [None if slope is None or graph.is_constant(node) else slope for slope, node in known]
    return [None if s is None else graph.mul(graph.constant(s[0]), node_of(graph, s[1], operands)) for s in wanted]


def differentiable(graph: Graph, formula: Formula, operands: list[int]) -> int:
    """The node of a formula that moves as its slopes say."""
    value = written(graph, formula, operands)
    if not formula.is_restricted or graph.is_constant(value):
        return value
    pairs = [(x, s) for x, s in zip(operands, slopes(graph, formula, operands), strict=True) if s is not None]
    moved = [graph.mul(graph.make("held", s), graph.make("motion", x)) for x, s in pairs]
    return graph.make("ruled", value, functools.reduce(graph.add, moved, graph.zero))


@rule("dirax_formula")
def formula(interpreter: Interpreter, equation: Any, *operands: Nodes):
    node = written(interpreter.graph, equation.params["formula"], [o.item() for o in operands])
    return [np.array(node, np.int64)]
