"""Tracing of functions whose step becomes a scalar graph: the user's functions once, first derivatives left to the graph.

JAX takes a few milliseconds to differentiate what it traces, and the graph some microseconds. Everywhere else `gradient` and
`jacobian` are `jax.grad` and `jax.jacfwd`.
"""

import functools
import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray, Tracer
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun, jaxprs_in_params

from dirax.program.primitives import deferred

_traced: ContextVar[dict | None] = ContextVar("functions of the user that were traced", default=None)
_in_scalars: ContextVar[bool] = ContextVar("whether what is traced becomes a scalar graph", default=False)

PLAIN = frozenset(
    (
        *("add", "sub", "mul", "div", "neg", "integer_pow", "pow", "square", "sqrt", "rsqrt", "cbrt", "exp", "exp2", "expm1"),
        *("log", "log1p", "sin", "cos", "tan", "atan", "atan2", "sinh", "cosh", "tanh", "asinh", "erf", "erfc", "select_n"),
        *("lt", "le", "gt", "ge", "eq", "ne", "and", "or", "not", "is_finite", "convert_element_type", "copy", "reshape"),
        *("squeeze", "expand_dims", "broadcast_in_dim", "transpose", "rev", "concatenate", "stack", "unstack", "tile", "split"),
        *("slice", "pad", "iota", "gather", "dynamic_slice", "dynamic_update_slice", "scatter", "scatter-add", "reduce_sum"),
        *("dot_general", "add_any", "jit", "pjit", "closed_call", "dirax_derivative", "dirax_formula"),
    )
)
"""Primitives whose derivative is the same for JAX and for the graph, and as accurate: no corners (of an absolute value, a
maximum), no solves, which the graph would take apart, and no functions with an edge near which the
graph loses digits or meets ∞·0 (an arcsine, a logistic function)."""

RULE = "custom_jvp_call"
"""A function with a rule of its own for its derivative, which the graph knows how to take where it is one of numbers."""

PATIENCE = 200_000
"""New objects after which Python looks for garbage while something is traced; it takes a tenth of the time as it comes."""


@contextmanager
def once() -> Iterator[None]:
    """Within, every function of the user is traced once for arguments of one kind, and garbage is looked for less often."""
    if _traced.get() is not None:
        yield
        return
    token, before = _traced.set({}), gc.get_threshold()
    gc.set_threshold(max(before[0], PATIENCE) if before[0] else 0, *before[1:])
    try:
        yield
    finally:
        _traced.reset(token)
        gc.set_threshold(*before)


@contextmanager
def in_scalars() -> Iterator[None]:
    """Within, what is traced becomes a scalar graph."""
    with once():
        token = _in_scalars.set(True)
        try:
            yield
        finally:
            _in_scalars.reset(token)


def becomes_scalars(*values: Any) -> bool:
    """Whether what is traced becomes a scalar graph, and the values are arrays of floats."""
    return _in_scalars.get() and all(jnp.result_type(x) == jnp.float64 for x in values)


def call(function: Callable, *values: Any) -> Any:
    """`function(*values)`, which within `once` is traced once for values of one kind; equal functions count as one."""
    known = _traced.get()
    if known is None or not _hashable(function):
        return function(*values)
    if function not in known:
        known[function] = jax.jit(function)
    return known[function](*values)


def shared(function: Callable) -> Callable:
    """A function that is traced once wherever it is used, with derivatives by the graph and by JAX apart."""
    by_jax, by_graph = jax.jit(function), jax.jit(lambda *values: function(*values))
    return lambda *values: (by_graph if _in_scalars.get() else by_jax)(*values)


@dataclass(frozen=True)
class Method:
    """A method of an object, equal for equal objects; quicker to make and to compare than those of equinox."""

    method: Callable
    owner: Any

    def __call__(self, *values):
        return self.method(self.owner, *values)


def traced_once(method: Callable) -> Callable:
    """A method that within `once` is traced once for values of one kind and equal objects."""

    @functools.wraps(method)
    def bound(self, *values, **named):
        return method(self, *values, **named) if named else call(Method(method, self), *values)

    return bound


def _hashable(function: Callable) -> bool:
    try:
        hash(function)
    except TypeError:  # the method of an object that holds arrays
        return False
    return True


def gradient(function: Callable, argnums: int | tuple[int, ...] = 0) -> Callable:
    """`jax.grad(function, argnums)`, by the graph where that is built and has the same derivative."""
    return _derivative(function, argnums, jax.grad)


