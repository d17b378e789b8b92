"""The rules of derivatives, which are taken on a graph of their own."""

import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr

from dirax.program.graph import Graph
from dirax.program.graph_derivatives import gradient, jacobian
from dirax.program.interpreter import Interpreter, Nodes, Rule, Unavailable, Unsupported, elementwise, rule
from dirax.program.memo import Memo, Same
from dirax.program.rules import formulas
from dirax.program.rules.reductions import fold
from dirax.program.tracing import of_one_result

KEPT = 256
"""Derivatives kept in memory."""

Kept: TypeAlias = Mapping[str, Rule] | None


_derived: Memo["Derived"] = Memo(KEPT)
_pushed: Memo[ClosedJaxpr] = Memo(KEPT)


@rule("dirax_derivative")
def derivative(interpreter: Interpreter, equation: Any, *operands: Nodes, kept: Kept = None):
    """Derived on a graph of its own, whose inputs stand for the operands, so that nothing is simplified across them."""
    jaxpr, wanted, limit = equation.params["jaxpr"], equation.params["wanted"], interpreter.graph.limit
    own = _derived.get((Same(jaxpr), wanted, limit, kept is None), lambda: Derived.by_operands(jaxpr, wanted, limit, kept))
    return own.results_in(interpreter.graph, operands)


@rule("dirax_directional")
def directional(interpreter: Interpreter, equation: Any, *operands: Nodes, kept: Kept = None):
    """The same by a number s at 0, by which the point is moved along the direction."""
    jaxpr, count, limit = equation.params["jaxpr"], equation.params["count"], interpreter.graph.limit
    own = _derived.get((Same(jaxpr), count, limit, kept is None), lambda: Derived.along(jaxpr, count, limit, kept))
    return own.results_in(interpreter.graph, [*operands, np.array(interpreter.graph.zero)])


@rule("dirax_pullback")
def pullback(interpreter: Interpreter, equation: Any, *operands: Nodes, kept: Kept = None):
    """The sum over rows of the derivative, each times an entry of the covector."""
    jaxpr, limit, g = equation.params["jaxpr"], interpreter.graph.limit, interpreter.graph
    wanted = (len(operands) - 2,)
    own = _derived.get((Same(jaxpr), wanted, limit, kept is None), lambda: Derived.by_operands(jaxpr, wanted, limit, kept))
    (matrix,), covector = own.results_in(g, operands[:-1]), operands[-1].tolist()
    return [np.array([fold(interpreter, "add", map(g.mul, column, covector)) for column in matrix.T.tolist()], np.int64)]


def pushed_forward(equation: Any, k: int) -> ClosedJaxpr:
    """The derivative of a function with a rule of its own by its operand number k, the same for the same jaxpr."""
    inner = equation.params["call_jaxpr"].jaxpr

    def traced() -> ClosedJaxpr:
        alone = equation.replace(invars=inner.invars)
        whole = ClosedJaxpr(inner.replace(constvars=(), outvars=equation.outvars, eqns=[alone]), ())
        along = tuple(float(i == k) for i in range(len(inner.invars)))
        tangent = lambda *x: jax.jvp(of_one_result(whole), x, along)[1]
        return jax.make_jaxpr(tangent)(*[jax.ShapeDtypeStruct((), np.float64)] * len(along))

    return _pushed.get((Same(inner), k), traced)


