"""Functions of few numbers under JAX's transformations, by their scalar programs on the host: value, tangents, cotangents.

XLA takes seconds, for a machine half a minute, to compile what is evaluated once a run, and NumPy evaluates the scalar program
in milliseconds. One primitive is the function, its tangent and the tangent of that, each a jaxpr of its own; another one is the
cotangents of these, products with the tangents along every direction, which are evaluated side by side.
"""

import atexit
import contextlib
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

TOGETHER = 2**15
"""Entries times directions that cotangents are evaluated for at a time."""

_traced: Memo[tuple[ClosedJaxpr, Any]] = Memo(KEPT)
_programs: Memo[ScalarProgram | None] = Memo(KEPT)
_pushed: Memo[ClosedJaxpr] = Memo(KEPT)


def on_host(function: Callable, leaves: Sequence[Any], key: Hashable, fixed: int = 0) -> Any:
    """`function(*arguments)`, a pytree of float arrays, for each entry of `leaves`, arguments (entries, …) that JAX traces.

    So many arguments are `fixed`: nothing is differentiated by the first ones, and where the very first is NaN, the entry is
    left out, and its results are NaN with derivatives of zero.
    None where the function has no scalar program, closes over values that JAX traces, takes more than `MOST_NUMBERS`, or has a
    derivative in reverse mode alone.
    `key` is equal for functions that are, and has everything in it on which `function` depends.
    """
    made = host_program(function, [jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype) for leaf in leaves], key, fixed)
    if made is None:
        return None
    jaxpr, result = made
    leaves = [*jax.lax.stop_gradient(tuple(leaves[:fixed])), *leaves[fixed:]]
    found = host_p.bind(*leaves, jaxpr=jaxpr, linear=0, some=fixed > 0)
    return jax.tree.unflatten(jax.tree.structure(result), found)


def host_program(function: Callable, shapes: Sequence[Any], key: Hashable, fixed: int = 0) -> tuple[ClosedJaxpr, Any] | None:
    """What `on_host` evaluates of arguments of these shapes, without entries, and the structure of its results; None where it
    does."""
    if jax.default_backend() != "cpu" or sum(math.prod(shape.shape) for shape in shapes[fixed:]) > MOST_NUMBERS:
        return None
    kinds = [(s.shape, np.dtype(s.dtype).str) for s in shapes]
    jaxpr, result = _traced.get((key, *kinds), lambda: jax.make_jaxpr(function, return_shape=True)(*shapes))
    if any(isinstance(c, Tracer) for c in jaxpr.consts) or any(a.dtype != np.float64 for a in jaxpr.out_avals):
        return None
    return None if _program(jaxpr) is None or has_rules(jaxpr.jaxpr, BACKWARD) else (jaxpr, result)


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


@atexit.register
def _come_to_an_end() -> None:
    """Wait for what is still computed: a call of Python that is going on where Python ends would end it with an error."""
    for array in jax.live_arrays():
        with contextlib.suppress(Exception):
            array.block_until_ready()


def _program(jaxpr: ClosedJaxpr) -> ScalarProgram | None:
    def made() -> ScalarProgram | None:
        try:
            return ScalarProgram.of(jaxpr, by_numpy=True)
        except (UnsupportedPrimitive, GraphTooLarge):
            return None

    return _programs.get(Same(jaxpr), made)


def _evaluated(*arrays: Any, jaxpr: ClosedJaxpr, linear: int, some: bool) -> tuple[np.ndarray, ...]:
    """The results of every entry; with `some`, of those whose first operand is a number."""
    program, arrays = _program(jaxpr), tuple(map(np.asarray, arrays))
    assert program is not None
    if not some:
        return tuple(np.ascontiguousarray(a, np.float64) for a in program.in_numpy(list(arrays)))
    there, fill = _there(arrays[0]), 0.0 if linear else np.nan
    own = [a[there] for a in arrays]
    results = program.in_numpy(own) if len(own[0]) else [np.zeros((0, *a.shape)) for a in jaxpr.out_avals]
    whole = tuple(np.full((len(there), *a.shape[1:]), fill) for a in results)
    for a, found in zip(whole, results, strict=True):
        a[there] = found
    return whole


def _there(first: Any, xp: Any = np) -> Any:
    """Which entries there are."""
    return xp.isfinite(first).reshape(len(first), -1).all(axis=1)


def _shapes(*operands: Any, jaxpr: ClosedJaxpr, **_: Any) -> list[ShapedArray]:
    return [ShapedArray((operands[0].shape[0], *a.shape), a.dtype) for a in jaxpr.out_avals]


