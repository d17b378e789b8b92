"""Primitives that stand for a function written in JAX, in a trace that becomes a scalar graph: that may have a way of its own
to compute them, quicker to find than by tracing the function. Everywhere else they are the function."""

import functools
from collections.abc import Callable, Sequence

import jax
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir


def deferred(name: str, by_jax: Callable[..., Sequence], shapes: Callable[..., Sequence[ShapedArray]]) -> Primitive:
    """A primitive with several results for `by_jax(*operands, **parameters)`, whose results have the shapes
    `shapes(*operand shapes, **parameters)`."""
    made = Primitive(name)
    made.multiple_results = True

    def tangents(primals, along, **p):
        function = lambda *operands: list(by_jax(*operands, **p))
        return jax.jvp(function, tuple(primals), tuple(map(ad.instantiate_zeros, along)))

    made.def_impl(lambda *operands, **p: list(jax.jit(lambda *values: list(by_jax(*values, **p)))(*operands)))
    made.def_abstract_eval(lambda *operands, **p: list(shapes(*operands, **p)))
    ad.primitive_jvps[made] = tangents
    batching.primitive_batchers[made] = functools.partial(each, by_jax)
    mlir.register_lowering(made, mlir.lower_fun(lambda *operands, **p: list(by_jax(*operands, **p)), multiple_results=True))
    return made


def each(by_jax: Callable[..., Sequence], operands: Sequence, axes: Sequence, **parameters) -> tuple[list, list[int]]:
    """The rule of `jax.vmap` for a function written in JAX: its results, and their axes."""
    found = jax.vmap(lambda *operands: list(by_jax(*operands, **parameters)), in_axes=tuple(axes))(*operands)
    return found, [0] * len(found)
