"""dirax's own JAX primitives: a derivative, a linear solve, a pseudo-inverse, a root, a formula as one operation each.

Every function here that has a primitive behaves alike. While JAX traces (`is_tracing`), it becomes one equation of the
jaxpr; otherwise it computes at once, by plain JAX. What the equation means is the same plain JAX: that is what XLA compiles,
and what `jax.grad` and `jax.vmap` act on. A scalar program has a rule of its own for it instead (`dirax.program.rules`),
which is quicker to find: JAX takes milliseconds to differentiate what it traces, a graph of scalars microseconds.
No caller needs to know which of the two reads the jaxpr.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax._src.core import trace_state_clean
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir


def is_tracing() -> bool:
    """Whether what is called now is traced or transformed by JAX."""
    return not trace_state_clean()


def binds(*operands: Any) -> bool:
    """Whether a function of these operands becomes an equation of a jaxpr: all are arrays of floats, and JAX traces."""
    return is_tracing() and all(jnp.result_type(x) == jnp.float64 for x in operands)


def plain_primitive(name: str, by_jax: Callable[..., Sequence], shapes: Callable[..., Sequence[ShapedArray]]) -> Primitive:
    """A primitive with several results for `by_jax(*operands, **parameters)`, whose results have the shapes
    `shapes(*operand shapes, **parameters)`."""
    made = Primitive(name)
    made.multiple_results = True

    def tangents(primals, along, **p):
        """Only what moves is differentiated: the other operands are constants for JAX too."""
        moves = [not isinstance(a, ad.Zero) for a in along]

        def function(*moving):
            given = iter(moving)
            return list(by_jax(*(next(given) if m else x for x, m in zip(primals, moves, strict=True)), **p))

        chosen = lambda values: tuple(value for value, m in zip(values, moves, strict=True) if m)
        return jax.jvp(function, chosen(primals), chosen(along))

    made.def_impl(lambda *operands, **p: list(by_jax(*operands, **p)))
    made.def_abstract_eval(lambda *operands, **p: list(shapes(*operands, **p)))
    ad.primitive_jvps[made] = tangents
    batching.primitive_batchers[made] = functools.partial(each, by_jax)
    mlir.register_lowering(made, mlir.lower_fun(lambda *operands, **p: list(by_jax(*operands, **p)), multiple_results=True))
    return made


def each(by_jax: Callable[..., Sequence], operands: Sequence, axes: Sequence, **parameters) -> tuple[list, list[int]]:
    """The rule of `jax.vmap` for a function written in JAX: its results, and their axes."""
    found = jax.vmap(lambda *operands: list(by_jax(*operands, **parameters)), in_axes=tuple(axes))(*operands)
    return found, [0] * len(found)
