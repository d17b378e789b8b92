"""Functions of few numbers under JAX's transformations, by their scalar programs on the host: value, tangents, cotangents.

XLA takes seconds, for a machine half a minute, to compile what is evaluated once a run, and NumPy evaluates the scalar program
in milliseconds. One primitive is the function, its tangent and the tangent of that, each a jaxpr of its own; cotangents are
products with the tangents along every direction, which are evaluated side by side.
"""

import functools
import math
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray, Tracer
from jax.dtypes import float0
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir

import dirax.program.rules  # noqa: F401  (registers the rules)
from dirax.program.graph import GraphTooLarge
from dirax.program.interpreter import UnsupportedPrimitive
from dirax.program.memo import Memo, Same
from dirax.program.pushed_forward import pushed_forward
from dirax.program.rules.differentiable import BACKWARD, has_rules
from dirax.program.scalar_program import ScalarProgram

MOST_NUMBERS = 128
"""Numbers that a function takes from which on its cotangents, one tangent a number, are left to XLA."""

KEPT = 128
"""Functions kept in memory."""

_traced: Memo[tuple[ClosedJaxpr, Any]] = Memo(KEPT)
_programs: Memo[ScalarProgram | None] = Memo(KEPT)
_pushed: Memo[ClosedJaxpr] = Memo(KEPT)


def on_host(function: Callable, leaves: Sequence[Any], key: Hashable) -> Any:
    """`function(*arguments)`, a pytree of float arrays, for each entry of `leaves`, arguments (entries, …) that JAX traces.

    None where the function has no scalar program, closes over values that JAX traces, takes more than `MOST_NUMBERS`, or has a
    derivative in reverse mode alone.
    `key` is equal for functions that are, and has everything in it on which `function` depends.
    """
    shapes = [jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype) for leaf in leaves]
    if jax.default_backend() != "cpu" or sum(math.prod(shape.shape) for shape in shapes) > MOST_NUMBERS:
        return None
    kinds = [(s.shape, s.dtype.str) for s in shapes]
    jaxpr, result = _traced.get((key, *kinds), lambda: jax.make_jaxpr(function, return_shape=True)(*shapes))
    if any(isinstance(c, Tracer) for c in jaxpr.consts) or any(a.dtype != np.float64 for a in jaxpr.out_avals):
        return None
    if _program(jaxpr) is None or has_rules(jaxpr.jaxpr, BACKWARD):
        return None
    return jax.tree.unflatten(jax.tree.structure(result), host_p.bind(*leaves, jaxpr=jaxpr, linear=0))


def called_on_host(function: Callable, widths: Sequence[int], *arrays: Any) -> list[jax.Array]:
    """`function(*arrays)` of arrays (…, n), with all axes but the last as one: arrays (…, width) of these widths, without
    derivatives, by a call of the host from where XLA runs. `vmap` adds axes in front."""

    def called(*given: Any) -> tuple[np.ndarray, ...]:
        lead = np.broadcast_shapes(*(np.shape(a)[:-1] for a in given))
        many = math.prod(lead)  # said, for an array may have no numbers
        flat = (np.broadcast_to(a, (*lead, np.shape(a)[-1])).reshape(many, np.shape(a)[-1]) for a in given)
        return tuple(a.reshape(*lead, a.shape[-1]) for a in function(*flat))

    lead = np.shape(arrays[0])[:-1]
    shapes = [jax.ShapeDtypeStruct((*lead, width), float) for width in widths]
    return list(jax.pure_callback(called, tuple(shapes), *jax.lax.stop_gradient(arrays), vmap_method="expand_dims"))


def _program(jaxpr: ClosedJaxpr) -> ScalarProgram | None:
    def made() -> ScalarProgram | None:
        try:
            return ScalarProgram.of(jaxpr, by_numpy=True)
        except (UnsupportedPrimitive, GraphTooLarge):
            return None

    return _programs.get(Same(jaxpr), made)


def _evaluated(*arrays: Any, jaxpr: ClosedJaxpr) -> tuple[np.ndarray, ...]:
    program = _program(jaxpr)
    assert program is not None
    return tuple(np.ascontiguousarray(a, np.float64) for a in program.in_numpy([np.asarray(a) for a in arrays]))


