"""Rules of primitives that hold other jaxprs: calls, branches and loops whose length is known beforehand."""

from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr

from dirax.program.given_tangents import value_jaxpr
from dirax.program.interpreter import (
    LOOP_LIMIT,
    Held,
    Interpreter,
    Unavailable,
    Unsupported,
    elementwise,
    rule,
)


def closed(jaxpr: Any) -> ClosedJaxpr:
    return jaxpr if hasattr(jaxpr, "consts") else ClosedJaxpr(jaxpr, ())


CALLS = "jit", "pjit", "closed_call", "core_call", "remat", "checkpoint", "remat2", "composite", "dirax_program"


@rule(*CALLS, lazy=True, pairs=True)
def call(interpreter: Interpreter, equation: Any, *operands):
    """The jaxpr of a function that is called again is the same object; with the same operands it has the same results."""
    p = equation.params
    jaxpr = p["jaxpr"] if "jaxpr" in p else p["call_jaxpr"]
    if any(isinstance(o, Unavailable) for o in jax.tree.leaves(operands)):
        return interpreter.run(closed(jaxpr), *operands)
    key = id(jaxpr), *(part for o in jax.tree.leaves(operands) for part in (o.shape, o.tobytes()))
    if key not in interpreter.called:
        interpreter.called[key] = jaxpr, interpreter.run(closed(jaxpr), *operands)
    return interpreter.called[key][1]


@rule("custom_jvp_call", "custom_vjp_call", "custom_vjp_call_jaxpr", lazy=True, pairs=True)
def custom_derivative(interpreter: Interpreter, equation: Any, *operands):
    return interpreter.run(closed(inner_jaxpr(equation)), *operands)


@rule("dirax_given_tangent", lazy=True)
def given_tangent(interpreter: Interpreter, equation: Any, *operands):
    return interpreter.run(value_jaxpr([v.aval for v in equation.invars], **equation.params), *operands)


def inner_jaxpr(equation: Any) -> Any:
    """What a function with a rule of its own for its derivative is made of."""
    return next(equation.params[key] for key in ("call_jaxpr", "fun_jaxpr", "jaxpr") if key in equation.params)


@rule("cond", lazy=True)
def branches(interpreter: Interpreter, equation: Any, which, *operands):
    """All branches are computed and one is selected: what is not taken may be NaN without harm."""
    if isinstance(which, Unavailable):
        return [which] * len(equation.outvars)
    g, choices = interpreter.graph, equation.params["branches"]
    index = which.item()
    if g.is_constant(index):
        number = min(max(int(g.value[index]), 0), len(choices) - 1)
        return interpreter.run(choices[number], *operands)
    results = [interpreter.run(choice, *operands) for choice in choices]
    boolean = g.is_boolean(index)
    out: list[Any] = results[-1]
    for k in reversed(range(len(results) - 1)):
        test = g.make("not", index) if boolean else g.make("le", index, g.constant(float(k)))
        out = [
            _lost(a, b) or elementwise(lambda x, y, test=test: g.select(test, x, y), *map(np.asarray, (a, b)))
            for a, b in zip(results[k], out, strict=True)
        ]
    return out


def _lost(*operands: Any) -> Unavailable | None:
    lost = next((o for o in operands if isinstance(o, Unavailable)), None)
    return lost and Unavailable(lost.error)


def _entry(along: Any, i: int) -> Any:
    if isinstance(along, Held):
        return Held(along.value[i], along.error)
    return along if isinstance(along, Unavailable) else along[i]


@rule("platform_index")
def platform_index(interpreter: Interpreter, equation: Any, *_):
    """Which branch of `jax.lax.platform_dependent` is meant for a CPU."""
    platforms = list(equation.params["platforms"])
    named = [i for i, names in enumerate(platforms) if names is not None and "cpu" in names]
    return [interpreter.constants(np.int64(named[0] if named else platforms.index(None)))]


@rule("scan", lazy=True)
def scan(interpreter: Interpreter, equation: Any, *operands):
    p = equation.params
    length, fixed, carried = p["length"], p["num_consts"], p["num_carry"]
    if length > LOOP_LIMIT:
        raise Unsupported(f"has {length} iterations; at most {LOOP_LIMIT} are written out")
    consts, carry, along = operands[:fixed], list(operands[fixed : fixed + carried]), operands[fixed + carried :]
    rows: list[Any] = [None] * length
    for i in reversed(range(length)) if p["reverse"] else range(length):
        here = [_entry(x, i) for x in along]
        out = interpreter.run(p["jaxpr"], *consts, *carry, *here)
        carry, rows[i] = out[:carried], out[carried:]
    if length == 0:
        stacked = [np.zeros(v.aval.shape, dtype=np.int64) for v in equation.outvars[carried:]]
    else:
        stacked = [_lost(*column) or np.stack(column) for column in zip(*rows, strict=True)]
    return [*carry, *stacked]


@rule("while", lazy=True)
def loop(interpreter: Interpreter, equation: Any, *operands):
    p = equation.params
    split = p["cond_nconsts"], p["cond_nconsts"] + p["body_nconsts"]
    for_cond, for_body, carry = operands[: split[0]], operands[split[0] : split[1]], list(operands[split[1] :])
    g = interpreter.graph
    for _ in range(LOOP_LIMIT):
        (going,) = interpreter.run(p["cond_jaxpr"], *for_cond, *carry)
        if isinstance(going, Unavailable):
            return [going] * len(equation.outvars)
        if going.size != 1 or not g.is_constant(going.item()):  # under vmap each entry has a condition of its own
            raise Unsupported("is a loop whose length depends on the state")
        if not g.value[going.item()]:
            return carry
        carry = interpreter.run(p["body_jaxpr"], *for_body, *carry)
    raise Unsupported(f"has more than {LOOP_LIMIT} iterations")
