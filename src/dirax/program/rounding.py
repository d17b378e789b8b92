"""How far rounding can move the value of a function: the sizes of all the terms that it is a sum of, however they cancel.

The error of a node is that of its operands times the derivatives, and a rounding of its own (running error analysis, Higham,
Accuracy and Stability of Numerical Algorithms, §3.3): in units of half a last place,

    E(x) = |x| of an operand,   E(f(a, …)) = Σ |∂f/∂a| E(a) + |f(a, …)|.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jaxtyping import Array

from dirax.program.graph import Graph, GraphTooLarge
from dirax.program.graph_derivatives import partials
from dirax.program.interpreter import Interpreter, Nodes, Unavailable, UnsupportedPrimitive, elementwise, rule
from dirax.program.memo import Memo, Same
from dirax.program.primitives import plain_primitive
from dirax.program.scalar_program import ScalarProgram
from dirax.program.tracing import closed_over, operand

EXACT = frozenset(("neg", "abs", "max", "min", "select", "sign", "floor", "ceil", "round", "trunc"))
"""Operations that do not round."""


def rounding(function: Callable, *values: Array) -> Array:
    """The size of the terms of `function(*values)`, an array of floats of the shape of its value: the value is known up to a few
    times 2⁻⁵³ of it, if the values are known to a last place each."""
    jaxpr, captured, _ = closed_over(function, list(values))
    return rounding_p.bind(*map(operand, captured), *map(operand, values), jaxpr=jaxpr)[0]


def rounding_nodes(g: Graph, outputs: list[int], inputs: set[int] | frozenset[int] = frozenset()) -> list[int]:
    """The nodes of E for outputs of a graph, which gains them; `inputs`, and what no operation gives, have a rounding each."""
    error: dict[int, int] = {}
    for node in g.reachable(outputs):
        if g.is_constant(node) or g.is_boolean(node):
            error[node] = g.zero
        elif node in inputs or not g.args[node]:
            error[node] = g.make("abs", node)
        else:
            error[node] = _error(g, node, error)
    return [error[node] for node in outputs]


def _error(g: Graph, node: int, error: dict[int, int]) -> int:
    args = g.args[node]
    if g.op[node] == "select":
        return g.select(args[0], error[args[1]], error[args[2]])
    total = g.zero
    for a, slope in zip(args, partials(g, node), strict=True):
        if slope is not None and error[a] != g.zero:
            total = g.add(total, g.mul(g.make("abs", slope), error[a]))
    return total if g.op[node] in EXACT or total == g.zero else g.add(total, g.make("abs", node))


def _by_jax(*operands, jaxpr: ClosedJaxpr):
    """By the operations of the scalar program; where there is none, from the value and its derivatives."""

    def written() -> Callable:
        try:
            made = ScalarProgram.of(jaxpr)
            if not made.results:
                return lambda *x: _by_derivatives(jaxpr, *x)
            inputs = {node for nodes in made.inputs for node in nodes.ravel().tolist()}
            made.results = [_of(made.graph, nodes, inputs) for nodes in made.results]
            return made.in_jax
        except (UnsupportedPrimitive, GraphTooLarge):
            return lambda *x: _by_derivatives(jaxpr, *x)

    return _written.get(Same(jaxpr), written)(*operands)


def _by_derivatives(jaxpr: ClosedJaxpr, *operands) -> list[Array]:
    function = lambda *x: jaxpr_as_fun(jaxpr)(*x)[0]
    value, slopes = function(*operands), jax.jacfwd(function, tuple(range(len(operands))))(*operands)
    terms = (jnp.sum(jnp.abs(s * x), axis=tuple(range(value.ndim, s.ndim))) for s, x in zip(slopes, operands, strict=True))
    return [sum(terms, jnp.abs(value))]


def _of(g: Graph, nodes: Nodes, inputs: set[int]) -> Nodes:
    found = dict(zip(nodes.ravel().tolist(), rounding_nodes(g, nodes.ravel().tolist(), inputs), strict=True))
    return elementwise(lambda node: found[node], nodes)


@rule("dirax_rounding")
def _rule(interpreter: Interpreter, equation: Any, *operands: Nodes):
    (value,) = interpreter.run(equation.params["jaxpr"], *operands)
    if isinstance(value, Unavailable):
        return [value]
    return [_of(interpreter.graph, value, {node for nodes in operands for node in nodes.ravel().tolist()})]


_written: Memo[Callable] = Memo(128)
rounding_p = plain_primitive("dirax_rounding", _by_jax, lambda *_, jaxpr: jaxpr.out_avals)
"""The sizes of the terms of a jaxpr of floats with one result."""
