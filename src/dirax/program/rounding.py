"""How far rounding can move the value of a function: the sizes of all the terms that it is a sum of, however they cancel.

The error of a node is that of its operands times the derivatives, and a rounding of its own (running error analysis, Higham,
Accuracy and Stability of Numerical Algorithms, §3.3): in units of half a last place,

    E(x) = |x| of an operand,   E(f(a, …)) = Σ |∂f/∂a| E(a) + |f(a, …)|.

An iteration that contracts, as Newton's method does in a Lagrangian, doubles this bound in each round and what it bounds in none:
y reaches the next y in several ways, whose derivatives cancel. Of long chains of operations the bound is no more than MOST times
how far they move where every operation is off by about a rounding of its own, this way or that.
"""

import math
import random
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jaxtyping import Array

from dirax.program.graph import Graph, GraphTooLarge
from dirax.program.graph_derivatives import slopes
from dirax.program.interpreter import RULES, Interpreter, Nodes, Unavailable, UnsupportedPrimitive, elementwise, rule
from dirax.program.memo import Memo, Same
from dirax.program.primitives import plain_primitive
from dirax.program.scalar_program import ScalarProgram
from dirax.program.tracing import closed_over, operand

EXACT = frozenset(("neg", "abs", "max", "min", "select", "sign", "floor", "ceil", "round", "trunc"))
"""Operations that do not round."""

LONG = 50
"""Operations one after the other from which on a chain of them is long: eight rounds of an iteration or more."""

TIMES, MOST = 3, 2.0**8
"""How often all operations are off, and how many times as much rounding may move a value: of a sum of 60 000 numbers the bound is
that."""

OFF = (1.0, -1.0, 0.625, -0.625)
"""By how many roundings an operation is off: numbers that cancel are not off alike."""

BY_NODES = 2**12
"""Numbers of a function's arguments, times those of its value, up to which the sizes of its terms are found operation by
operation."""

IN_JAX = 2**13
"""Nodes up to which XLA is given the operations one by one: it takes a millisecond for each, and minutes for thrice as many."""

DIRECTIONS = 16
"""Directions in which a larger one is moved."""


def rounding(function: Callable, *values: Array, errors: tuple[Array, ...] | None = None) -> Array:
    """The size of the terms of `function(*values)`, an array of floats of the shape of its value: the value is known up to a few
    times 2⁻⁵³ of it, if the values are known to a last place each, or to that of these `errors`."""
    jaxpr, captured, _ = closed_over(function, list(values))
    errors = tuple(jnp.abs(a) for a in values) if errors is None else errors
    return rounding_p.bind(*map(operand, (*captured, *values, *errors)), jaxpr=jaxpr)[0]


def sizes_of_terms(function: Callable, *values: Array, errors: tuple[Array, ...]) -> Array:
    """`rounding`; of a function of many numbers from its size and how it moves along some directions, which is at most that."""
    count = sum(a.size for a in values) * math.prod(jax.eval_shape(function, *values).shape)
    if count <= BY_NODES:
        return rounding(function, *values, errors=errors)
    signs = np.random.default_rng(0)
    drawn = tuple(signs.choice([-1.0, 1.0], (DIRECTIONS, *a.shape)) for a in values)

    def moved(signs):
        return jnp.abs(jax.jvp(function, values, tuple(s * e for s, e in zip(signs, errors, strict=True)))[1])

    return jnp.abs(function(*values)) + jnp.max(jax.vmap(moved)(drawn), axis=0)


def rounding_nodes(g: Graph, outputs: list[int], errors: dict[int, int] | None = None) -> list[int]:
    """The nodes of E for outputs of a graph, which gains them; `errors` has those of E for some nodes, and what no operation
    gives has a rounding."""
    order, given, size = g.reachable(outputs), errors or {}, lambda node: g.make("abs", node)
    bounds = _summed(g, order, given, size, lambda own: own)
    found = [bounds[node] for node in outputs]
    if not _is_long(g, order) or len(g) + 4 * TIMES * len(order) > g.limit:
        return found
    moved: list[int] = [g.zero] * len(outputs)
    for seed in range(TIMES):
        drawn = random.Random(seed)
        off = _summed(g, order, given, lambda slope: slope, lambda own, drawn=drawn: g.mul(g.constant(drawn.choice(OFF)), own))
        moved = [g.make("max", size(off[node]), most) for node, most in zip(outputs, moved, strict=True)]
    most = [g.mul(g.constant(MOST), a) for a in moved]
    return [g.select(g.make("lt", a, e), a, e) for a, e in zip(most, found, strict=True)]