def _shapes(*operands: Any, jaxpr: ClosedJaxpr, linear: int) -> list[ShapedArray]:
    return [ShapedArray((operands[0].shape[0], *a.shape), a.dtype) for a in jaxpr.out_avals]


def _lowered(context: Any, *operands: Any, jaxpr: ClosedJaxpr, linear: int) -> Any:
    callback = functools.partial(_evaluated, jaxpr=jaxpr)
    return mlir.emit_python_callback(
        context, callback, None, list(operands), context.avals_in, context.avals_out, has_side_effect=False
    )[0]


def _batched(operands: Sequence, axes: Sequence, **parameters: Any) -> tuple[list, list[int]]:
    """An axis of vmap becomes part of that of the entries."""
    size = next(a.shape[axis] for a, axis in zip(operands, axes, strict=True) if axis is not None)
    front = lambda a, axis: jnp.broadcast_to(a, (size, *a.shape)) if axis is None else jnp.moveaxis(a, axis, 0)
    whole = [front(a, axis) for a, axis in zip(operands, axes, strict=True)]
    entries = whole[0].shape[1]
    results = host_p.bind(*(a.reshape(size * entries, *a.shape[2:]) for a in whole), **parameters)
    return [a.reshape(size, entries, *a.shape[1:]) for a in results], [0] * len(results)


def _tangents(primals: Sequence, along: Sequence, *, jaxpr: ClosedJaxpr, linear: int) -> tuple[list, list]:
    results, known = host_p.bind(*primals, jaxpr=jaxpr, linear=linear), len(primals) - linear
    moves = tuple(not isinstance(t, ad.Zero) and t.dtype != float0 for t in along)
    if not any(moves[:known]):
        return results, host_p.bind(*primals[:known], *map(ad.instantiate_zeros, along[known:]), jaxpr=jaxpr, linear=linear)
    chosen = [t for t, moved in zip(along, moves, strict=True) if moved]
    pushed = _pushed.get((Same(jaxpr), moves), lambda: pushed_forward(jaxpr, moves))
    if _program(pushed) is None:
        return results, jax.vmap(jaxpr_as_fun(pushed))(*primals, *chosen)
    return results, host_p.bind(*primals, *chosen, jaxpr=pushed, linear=len(chosen))


def _transposed(cotangents: Sequence, *operands: Any, jaxpr: ClosedJaxpr, linear: int) -> list:
    """Each cotangent by the tangents along the unit vectors of the operands that are not known, all at once."""
    unknown = [i for i, x in enumerate(operands) if ad.is_undefined_primal(x)]
    avals = [operands[i].aval for i in unknown]
    sizes = [math.prod(a.shape[1:]) for a in avals]
    ends = np.cumsum(sizes).tolist()

    def along(unit: Any) -> list:
        given = list(operands)
        for i, aval, size, end in zip(unknown, avals, sizes, ends, strict=True):
            own = unit[end - size : end].reshape(aval.shape[1:]).astype(aval.dtype)
            given[i] = jnp.broadcast_to(own, aval.shape)
        return host_p.bind(*given, jaxpr=jaxpr, linear=linear)

    total = jnp.zeros((sum(sizes), avals[0].shape[0]))
    for rows, flow in zip(jax.vmap(along)(jnp.eye(sum(sizes))), cotangents, strict=True):
        if not isinstance(flow, ad.Zero):
            total = total + jnp.sum(rows * flow[None], axis=tuple(range(2, rows.ndim)))
    found: list = [None] * len(operands)
    for i, aval, size, end in zip(unknown, avals, sizes, ends, strict=True):
        found[i] = total[end - size : end].T.reshape(aval.shape).astype(aval.dtype)
    return found


host_p = Primitive("dirax_on_host")
"""A jaxpr of floats for operands with an axis of entries in front, linear in the `linear` last ones."""
host_p.multiple_results = True
host_p.def_impl(lambda *arrays, jaxpr, linear: [jnp.asarray(a) for a in _evaluated(*arrays, jaxpr=jaxpr)])
host_p.def_abstract_eval(_shapes)
mlir.register_lowering(host_p, _lowered, platform="cpu")
ad.primitive_jvps[host_p] = _tangents
ad.primitive_transposes[host_p] = _transposed
batching.primitive_batchers[host_p] = _batched
