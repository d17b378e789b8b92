"""Functions whose derivative is given: as `jax.custom_jvp`, but the rule is kept wherever the function is differentiated.

JAX forgets the rule of a custom_jvp where it takes a derivative in reverse mode through `scan` or `checkpoint`: a second
derivative then differentiates the function's own code. For a root that is found elsewhere and handed in, that gives zero.
A primitive keeps its rule.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.dtypes import float0
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

from dirax.program.derivatives_by_jax import along_by_jax, jacobian_by_jax
from dirax.program.primitives import is_tracing
from dirax.program.tracing import closed_over

Axes = tuple[tuple[int | None, ...], ...]
"""The axes of the operands under each `jax.vmap` that the function went through, the innermost first."""


def with_tangent(value: Callable[..., Any], tangent: Callable[..., Array], *operands: Any) -> Array:
    """`value(*operands)`, one array, whose derivative is `tangent(result, operands, along)`.

    `along` has the tangent of each operand, None for those that do not move. Both functions capture no traced values.
    """
    if not is_tracing():
        return value(*operands)
    return given_p.bind(*map(jnp.asarray, operands), value=value, tangent=tangent, axes=())


def implicit(residual: Callable, root: Array, values: Any, solve: Callable[..., Array], *known: Array) -> Array:
    """`root` (k,), with its derivatives as the function of `values`, any pytree, that residual(root, values) = 0 makes of it.

    `solve(matrix (k, k), right (k,), *known)` is a solution of the linear system, differentiable itself, but for what is `known`
    of it. What `residual` captures is differentiated by too.
    """
    leaves, structure = jax.tree.flatten(values)
    closed, captured, _ = closed_over(lambda u, *leaves: residual(u, jax.tree.unflatten(structure, leaves)), [root, *leaves])
    count, first = len(captured), 1 + len(known)
    left = lambda u, *operands: jaxpr_as_fun(closed)(*operands[:count], u, *operands[count:])[0]

    def tangent(root, operands, along):
        solved = lambda matrix, right: solve(matrix, right, *operands[1:first])
        return implicit_tangent(left, root, operands[first:], along[first:], solved)

    return with_tangent(lambda root, *_: root, tangent, *map(jax.lax.stop_gradient, (root, *known)), *captured, *leaves)


def implicit_tangent(residual: Callable, root: Array, operands: Sequence, along: Sequence, solve: Callable) -> Array:
    """The tangent (k,) of the root of residual(root, *operands) = 0 where the operands move along `along`, None for those
    that stay; `solve` as in `implicit`."""
    moving = [k for k, x in enumerate(along) if x is not None]
    if not moving:
        return jnp.zeros_like(root)

    def of_moving(*chosen):
        given = list(operands)
        for k, x in zip(moving, chosen, strict=True):
            given[k] = x
        return residual(root, *given)

    points, directions = (tuple(values[k] for k in moving) for values in (operands, along))
    right = along_by_jax(of_moving, points, directions)
    return -solve(jacobian_by_jax(lambda u: residual(u, *operands))(root), right)


def over(function: Callable, axes: Axes) -> Callable:
    """A function of operands under the `jax.vmap`s that they went through."""
    for one in axes:
        function = jax.vmap(function, in_axes=one)
    return function


def value_jaxpr(shapes: Sequence, *, value: Callable, tangent: Callable, axes: Axes) -> ClosedJaxpr:
    """What a function of arguments of these shapes is, but for its derivative."""
    return jax.make_jaxpr(over(value, axes))(*shapes)


def _by_jax(*operands, value: Callable, tangent: Callable, axes: Axes) -> Array:
    return over(value, axes)(*operands)


def _tangents(primals: Sequence, tangents: Sequence, *, value: Callable, tangent: Callable, axes: Axes):
    result = given_p.bind(*primals, value=value, tangent=tangent, axes=axes)
    return result, tangent_over(tangent, result, primals, tangents, axes)


def tangent_over(tangent: Callable[..., Array], result: Array, operands: Sequence, tangents: Sequence, axes: Axes) -> Array:
    """`tangent(result, operands, along)` as `with_tangent` has it, under the `jax.vmap`s of the operands, for the tangents that
    JAX hands to a rule."""
    moves = [not isinstance(t, ad.Zero) and getattr(t, "dtype", None) != float0 for t in tangents]
    count = len(operands)

    def one(result, *given):
        along = iter(given[count:])
        return tangent(result, given[:count], [next(along) if moved else None for moved in moves])

    levels = tuple((0, *level, *(a for a, moved in zip(level, moves, strict=True) if moved)) for level in axes)
    return over(one, levels)(result, *operands, *(t for t, moved in zip(tangents, moves, strict=True) if moved))


def lead_of(operands: Sequence, axes: Axes) -> tuple[int, ...]:
    """The lengths of the axes that the results have for the `jax.vmap`s of the operands, which have such axes in front."""
    lead, shapes = [], [x.shape for x in operands]
    for level in reversed(axes):
        lead.append(next(shape[0] for shape, axis in zip(shapes, level, strict=True) if axis is not None))
        shapes = [shape if axis is None else shape[1:] for shape, axis in zip(shapes, level, strict=True)]
    return tuple(lead)


def at_place(operands: Sequence, axes: Axes, index: tuple[int, ...]) -> list:
    """The operands for one place of the axes that `jax.vmap`s gave them."""
    own = [[i for i, level in zip(index, reversed(axes), strict=True) if level[k] is not None] for k in range(len(operands))]
    return [x[tuple(place)] for x, place in zip(operands, own, strict=True)]


def stays_one(primitive: Primitive) -> Callable:
    """The rule of `jax.vmap` for a primitive that stays one equation, and is told of the axis."""

    def batched(operands: Sequence, dimensions: Sequence, *, axes: Axes, **parameters: Any):
        moved = [x if d is None else jnp.moveaxis(x, d, 0) for x, d in zip(operands, dimensions, strict=True)]
        level = tuple(None if d is None else 0 for d in dimensions)
        found = primitive.bind(*moved, **parameters, axes=(*axes, level))
        return found, [0] * len(found) if primitive.multiple_results else 0

    return batched


def _shape(*operands, value: Callable, tangent: Callable, axes: Axes) -> ShapedArray:
    found = jax.eval_shape(over(value, axes), *(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in operands))
    return ShapedArray(found.shape, found.dtype)


given_p = Primitive("dirax_given_tangent")
given_p.def_impl(_by_jax)
given_p.def_abstract_eval(_shape)
ad.primitive_jvps[given_p] = _tangents
batching.primitive_batchers[given_p] = stays_one(given_p)
mlir.register_lowering(given_p, mlir.lower_fun(_by_jax, multiple_results=False))