def _lowered(context: Any, *operands: Any, called: Callable, **parameters: Any) -> Any:
    callback = functools.partial(called, **parameters)
    return mlir.emit_python_callback(
        context, callback, None, list(operands), context.avals_in, context.avals_out, has_side_effect=False
    )[0]


def _batched(operands: Sequence, axes: Sequence, *, primitive: Primitive, **parameters: Any) -> tuple[list, list[int]]:
    """An axis of vmap becomes part of that of the entries."""
    size = next(a.shape[axis] for a, axis in zip(operands, axes, strict=True) if axis is not None)
    front = lambda a, axis: jnp.broadcast_to(a, (size, *a.shape)) if axis is None else jnp.moveaxis(a, axis, 0)
    whole = [front(a, axis) for a, axis in zip(operands, axes, strict=True)]
    entries = whole[0].shape[1]
    results = primitive.bind(*(a.reshape(size * entries, *a.shape[2:]) for a in whole), **parameters)
    return [a.reshape(size, entries, *a.shape[1:]) for a in results], [0] * len(results)


def _tangents(primals: Sequence, along: Sequence, *, jaxpr: ClosedJaxpr, linear: int, some: bool) -> tuple[list, list]:
    bind = functools.partial(host_p.bind, some=some)
    results, known = bind(*primals, jaxpr=jaxpr, linear=linear), len(primals) - linear
    moves = tuple(not isinstance(t, ad.Zero) and t.dtype != float0 for t in along)
    if not any(moves[:known]):
        return results, bind(*primals[:known], *map(ad.instantiate_zeros, along[known:]), jaxpr=jaxpr, linear=linear)
    chosen = [t for t, moved in zip(along, moves, strict=True) if moved]
    pushed = _pushed.get((Same(jaxpr), moves), lambda: pushed_forward(jaxpr, moves))
    if _program(pushed) is None:
        found = jax.vmap(jaxpr_as_fun(pushed))(*primals, *chosen)
        column = lambda a: _there(primals[0], jnp).reshape(-1, *(1,) * (a.ndim - 1))
        return results, [jnp.where(column(a), a, 0.0) for a in found] if some else found
    return results, bind(*primals, *chosen, jaxpr=pushed, linear=len(chosen))


def _transposed(cotangents: Sequence, *operands: Any, jaxpr: ClosedJaxpr, linear: int, some: bool) -> list:
    unknown = tuple(i for i, x in enumerate(operands) if ad.is_undefined_primal(x))
    live = tuple(i for i, flow in enumerate(cotangents) if not isinstance(flow, ad.Zero))
    known = [x for i, x in enumerate(operands) if i not in unknown]
    pulled = pulled_p.bind(*known, *(cotangents[i] for i in live), jaxpr=jaxpr, unknown=unknown, live=live, some=some)
    found: list = [None] * len(operands)
    for i, a in zip(unknown, pulled, strict=True):
        found[i] = a
    return found


