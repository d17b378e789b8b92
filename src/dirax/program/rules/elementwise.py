"""Rules of elementwise primitives."""

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from jax.lax import RoundingMethod

from dirax.program.graph import Graph
from dirax.program.interpreter import Interpreter, Unsupported, elementwise, is_integer, rule
from dirax.program.operations import EXACT, NUMPY

LARGE = 256
"""Entries of an array from which on it pays to ask whether all of them are constant."""

SAME = {  # primitive name → operation of the graph
    "add": "add",
    "add_any": "add",
    "sub": "sub",
    "mul": "mul",
    "neg": "neg",
    "abs": "abs",
    "sqrt": "sqrt",
    "floor": "floor",
    "ceil": "ceil",
    "sign": "sign",
    "max": "max",
    "min": "min",
    "rem": "rem",
    "sin": "sin",
    "cos": "cos",
    "tan": "tan",
    "asin": "asin",
    "acos": "acos",
    "atan": "atan",
    "atan2": "atan2",
    "sinh": "sinh",
    "cosh": "cosh",
    "tanh": "tanh",
    "asinh": "asinh",
    "acosh": "acosh",
    "atanh": "atanh",
    "exp": "exp",
    "exp2": "exp2",
    "expm1": "expm1",
    "log": "log",
    "log1p": "log1p",
    "pow": "pow",
    "cbrt": "cbrt",
    "erf": "erf",
    "erfc": "erfc",
    "lt": "lt",
    "le": "le",
    "lt_to": "lt",  # of numbers in whose order −0 is below 0 and NaN the largest: JAX has made these equal before
    "le_to": "le",
    "eq": "eq",
    "ne": "ne",
    "is_finite": "finite",
}
DIRECT = {"add": Graph.add, "sub": Graph.sub, "mul": Graph.mul}
BY_LEMMA = {
    "square": lambda g, x: g.mul(x, x),
    "rsqrt": lambda g, x: g.recip(g.make("sqrt", x)),
    "logistic": lambda g, x: g.recip(g.add(g.one, g.make("exp", g.neg(x)))),
    "gt": lambda g, x, y: g.make("lt", y, x),
    "ge": lambda g, x, y: g.make("le", y, x),
    "clamp": lambda g, low, x, high: g.make("min", g.make("max", x, low), high),
}


@rule(*SAME)
def same(interpreter: Interpreter, equation: Any, *operands):
    graph, op = interpreter.graph, SAME[equation.primitive.name]
    if op in EXACT and math.prod(equation.outvars[0].aval.shape) >= LARGE:
        known = [interpreter.numbers(nodes) for nodes in operands]
        if all(numbers is not None for numbers in known):
            with np.errstate(all="ignore"):
                return [interpreter.constants(NUMPY[op](*known))]
    return [elementwise(functools.partial(DIRECT[op], graph) if op in DIRECT else functools.partial(graph.make, op), *operands)]


@rule(*BY_LEMMA)
def by_lemma(interpreter: Interpreter, equation: Any, *operands):
    graph, function = interpreter.graph, BY_LEMMA[equation.primitive.name]
    return [elementwise(lambda *nodes: function(graph, *nodes), *operands)]


@rule("div")
def divide(interpreter: Interpreter, equation: Any, a, b):
    g = interpreter.graph
    if is_integer(equation.outvars[0]):
        x, y = interpreter.static(a), interpreter.static(b)
        if y is None or np.any(y == 0):
            raise Unsupported("divides whole numbers by some that depend on the state")
        if x is not None:
            return [interpreter.constants(np.abs(x) // np.abs(y) * np.sign(x) * np.sign(y))]
        # with a half more no quotient is so near to a whole number that roundoff decides
        over = lambda a, b: g.make("floor", g.div(g.add(g.make("abs", a), g.constant(0.5)), g.make("abs", b)))
        signed = lambda a, b: g.mul(g.mul(g.make("sign", a), g.make("sign", b)), over(a, b))
        return [elementwise(signed, a, b)]
    return [elementwise(g.div, a, b)]


@rule("integer_pow")
def integer_power(interpreter: Interpreter, equation: Any, x):
    g, n = interpreter.graph, equation.params["y"]
    return [elementwise(lambda a: g.power(a, n), x)]


@rule("round")
def rounded(interpreter: Interpreter, equation: Any, x):
    g = interpreter.graph
    if equation.params["rounding_method"] == RoundingMethod.TO_NEAREST_EVEN:
        return [elementwise(lambda a: g.make("round", a), x)]

    def away_from_zero(a: int) -> int:
        whole = g.make("trunc", a)
        far = g.make("le", g.constant(0.5), g.make("abs", g.sub(a, whole)))  # the difference is exact
        return g.select(far, g.add(whole, g.make("sign", a)), whole)

    return [elementwise(away_from_zero, x)]


@rule("and", "or", "xor", "not")
def logical(interpreter: Interpreter, equation: Any, *operands):
    g, name = interpreter.graph, equation.primitive.name
    if equation.outvars[0].aval.dtype != np.bool_:
        values = [v for o in operands if (v := interpreter.static(o)) is not None]
        if len(values) < len(operands):
            raise Unsupported("acts on bits that depend on the state")
        bitwise: dict[str, Callable] = {"and": np.bitwise_and, "or": np.bitwise_or, "xor": np.bitwise_xor, "not": np.invert}
        return [interpreter.constants(bitwise[name](*values))]
    return [elementwise(functools.partial(g.make, "ne" if name == "xor" else name), *operands)]


@rule("select_n")
def select_n(interpreter: Interpreter, equation: Any, which, *cases):
    g = interpreter.graph
    if equation.invars[0].aval.dtype == np.bool_:
        no, yes = cases
        return [elementwise(g.select, which, yes, no)]

    def choose(index, *options):
        result = options[-1]
        for k in reversed(range(len(options) - 1)):
            result = g.select(g.make("le", index, g.constant(float(k))), options[k], result)
        return result

    return [elementwise(choose, which, *cases)]


@rule("convert_element_type")
def convert(interpreter: Interpreter, equation: Any, x):
    g, old, new = interpreter.graph, equation.invars[0].aval.dtype, equation.outvars[0].aval.dtype
    if old == np.bool_ and new != np.bool_:
        return [elementwise(lambda a: g.select(a, g.one, g.zero), x)]
    if new == np.bool_ and old != np.bool_:
        return [elementwise(lambda a: g.make("ne", a, g.zero), x)]
    if np.issubdtype(new, np.integer) and np.issubdtype(old, np.floating):
        return [elementwise(lambda a: interpreter.ranges.saturated(g.make("trunc", a), new), x)]
    return [x]


@rule("copy", "copy_p", "stop_gradient", "optimization_barrier", "pvary", "sharding_constraint", "mesh_cast")
def identity(interpreter: Interpreter, equation: Any, *operands):
    return operands


@rule("reduce_precision")
def reduce_precision(interpreter: Interpreter, equation: Any, x):
    if equation.params["exponent_bits"] < 11 or equation.params["mantissa_bits"] < 52:
        raise Unsupported("rounds to less than float64")
    return [x]