def _summed(g: Graph, order: list[int], given: dict[int, int], weight: Callable, own: Callable) -> dict[int, int]:
    """E of nodes in order, with the `weight` of a derivative and what is a node's `own` by the size of that."""
    found: dict[int, int] = {}
    for node in order:
        args = g.args[node]
        if node in given:
            found[node] = own(given[node])
        elif g.is_constant(node) or g.is_boolean(node):
            found[node] = g.zero
        elif not args:
            found[node] = own(g.make("abs", node))
        elif g.op[node] == "select":
            found[node] = g.select(args[0], found[args[1]], found[args[2]])
        else:
            total = g.zero
            for a, slope in slopes(g, node):
                if found[a] != g.zero:
                    total = g.add(total, g.mul(weight(slope), found[a]))
            exact = g.op[node] in EXACT or total == g.zero
            found[node] = total if exact else g.add(total, own(g.make("abs", node)))
    return found


def _is_long(g: Graph, order: list[int]) -> bool:
    """Whether more than LONG operations that round follow one after the other."""
    depth: dict[int, int] = {}
    for node in order:
        depth[node] = max([depth[a] for a in g.args[node]], default=0) + (g.op[node] not in EXACT)
    return max(depth.values(), default=0) > LONG


def _by_jax(*operands, jaxpr: ClosedJaxpr):
    """By the operations of the scalar program; where there is none, or a large one, from the value and its derivatives."""
    count = len(operands) - len(jaxpr.in_avals)

    def written() -> Callable:
        try:
            made = ScalarProgram.of(jaxpr)
            errors = [made.fresh(nodes.shape) for nodes in made.inputs[len(made.inputs) - count :]]
            made.results = [_of(made.graph, nodes, made.inputs, errors) for nodes in made.results]
            made.inputs += errors
            if made.results and len(made.graph) <= IN_JAX:
                return made.in_jax
        except (UnsupportedPrimitive, GraphTooLarge):
            pass
        return lambda *x: _by_derivatives(jaxpr, *x)

    return _written.get((Same(jaxpr), count), written)(*operands)


def _by_derivatives(jaxpr: ClosedJaxpr, *operands) -> list[Array]:
    function, count = lambda *x: jaxpr_as_fun(jaxpr)(*x)[0], len(jaxpr.in_avals)
    values, given = operands[:count], operands[count:]
    errors = [*map(jnp.abs, values[: count - len(given)]), *given]
    moving = tuple(i for i, a in enumerate(values) if jnp.issubdtype(jnp.result_type(a), jnp.floating))
    value, slopes = function(*values), jax.jacfwd(function, moving)(*values)
    sums = lambda s, e: jnp.sum(jnp.abs(s) * jnp.broadcast_to(e, s.shape), axis=tuple(range(value.ndim, s.ndim)))
    terms = (sums(s, e) for s, e in zip(slopes, (errors[i] for i in moving), strict=True))
    return [sum(terms, jnp.abs(value))]


def _of(g: Graph, nodes: Nodes, operands: list[Nodes], given: list[Nodes]) -> Nodes:
    """The nodes of E, with those `given` for the last of the operands."""
    flat = lambda arrays: [node for array in arrays for node in array.ravel().tolist()]
    values = flat(operands)
    known: dict[int, int] = {}
    for node, error in zip(values[len(values) - len(flat(given)) :], flat(given), strict=True):
        known[node] = g.make("max", known[node], error) if node in known else error  # one node may stand in several operands
    errors = {node: g.make("abs", node) for node in values} | known
    found = dict(zip(nodes.ravel().tolist(), rounding_nodes(g, nodes.ravel().tolist(), errors), strict=True))
    return elementwise(lambda node: found[node], nodes)


@rule("dirax_rounding")
def _rule(interpreter: Interpreter, equation: Any, *operands: Nodes):
    g, jaxpr = interpreter.graph, equation.params["jaxpr"]
    count = len(jaxpr.in_avals)
    captured, values, given = operands[: 2 * count - len(operands)], operands[2 * count - len(operands) : count], operands[count:]
    numbers = {node for nodes in values for node in nodes.ravel().tolist() if g.number(node) is not None}
    held = {node: g.input(f"held {node}") for node in numbers}
    # a product that is no graph would hide its terms
    ways: list[tuple[dict, dict]] = [({**interpreter.rules, "dot_general": RULES["dot_general"]}, {})]
    if held:  # numbers that cancel would be a number without terms
        ways.insert(0, ({}, held))
    value: Any = None
    for rules, names in ways:
        named = [elementwise(lambda node, names=names: names.get(node, node), nodes) for nodes in values]
        (value,) = Interpreter(g, rules).run(jaxpr, *captured, *named)
        if not isinstance(value, Unavailable):
            found = _of(g, value, [*captured, *named], list(given))
            again = {name: node for node, name in names.items()}
            return [np.array(g.replaced(found.ravel().tolist(), again), np.int64).reshape(found.shape)]
    return [value]


_written: Memo[Callable] = Memo(128)
rounding_p = plain_primitive("dirax_rounding", _by_jax, lambda *_, jaxpr: jaxpr.out_avals)
"""The sizes of the terms of a jaxpr of floats with one result, of its operands and of the errors of the last of them."""