class Derived:
    """A graph in which powers and functions with rules of their own are single nodes, as long as it is differentiated.

    `written[node]` is the value of such a function in other nodes. With the rules `kept` of `differentiable.py` the results, too,
    have derivatives by the rules of the functions.
    """

    def __init__(self, limit: int, kept: Kept = None):
        self.graph, self.kept = Graph(limit), kept
        self.written: dict[int, int] = {}
        self.inputs: list[int] = []
        self.results: list[Nodes] = []

    @classmethod
    def by_operands(cls, jaxpr: ClosedJaxpr, wanted: tuple[int, ...], limit: int, kept: Kept = None) -> "Derived":
        """The derivatives of a jaxpr with one result by its operands of these numbers. Raises `Unsupported`."""
        made = cls(limit, kept)
        inputs = [made._fresh(v.aval.shape) for v in jaxpr.jaxpr.invars]
        made._differentiate(jaxpr, inputs, [inputs[k] for k in wanted])
        return made

    @classmethod
    def along(cls, jaxpr: ClosedJaxpr, count: int, limit: int, kept: Kept = None) -> "Derived":
        """The one along a direction of the last `count` operands; the inputs are operands, direction and s."""
        made, shapes = cls(limit, kept), [v.aval.shape for v in jaxpr.jaxpr.invars]
        inputs = [made._fresh(shape) for shape in shapes]
        direction = [made._fresh(shape) for shape in shapes[-count:]]
        s, g = made._fresh(()), made.graph
        steps = [elementwise(g.mul, s, v) for v in direction]
        moved = [elementwise(g.add, x, step) for x, step in zip(inputs[-count:], steps, strict=True)]
        made._differentiate(jaxpr, [*inputs[:-count], *moved], [s])
        return made

    def _differentiate(self, jaxpr: ClosedJaxpr, operands: list[Nodes], by: list[Nodes]) -> None:
        rules = {"integer_pow": _power, "pow": _power, "custom_jvp_call": self._custom, "dirax_formula": self._formula}
        (value,) = Interpreter(self.graph, rules).run(jaxpr, *operands)
        if isinstance(value, Unavailable):
            raise Unsupported(f"of a function with {value.error}")
        columns = [node for nodes in by for node in nodes.ravel().tolist()]
        outputs, zero = value.ravel().tolist(), self.graph.zero
        if len(outputs) == 1:  # backward from a single number, else forward
            rows = [gradient(self.graph, {outputs[0]: self.graph.one}, columns)]
        else:
            rows = [[row.get(j, zero) for j in range(len(columns))] for row in jacobian(self.graph, outputs, columns)]
        table = np.array(rows, np.int64).reshape(value.size, len(columns))
        parts = np.split(table, np.cumsum([nodes.size for nodes in by])[:-1], axis=1)
        self.results = [part.reshape((*value.shape, *nodes.shape)) for part, nodes in zip(parts, by, strict=True)]

    def results_in(self, target: Graph, operands: Sequence[Nodes]) -> list[Nodes]:
        """The results in another graph, with these nodes of it for the inputs."""
        nodes = [node for operand in operands for node in operand.ravel().tolist()]
        outputs = [node for result in self.results for node in result.ravel().tolist()]
        made = self.made_in(target, outputs, dict(zip(self.inputs, nodes, strict=True)))
        parts = np.split(np.array(made, np.int64), np.cumsum([result.size for result in self.results])[:-1])
        return [part.reshape(result.shape) for part, result in zip(parts, self.results, strict=True)]

    def _fresh(self, shape: tuple[int, ...]) -> Nodes:
        first, count = len(self.graph), math.prod(shape)
        nodes = [self.graph.input(f"x{first + i}") for i in range(count)]
        self.inputs += nodes
        return np.array(nodes, np.int64).reshape(shape)

    def _custom(self, interpreter: Interpreter, equation: Any, *operands: Nodes):
        """A function of numbers with a rule for its derivative, which is interpreted along each operand."""
        p, g = equation.params, self.graph
        (written,) = interpreter.run(p["call_jaxpr"], *operands)
        if isinstance(written, Unavailable) or g.is_constant(written.item()):
            return [written]
        slopes: list[int | None] = []
        for k, operand in enumerate(operands):
            if g.is_constant(operand.item()):
                slopes.append(None)
                continue
            (slope,) = Interpreter(g, self.kept).run(pushed_forward(equation, k), *operands)
            if isinstance(slope, Unavailable):
                return [slope]
            slopes.append(slope.item())
        return self._single([operand.item() for operand in operands], slopes, written.item())

    def _formula(self, interpreter: Interpreter, equation: Any, *operands: Nodes):
        """A formula, which says what its derivatives are."""
        g, formula, nodes = self.graph, equation.params["formula"], [operand.item() for operand in operands]
        node_of = formulas.differentiable if self.kept else formulas.written
        return self._single(nodes, formulas.slopes(g, formula, nodes, node_of), formulas.written(g, formula, nodes))

    def _single(self, operands: list[int], slopes: list[int | None], written: int):
        """A function of the operands as one node."""
        if self.graph.is_constant(written):
            return [np.array(written, np.int64)]
        node = self.graph.opaque(operands, slopes)
        self.written[node] = written
        return [np.array(node, np.int64)]

    def made_in(self, target: Graph, outputs: list[int], known: dict[int, int]) -> list[int]:
        """The nodes of `outputs` made again in another graph, inputs replaced as `known` says."""
        source, there, seen, stack = self.graph, dict(known), set(known), list(outputs)
        while stack:
            node = stack.pop()
            if node not in seen:
                seen.add(node)
                stack.extend(source.args[node] if node not in self.written else self._needed(node))
        for node in sorted(seen - set(known)):  # operands first
            if node in self.written:
                there[node] = self._made(target, node, there)
            elif source.is_constant(node):
                there[node] = target.constant(source.value[node])
            else:
                there[node] = target.make(source.op[node], *(there[a] for a in source.args[node]))
        return [there[node] for node in outputs]

    def _needed(self, node: int) -> list[int]:
        """What a function as one node is made again of."""
        along = [x for pair in self._slopes(node) for x in pair] if self.kept else []
        return [self.written[node], *along]

    def _slopes(self, node: int) -> list[tuple[int, int]]:
        slopes = zip(self.graph.args[node], self.graph.slopes[node], strict=True)
        return [(operand, slope) for operand, slope in slopes if slope is not None]

    def _made(self, target: Graph, node: int, there: dict[int, int]) -> int:
        value = there[self.written[node]]
        if not self.kept:
            return value
        moved = [target.mul(target.make("held", there[s]), target.make("motion", there[x])) for x, s in self._slopes(node)]
        return target.make("ruled", value, functools.reduce(target.add, moved, target.zero))


def _power(interpreter: Interpreter, equation: Any, x: Nodes, *exponent: Nodes):
    """A power as one node, whose derivative is n·xⁿ⁻¹; it is written out where it is made again."""
    g = interpreter.graph
    y = exponent[0] if exponent else np.array(g.constant(float(equation.params["y"])))
    constant = lambda a, b: g.is_constant(a) and g.is_constant(b)
    return [elementwise(lambda a, b: g.make("pow", a, b) if constant(a, b) else g._plain("pow", a, b), x, y)]
