"""The rule of a derivative that tracing left to the graph."""

import functools
import math
from collections import OrderedDict
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun

from dirax.program.derivatives import gradient, jacobian
from dirax.program.graph import Graph
from dirax.program.interpreter import Interpreter, Nodes, Unavailable, Unsupported, elementwise, rule
from dirax.program.rules import formulas

KEPT = 256
"""Derivatives kept in memory."""


@rule("dirax_derivative")
def derivative(interpreter: Interpreter, equation: Any, *operands: Nodes):
    """Derived on a graph of its own, whose inputs stand for the operands, so that nothing is simplified across them."""
    own = derived(equation.params["jaxpr"], equation.params["wanted"], interpreter.graph.limit)
    nodes = [node for operand in operands for node in operand.ravel().tolist()]
    outputs = [node for result in own.results for node in result.ravel().tolist()]
    made = own.made_in(interpreter.graph, outputs, dict(zip(own.inputs, nodes, strict=True)))
    parts = np.split(np.array(made, np.int64), np.cumsum([result.size for result in own.results])[:-1])
    return [part.reshape(result.shape) for part, result in zip(parts, own.results, strict=True)]


@functools.lru_cache(KEPT)
def derived(jaxpr: Any, wanted: tuple[int, ...], limit: int) -> "Derived":
    """The derivatives of a jaxpr on a graph of their own, the same object for the same jaxpr. Raises `Unsupported`."""
    return Derived(jaxpr, wanted, limit)


_pushed: OrderedDict[tuple, tuple[Any, ClosedJaxpr]] = OrderedDict()


def pushed_forward(equation: Any, k: int) -> ClosedJaxpr:
    """The derivative of a function with a rule of its own by its operand number k, the same for the same jaxpr."""
    inner = equation.params["call_jaxpr"].jaxpr
    key = id(inner), k
    if key not in _pushed:
        alone = equation.replace(invars=inner.invars)
        whole = ClosedJaxpr(inner.replace(constvars=(), outvars=equation.outvars, eqns=[alone]), ())
        along = tuple(float(i == k) for i in range(len(inner.invars)))
        tangent = lambda *x: jax.jvp(lambda *x: jaxpr_as_fun(whole)(*x)[0], x, along)[1]
        _pushed[key] = inner, jax.make_jaxpr(tangent)(*[jax.ShapeDtypeStruct((), np.float64)] * len(along))
        if len(_pushed) > KEPT:
            _pushed.popitem(last=False)
    return _pushed[key][1]


class Derived:
    """A graph in which powers and functions with rules of their own are single nodes, as long as it is differentiated.

    `written[node]` is the value of such a function in other nodes.
    """

    def __init__(self, jaxpr: Any, wanted: tuple[int, ...], limit: int):
        self.graph = Graph(limit)
        self.written: dict[int, int] = {}
        rules = {"integer_pow": _power, "pow": _power, "custom_jvp_call": self._custom, "dirax_formula": self._formula}
        inputs = [self._fresh(v.aval.shape) for v in jaxpr.jaxpr.invars]
        self.inputs = [node for nodes in inputs for node in nodes.ravel().tolist()]
        (value,) = Interpreter(self.graph, rules).run(jaxpr, *inputs)
        if isinstance(value, Unavailable):
            raise Unsupported(f"of a function with {value.error}")
        columns = [node for k in wanted for node in inputs[k].ravel().tolist()]
        outputs, zero = value.ravel().tolist(), self.graph.zero
        if len(outputs) == 1:  # backward from a single number, else forward
            rows = [gradient(self.graph, {outputs[0]: self.graph.one}, columns)]
        else:
            rows = [[row.get(j, zero) for j in range(len(columns))] for row in jacobian(self.graph, outputs, columns)]
        table = np.array(rows, np.int64).reshape(value.size, len(columns))
        parts = np.split(table, np.cumsum([inputs[k].size for k in wanted])[:-1], axis=1)
        shapes = [(*value.shape, *inputs[k].shape) for k in wanted]
        self.results: list[Nodes] = [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]

    def _fresh(self, shape: tuple[int, ...]) -> Nodes:
        first, count = len(self.graph), math.prod(shape)
        return np.array([self.graph.input(f"x{first + i}") for i in range(count)], np.int64).reshape(shape)

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
            (slope,) = Interpreter(g).run(pushed_forward(equation, k), *operands)
            if isinstance(slope, Unavailable):
                return [slope]
            slopes.append(slope.item())
        return self._single([operand.item() for operand in operands], slopes, written.item())

    def _formula(self, interpreter: Interpreter, equation: Any, *operands: Nodes):
        """A formula, which says what its derivatives are."""
        g, formula, nodes = self.graph, equation.params["formula"], [operand.item() for operand in operands]
        return self._single(nodes, formulas.slopes(g, formula, nodes), formulas.written(g, formula, nodes))

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
                stack.extend([self.written[node]] if node in self.written else source.args[node])
        for node in sorted(seen - set(known)):  # operands first
            if node in self.written:
                there[node] = there[self.written[node]]
            elif source.is_constant(node):
                there[node] = target.constant(source.value[node])
            else:
                there[node] = target.make(source.op[node], *(there[a] for a in source.args[node]))
        return [there[node] for node in outputs]


def _power(interpreter: Interpreter, equation: Any, x: Nodes, *exponent: Nodes):
    """A power as one node, whose derivative is n·xⁿ⁻¹; it is written out where it is made again."""
    g = interpreter.graph
    y = exponent[0] if exponent else np.array(g.constant(float(equation.params["y"])))
    constant = lambda a, b: g.is_constant(a) and g.is_constant(b)
    return [elementwise(lambda a, b: g.make("pow", a, b) if constant(a, b) else g._plain("pow", a, b), x, y)]