def _pulled(*arrays: Any, jaxpr: ClosedJaxpr, unknown: tuple[int, ...], live: tuple[int, ...], some: bool) -> tuple:
    """The cotangents of the `unknown` operands, in which the results are linear, by those of the `live` results."""
    program, count = _program(jaxpr), len(arrays) - len(live)
    assert program is not None
    there = _there(np.asarray(arrays[0])) if some else np.ones(len(arrays[0]), bool)
    own = [np.asarray(a)[there] for a in arrays]
    entries, shapes = len(own[0]), [jaxpr.in_avals[i].shape for i in unknown]
    sizes = [math.prod(shape) for shape in shapes]
    total, many = np.zeros((sum(sizes), entries)), max(1, TOGETHER // max(entries, 1))
    for first in range(0, sum(sizes) if entries else 0, many):
        units = np.eye(sum(sizes))[first : first + many]
        repeated = lambda a, times=len(units): np.broadcast_to(a, (times, *a.shape)).reshape(times * entries, *a.shape[1:])
        parts = np.split(np.repeat(units, entries, axis=0), np.cumsum(sizes)[:-1], axis=1)
        given, known = (
            iter(a.reshape(len(units) * entries, *shape) for a, shape in zip(parts, shapes, strict=True)),
            iter(own[:count]),
        )
        operands = [next(given) if i in unknown else repeated(next(known)) for i in range(len(jaxpr.in_avals))]
        results = program.in_numpy(operands)
        for i, flow in zip(live, own[count:], strict=True):
            products = np.reshape(results[i], (len(units), *flow.shape)) * flow
            total[first : first + many] += products.sum(axis=tuple(range(2, products.ndim)))
    whole = np.zeros((len(there), sum(sizes)))
    whole[there] = total.T
    columns = np.split(whole, np.cumsum(sizes)[:-1], axis=1)
    avals = (jaxpr.in_avals[i] for i in unknown)
    return tuple(np.ascontiguousarray(a.reshape(len(there), *v.shape), v.dtype) for a, v in zip(columns, avals, strict=True))


def _pulled_shapes(*operands: Any, jaxpr: ClosedJaxpr, unknown: tuple[int, ...], **_: Any) -> list[ShapedArray]:
    return [ShapedArray((operands[0].shape[0], *jaxpr.in_avals[i].shape), jaxpr.in_avals[i].dtype) for i in unknown]


def _pulled_tangents(primals: Sequence, along: Sequence, *, jaxpr: ClosedJaxpr, unknown, live, some) -> tuple[list, list]:
    """By the products with the tangents along every direction, which know their own tangents."""
    sizes = [math.prod(jaxpr.in_avals[i].shape) for i in unknown]
    count, entries = len(primals) - len(live), primals[0].shape[0]

    def by_directions(*operands: Any) -> list:
        def products(unit: Any) -> Any:
            parts, known = iter(jnp.split(unit, np.cumsum(sizes)[:-1].tolist())), iter(operands[:count])
            spread = lambda a, v: jnp.broadcast_to(a.reshape(v.shape), (entries, *v.shape)).astype(v.dtype)
            given = [spread(next(parts), v) if i in unknown else next(known) for i, v in enumerate(jaxpr.in_avals)]
            results = host_p.bind(*given, jaxpr=jaxpr, linear=len(unknown), some=some)
            flows = [results[i] * flow for i, flow in zip(live, operands[count:], strict=True)]
            return sum(jnp.sum(a, axis=tuple(range(1, a.ndim))) for a in flows)

        columns = jnp.split(jax.vmap(products)(jnp.eye(sum(sizes))).T, np.cumsum(sizes)[:-1].tolist(), axis=1)
        avals = (jaxpr.in_avals[i] for i in unknown)
        return [a.reshape(entries, *v.shape).astype(v.dtype) for a, v in zip(columns, avals, strict=True)]

    results = pulled_p.bind(*primals, jaxpr=jaxpr, unknown=unknown, live=live, some=some)
    return results, jax.jvp(by_directions, tuple(primals), tuple(map(ad.instantiate_zeros, along)))[1]


def _pulled_transposed(cotangents: Sequence, *operands: Any, jaxpr: ClosedJaxpr, unknown, live, some) -> list:
    """The results are linear in the cotangents that they are made of: by tangents once more."""
    known, entries = iter(operands[: len(operands) - len(live)]), operands[0].shape[0]
    zero = lambda i: jnp.zeros((entries, *jaxpr.in_avals[i].shape), jaxpr.in_avals[i].dtype)
    flows = {i: zero(i) if isinstance(c, ad.Zero) else c for i, c in zip(unknown, cotangents, strict=True)}
    given = [flows[i] if i in unknown else next(known) for i in range(len(jaxpr.in_avals))]
    results = host_p.bind(*given, jaxpr=jaxpr, linear=len(unknown), some=some)
    return [None] * (len(operands) - len(live)) + [results[i] for i in live]


def _primitive(name: str, called: Callable, shapes: Callable, tangents: Callable, transposed: Callable) -> Primitive:
    made = Primitive(name)
    made.multiple_results = True
    made.def_impl(lambda *arrays, **parameters: [jnp.asarray(a) for a in called(*arrays, **parameters)])
    made.def_abstract_eval(shapes)
    mlir.register_lowering(made, functools.partial(_lowered, called=called), platform="cpu")
    ad.primitive_jvps[made], ad.primitive_transposes[made] = tangents, transposed
    batching.primitive_batchers[made] = functools.partial(_batched, primitive=made)
    return made


host_p = _primitive("dirax_on_host", _evaluated, _shapes, _tangents, _transposed)
"""A jaxpr of floats for operands with an axis of entries in front, linear in the `linear` last ones; of `some` entries alone."""

pulled_p = _primitive("dirax_pulled_on_host", _pulled, _pulled_shapes, _pulled_tangents, _pulled_transposed)
"""The cotangents of the `unknown` operands of such a jaxpr, by the other ones and the cotangents of its `live` results."""