def jacobian(function: Callable, argnums: int | tuple[int, ...] = 0, reverse: bool = False) -> Callable:
    """`jax.jacfwd(function, argnums)`, or `jax.jacrev`, of a function with one array, by the graph as above."""
    return _derivative(function, argnums, jax.jacrev if reverse else jax.jacfwd)


def along(function: Callable, point: tuple, direction: tuple) -> Any:
    """The derivative of a function with one array at `point` along `direction`, `jax.jvp(…)[1]`, by the graph as above."""
    if not _in_scalars.get():
        return jax.jvp(function, point, direction)[1]
    shifted = lambda s: function(*(x + s * v for x, v in zip(point, direction, strict=True)))
    by_jax = lambda function, _: lambda s: jax.jvp(function, (s,), (jnp.ones(()),))[1]
    return _derivative(shifted, 0, by_jax)(np.zeros(()))


def value_along(function: Callable, point: tuple, direction: tuple) -> tuple[Any, Any]:
    """`jax.jvp(function, point, direction)` of a function with one array, its derivative by the graph as above."""
    if not _in_scalars.get():
        return jax.jvp(function, point, direction)
    return function(*point), along(function, point, direction)


def _derivative(function: Callable, argnums: int | tuple[int, ...], by_jax: Callable) -> Callable:
    def derivative(*values):
        if not _in_scalars.get():
            return by_jax(function, argnums)(*values)
        chosen = (argnums,) if isinstance(argnums, int) else tuple(argnums)
        leaves, structure = jax.tree.flatten(values)
        places, at = [], 0
        for value in values:
            places.append(at)
            at += len(jax.tree.leaves(value))
        flat = lambda *leaves: function(*jax.tree.unflatten(structure, leaves))
        jaxpr, captured, result = closed_over(flat, leaves)
        operands = [x if isinstance(x, Tracer) else np.asarray(x) for x in (*captured, *leaves)]
        one = isinstance(result, jax.ShapeDtypeStruct) and not (by_jax is jax.grad and result.shape)
        floats = one and all(x.dtype == np.float64 for x in (result, *operands))
        if not floats or not _plain(jaxpr.jaxpr):
            return by_jax(function, argnums)(*values)
        wanted = [len(captured) + places[k] for k in chosen]
        found = derivative_p.bind(*operands, jaxpr=jaxpr, wanted=tuple(wanted))
        return found[0] if isinstance(argnums, int) else tuple(found)

    return derivative


def closed_over(function: Callable, values: list) -> tuple[ClosedJaxpr, list, Any]:
    """The jaxpr of a function, with the traced values that it captures as its first arguments; these; what it returns."""
    closed, result = jax.make_jaxpr(function, return_shape=True)(*values)
    moves = [isinstance(value, Tracer) for value in closed.consts]
    pairs = list(zip(closed.jaxpr.constvars, closed.consts, moves, strict=True))
    free = [variable for variable, _, traced in pairs if traced]
    jaxpr = closed.jaxpr.replace(
        constvars=[variable for variable, _, traced in pairs if not traced], invars=[*free, *closed.jaxpr.invars]
    )
    fixed = [value for _, value, traced in pairs if not traced]
    return ClosedJaxpr(jaxpr, fixed), [value for _, value, traced in pairs if traced], result


def _plain(jaxpr: Any) -> bool:
    return all(_numbers(e) if e.primitive.name == RULE else _plain_one(e) for e in jaxpr.eqns)


def _plain_one(equation: Any) -> bool:
    known = equation.primitive.name in PLAIN or equation.params.get("apart", False)
    return known and all(map(_plain, jaxprs_in_params(equation.params)))


def _numbers(equation: Any) -> bool:
    """Whether an equation takes floating-point numbers to one."""
    variables = [*equation.invars, *equation.outvars]
    return len(equation.outvars) == 1 and all(v.aval.shape == () and v.aval.dtype == np.float64 for v in variables)


def _by_jax(*operands, jaxpr: ClosedJaxpr, wanted: tuple[int, ...]):
    (result,) = jaxpr.out_avals
    function = lambda *values: jaxpr_as_fun(jaxpr)(*values)[0]
    return (jax.jacfwd if result.shape else jax.grad)(function, wanted)(*operands)


def _shapes(*operands, jaxpr: ClosedJaxpr, wanted: tuple[int, ...]):
    (result,) = jaxpr.out_avals
    return [ShapedArray((*result.shape, *operands[k].shape), result.dtype) for k in wanted]


derivative_p = deferred("dirax_derivative", _by_jax, _shapes)
"""The derivatives of a jaxpr of floats with one result by the operands numbered `wanted`, one result each."""
