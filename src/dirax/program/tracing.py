"""Tracing of functions that may become scalar programs: each once, and derivatives as equations of the jaxpr."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.core import ShapedArray, Tracer
from jax.extend.core import ClosedJaxpr, Var, jaxpr_as_fun, jaxprs_in_params

from dirax.program.derivatives_by_jax import gradient_by_jax, jacobian_by_jax
from dirax.program.memo import Memo, Same
from dirax.program.primitives import binds, is_tracing, plain_primitive
from dirax.program.same_jaxpr import shared

KEPT = 512
"""Traced functions kept in memory."""

CALLS = ("jit", "pjit", "closed_call")
"""Primitives that do no more than their jaxpr says."""

PLAIN = frozenset(
    (
        *("add", "sub", "mul", "div", "neg", "integer_pow", "pow", "square", "sqrt", "rsqrt", "cbrt", "exp", "exp2", "expm1"),
        *("log", "log1p", "sin", "cos", "tan", "atan", "atan2", "sinh", "cosh", "tanh", "asinh", "erf", "erfc", "select_n"),
        *("lt", "le", "gt", "ge", "eq", "ne", "and", "or", "not", "is_finite", "convert_element_type", "copy", "reshape"),
        *("squeeze", "expand_dims", "broadcast_in_dim", "transpose", "rev", "concatenate", "stack", "unstack", "tile", "split"),
        *("slice", "pad", "iota", "gather", "dynamic_slice", "dynamic_update_slice", "scatter", "scatter-add", "reduce_sum"),
        *("dot_general", "add_any", *CALLS, "floor", "ceil", "round", "sign"),
        *("dirax_derivative", "dirax_directional", "dirax_pullback", "dirax_formula", "dirax_program"),
    )
)
"""Primitives whose derivative is the same for JAX and for the graph, and as accurate: no corners (of an absolute value, a
maximum), no solves, which the graph would take apart, and no functions with an edge near which the
graph loses digits or meets ∞·0 (an arcsine, a logistic function)."""

COMPARED = frozenset(("abs", "max", "min", "clamp", "reduce_max", "reduce_min", "stop_gradient", "dirax_solve"))
"""Others that the graph has, which have no derivative where they lead to comparisons alone."""

RULE = "custom_jvp_call"
"""A function with a rule of its own for its derivative, which the graph knows how to take where it is one of numbers."""

_jitted: Memo[Callable] = Memo(KEPT)
_inner: Memo[bool] = Memo(KEPT)


class once:
    """`function(*first, ·)`, traced once for values of one kind wherever JAX traces it; plain calls elsewhere.

    Equal functions with equal `first` count as one: of an object's methods, `first` is the object. Also a decorator of
    functions and of methods.
    """

    def __init__(self, function: Callable, *first: Any):
        self.function, self.first, self.__doc__ = function, first, function.__doc__

    def __call__(self, *values: Any) -> Any:
        plain = functools.partial(self.function, *self.first) if self.first else self.function
        return _jitted.get(self, lambda: jax.jit(plain))(*values) if is_tracing() and _has_hash(self) else plain(*values)

    def __get__(self, owner: Any, kind: type | None = None) -> "once":
        return self if owner is None else once(self.function, owner)

    def __eq__(self, other: Any) -> bool:
        return isinstance(other, once) and self.function == other.function and self.first == other.first

    def __hash__(self) -> int:
        return hash((self.function, self.first))


def _has_hash(value: Any) -> bool:
    try:
        hash(value)
    except TypeError:  # the method of an object that holds arrays
        return False
    return True


def gradient(function: Callable, argnums: int | tuple[int, ...] = 0) -> Callable:
    """`jax.grad(function, argnums)`."""
    return _derivative(function, argnums, gradient_by_jax)


def jacobian(function: Callable, argnums: int | tuple[int, ...] = 0, reverse: bool = False) -> Callable:
    """`jax.jacfwd(function, argnums)`, or `jax.jacrev`, of a function with one array."""
    return _derivative(function, argnums, jax.jacrev if reverse else jacobian_by_jax)


def along(function: Callable, point: tuple, direction: tuple) -> Any:
    """The derivative of a function with one array at `point` along `direction`: `jax.jvp(function, point, direction)[1]`."""
    if is_tracing():
        traced = _Traced(function, point)
        if traced.is_plain and binds(*direction) and len(jax.tree.leaves(direction)) == len(traced.leaves):
            operands = (*traced.captured, *traced.leaves, *map(operand, direction))
            return directional_p.bind(*operands, jaxpr=traced.jaxpr, count=len(direction))[0]
    return jax.jvp(function, point, direction)[1]


def pulled_back(function: Callable, point: Any, covector: Any) -> Any:
    """(∂f/∂x)ᵀ·covector for a function of one array with an array (c,): `jax.vjp(function, point)[1](covector)[0]`."""
    if is_tracing():
        traced = _Traced(function, (point,))
        if traced.is_plain and binds(covector):
            return pullback_p.bind(*traced.captured, *traced.leaves, operand(covector), jaxpr=traced.jaxpr)[0]
    return _pullback(function, point, covector)


def value_along(function: Callable, point: tuple, direction: tuple) -> tuple[Any, Any]:
    """`jax.jvp(function, point, direction)` of a function with one array."""
    return (function(*point), along(function, point, direction)) if is_tracing() else jax.jvp(function, point, direction)


def _derivative(function: Callable, argnums: int | tuple[int, ...], by_jax: Callable) -> Callable:
    def derivative(*values):
        if not is_tracing():
            return by_jax(function, argnums)(*values)
        traced = _Traced(function, values)
        if not traced.is_plain or (by_jax is gradient_by_jax and traced.result.shape):
            return by_jax(function, argnums)(*values)
        chosen = (argnums,) if isinstance(argnums, int) else tuple(argnums)
        starts = np.cumsum([0, *(len(jax.tree.leaves(value)) for value in values)])
        wanted = tuple(len(traced.captured) + int(starts[k]) for k in chosen)
        reverse = by_jax is not jacobian_by_jax
        found = derivative_p.bind(*traced.captured, *traced.leaves, jaxpr=traced.jaxpr, wanted=wanted, reverse=reverse)
        return found[0] if isinstance(argnums, int) else tuple(found)

    return derivative


def operand(value: Any) -> Any:
    """A value as an operand of a primitive."""
    return value if isinstance(value, Tracer) else np.asarray(value)


class _Traced:
    """A function at values, for a primitive of its derivative: `jaxpr` of the captured values and then the leaves."""

    def __init__(self, function: Callable, values: tuple):
        leaves, structure = jax.tree.flatten(values)
        self.jaxpr, captured, self.result = closed_over(lambda *leaves: function(*jax.tree.unflatten(structure, leaves)), leaves)
        self.captured, self.leaves = [*map(operand, captured)], [*map(operand, leaves)]

    @property
    def is_plain(self) -> bool:
        """Whether it is one array of floats and the graph has the same derivative as JAX."""
        one = isinstance(self.result, jax.ShapeDtypeStruct)
        return (
            one
            and all(x.dtype == np.float64 for x in (self.result, *self.captured, *self.leaves))
            and all_plain(self.jaxpr.jaxpr)
        )


def closed_over(function: Callable, values: list) -> tuple[ClosedJaxpr, list, Any]:
    """The jaxpr of a function, with the traced values that it captures as its first arguments, the same object for functions that
    say the same; these values; what it returns."""
    closed, result = jax.make_jaxpr(function, return_shape=True)(*values)
    moves = [isinstance(value, Tracer) for value in closed.consts]
    pairs = list(zip(closed.jaxpr.constvars, closed.consts, moves, strict=True))
    free = [variable for variable, _, traced in pairs if traced]
    jaxpr = closed.jaxpr.replace(
        constvars=[variable for variable, _, traced in pairs if not traced], invars=[*free, *closed.jaxpr.invars]
    )
    fixed = [value for _, value, traced in pairs if not traced]
    return shared(ClosedJaxpr(jaxpr, fixed)), [value for _, value, traced in pairs if traced], result


def alone(jaxpr: Any, equation: Any) -> tuple[ClosedJaxpr, list[Var]]:
    """One equation of a jaxpr as a jaxpr of the variables in it."""
    variables = list(dict.fromkeys(atom for atom in equation.invars if isinstance(atom, Var)))
    one = jaxpr.replace(constvars=(), invars=variables, outvars=equation.outvars, eqns=[equation])
    return ClosedJaxpr(one, ()), variables


def all_plain(jaxpr: Any) -> bool:
    """Whether the graph has the same derivative as JAX of all that a jaxpr does; what leads to comparisons alone has none."""
    moving = {v for v in jaxpr.outvars if _has_derivative(v)}
    for equation in reversed(jaxpr.eqns):
        moves = not moving.isdisjoint(equation.outvars)
        if not _is_plain(equation, moves):
            return False
        if moves:
            moving.update(v for v in equation.invars if _has_derivative(v))
    return True


def _has_derivative(value: Any) -> bool:
    """Whether a value of a jaxpr is a variable that has a derivative."""
    kind: Any = value.aval
    return isinstance(value, Var) and bool(np.issubdtype(kind.dtype, np.floating))


def _is_plain(equation: Any, moves: bool) -> bool:
    """Whether the graph has what an equation does, and its derivative where its results move."""
    name = equation.primitive.name
    if name == RULE:
        return _numbers(equation)
    known = name in PLAIN or (name in COMPARED and not moves) or equation.params.get("apart", False)
    return known and all(_is_plain_within(jaxpr, moves) for jaxpr in jaxprs_in_params(equation.params))


def _is_plain_within(jaxpr: Any, moves: bool) -> bool:
    """The same of a function that is called, which is so in many places, and is asked once."""
    every = lambda: all_plain(jaxpr) if moves else all(_is_plain(equation, False) for equation in jaxpr.eqns)
    return _inner.get((Same(jaxpr), moves), every)


def _numbers(equation: Any) -> bool:
    """Whether an equation takes floating-point numbers to one."""
    variables = [*equation.invars, *equation.outvars]
    return len(equation.outvars) == 1 and all(v.aval.shape == () and v.aval.dtype == np.float64 for v in variables)


def of_one_result(jaxpr: ClosedJaxpr) -> Callable:
    """A jaxpr with one result as a function."""
    return lambda *values: jaxpr_as_fun(jaxpr)(*values)[0]


def _derivatives_by_jax(*operands, jaxpr: ClosedJaxpr, wanted: tuple[int, ...], reverse: bool):
    (result,) = jaxpr.out_avals
    by_jax = jax.grad if not result.shape else jax.jacrev if reverse else jacobian_by_jax
    return by_jax(of_one_result(jaxpr), wanted)(*operands)


def _derivative_shapes(*operands, jaxpr: ClosedJaxpr, wanted: tuple[int, ...], reverse: bool):
    (result,) = jaxpr.out_avals
    return [ShapedArray((*result.shape, *operands[k].shape), result.dtype) for k in wanted]


derivative_p = plain_primitive("dirax_derivative", _derivatives_by_jax, _derivative_shapes)
"""The derivatives of a jaxpr of floats with one result by the operands numbered `wanted`, one result each."""


LARGEST_MATRIX = 4096
"""Entries of a derivative up to which a covector is multiplied by it, and not pulled back without it."""


def _pullback(function: Callable, point: Any, covector: Any) -> Any:
    if covector.size * point.size <= LARGEST_MATRIX:
        return jax.jacrev(function)(point).T @ covector
    return jax.vjp(function, point)[1](covector)[0]


def _pullback_by_jax(*operands, jaxpr: ClosedJaxpr):
    """Its operands are captured values, the point and the covector."""
    *captured, point, covector = operands
    return [_pullback(lambda point: of_one_result(jaxpr)(*captured, point), point, covector)]


pullback_p = plain_primitive("dirax_pullback", _pullback_by_jax, lambda *operands, jaxpr: [operands[-2]])
"""The product of a covector with the derivative of a jaxpr of floats by its last operand."""


def _directional_by_jax(*operands, jaxpr: ClosedJaxpr, count: int):
    """Its operands are captured values, the point and the direction (`count` arrays each)."""
    captured, point, direction = operands[: -2 * count], operands[-2 * count : -count], operands[-count:]
    return [jax.jvp(lambda *point: of_one_result(jaxpr)(*captured, *point), tuple(point), tuple(direction))[1]]


directional_p = plain_primitive("dirax_directional", _directional_by_jax, lambda *_, jaxpr, count: jaxpr.out_avals)
"""The derivative of a jaxpr of floats with one result along a direction."""
