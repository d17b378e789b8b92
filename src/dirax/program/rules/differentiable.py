"""The rules of a graph that has the derivatives of JAX, also of functions that have rules of their own for them.

Such a function is its value, which moves as its rule says: with T the tangent of the rule, linear in its second argument,
f(x) = ruled(f(x), T(held x, motion of x)). Otherwise a graph has them as what they are made of, and differentiates that.
"""

import functools
from collections.abc import Callable, Container
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun, jaxprs_in_params

from dirax.program.complex_numbers import is_complex
from dirax.program.interpreter import Interpreter, Nodes, Rule, Unavailable, Unsupported, elementwise
from dirax.program.memo import Memo, Same
from dirax.program.rules import derivative_primitives, formulas
from dirax.program.rules.control import closed, inner_jaxpr

KEPT = 256
"""Tangents kept in memory."""

_tangents: Memo[ClosedJaxpr] = Memo(KEPT)


def stopped(interpreter: Interpreter, equation: Any, *operands: Nodes) -> list[Nodes]:
    return [elementwise(functools.partial(interpreter.graph.make, "held"), x) for x in operands]


def by_its_rule(interpreter: Interpreter, equation: Any, *operands: Any) -> list[Any]:
    if lost := next((x for x in operands if isinstance(x, Unavailable)), None):
        return [Unavailable(lost.error)] * len(equation.outvars)
    if any(map(is_complex, (*equation.invars, *equation.outvars))):
        raise Unsupported("has a rule of its own for its derivative by complex numbers")
    make, plain = interpreter.graph.make, Interpreter(interpreter.graph)
    values = plain.run(closed(inner_jaxpr(equation)), *operands)
    of = lambda op, arrays: [elementwise(functools.partial(make, op), x) for x in arrays]
    moving = [x for x, v in zip(operands, equation.invars, strict=True) if is_float(v)]
    along = iter(plain.run(tangent(equation), *of("held", operands), *of("motion", moving)))
    return [_ruled(make, x, next(along)) if is_float(v) else x for x, v in zip(values, equation.outvars, strict=True)]


def _ruled(make: Callable[..., int], value: Any, along: Any) -> Any:
    lost = next((x for x in (value, along) if isinstance(x, Unavailable)), None)
    return Unavailable(lost.error) if lost else elementwise(functools.partial(make, "ruled"), value, along)


def is_float(variable: Any) -> bool:
    return bool(np.issubdtype(variable.aval.dtype, np.floating))


def tangent(equation: Any) -> ClosedJaxpr:
    """The jaxpr of (operands, motions of those that are floats) ↦ the motions of results that are floats. Raises `Unsupported`
    where they are no linear functions of those of the operands."""
    p, inner = equation.params, getattr(inner_jaxpr(equation), "jaxpr", inner_jaxpr(equation))
    rule = next((p[key] for key in ("jvp_jaxpr_fun", "bwd") if key in p), None)

    def traced() -> ClosedJaxpr:
        alone = inner.replace(constvars=(), outvars=equation.outvars, eqns=[equation.replace(invars=inner.invars)])
        whole, floats = jaxpr_as_fun(ClosedJaxpr(alone, ())), [k for k, v in enumerate(inner.invars) if is_float(v)]
        shapes = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in inner.invars]

        def along(*values: Any) -> list:
            x, motions = values[: len(shapes)], values[len(shapes) :]

            def of_floats(*chosen):
                known = dict(zip(floats, chosen, strict=True))
                results = whole(*(known.get(k, value) for k, value in enumerate(x)))
                return [y for y, v in zip(results, equation.outvars, strict=True) if is_float(v)]

            point = tuple(x[k] for k in floats)
            if "bwd" in p:  # the transpose of what it does backward
                value, back = jax.vjp(of_floats, *point)
                return jax.linear_transpose(lambda flow: back(flow), value)(motions)[0]
            forward = lambda *motions: jax.jvp(of_floats, point, motions)[1]
            jax.linear_transpose(forward, *motions)(jax.eval_shape(of_floats, *point))
            return forward(*motions)

        return jax.make_jaxpr(along)(*shapes, *(shapes[k] for k in floats))

    try:
        return _tangents.get((Same(inner), Same(rule)), traced)
    except Exception as error:
        raise Unsupported(f"has a derivative that is no linear function: {error}") from error


BACKWARD = ("custom_vjp_call", "custom_vjp_call_jaxpr")
"""Functions that JAX derives in reverse mode alone."""


def formula(interpreter: Interpreter, equation: Any, *operands: Nodes) -> list[Nodes]:
    nodes = [operand.item() for operand in operands]
    return [np.array(formulas.differentiable(interpreter.graph, equation.params["formula"], nodes), np.int64)]


RULED: dict[str, Rule] = {
    "stop_gradient": stopped,
    "dirax_formula": formula,
    **dict.fromkeys(("custom_jvp_call", *BACKWARD), by_its_rule),
}
DIFFERENTIABLE = dict(RULED)

for _primitive in ("derivative", "directional", "pullback"):
    _rule = getattr(derivative_primitives, _primitive)
    DIFFERENTIABLE["dirax_" + _primitive] = functools.partial(_rule, kept=DIFFERENTIABLE)


def has_rules(jaxpr: Any, names: Container[str] = RULED) -> bool:
    """Whether a function in a jaxpr has a rule of its own for its derivative, of the primitives of these names."""
    known: dict[int, bool] = {}

    def is_needed(equation: Any) -> bool:
        return "formula" not in equation.params or equation.params["formula"].is_restricted

    def found(jaxpr: Any) -> bool:
        if id(jaxpr) not in known:
            inner = (getattr(j, "jaxpr", j) for e in jaxpr.eqns for j in jaxprs_in_params(e.params))
            known[id(jaxpr)] = any(e.primitive.name in names and is_needed(e) for e in jaxpr.eqns) or any(map(found, inner))
        return known[id(jaxpr)]

    return found(jaxpr)
