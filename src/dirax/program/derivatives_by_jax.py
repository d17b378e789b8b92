"""Derivatives by JAX of functions that have no derivative in one of its two modes, and words for those that have none at all."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import Tracer
from jax.interpreters.partial_eval import DynamicJaxprTracer


class Undifferentiated(TypeError):
    """A user's function that JAX does not differentiate."""


@contextmanager
def differentiated(call: str, values: Any) -> Iterator[None]:
    """Where a user's function, called as `call` inside the block, is differentiated or batched at `values`, what JAX says against
    it names the function."""
    try:
        yield
    except (NotImplementedError, ValueError) as error:
        transformed = any(isinstance(x, Tracer) and not isinstance(x, DynamicJaxprTracer) for x in jax.tree.leaves(values))
        if "while_loop" in str(error) or not transformed:
            raise
        reason = (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")
        raise Undifferentiated(
            f"{call} cannot be differentiated or batched by JAX, as a step needs it ({reason}): write that part of it with other "
            "operations, or give it a rule of its own with jax.custom_jvp."
        ) from error


def _or(first: Callable, other: Callable, kind: type[Exception], word: str) -> Any:
    """What the first gives, or what the other does where the first raises an error of this kind with this word."""
    try:
        return first()
    except kind as error:
        if word not in str(error):
            raise
    return other()


def gradient_by_jax(function: Callable, argnums: int | tuple[int, ...]) -> Callable:
    """`jax.grad`, and in forward mode of what has a loop of unknown length, which JAX does not take backwards."""
    backwards, forwards = jax.grad(function, argnums), jax.jacfwd(function, argnums)
    return lambda *values: _or(lambda: backwards(*values), lambda: forwards(*values), ValueError, "while_loop")


def jacobian_by_jax(function: Callable, argnums: int | tuple[int, ...] = 0) -> Callable:
    """`jax.jacfwd`, and in reverse mode of what has a derivative of the user's own in reverse mode alone (`jax.custom_vjp`)."""
    forwards, backwards = jax.jacfwd(function, argnums), jax.jacrev(function, argnums)
    return lambda *values: _or(lambda: forwards(*values), lambda: backwards(*values), TypeError, "custom_vjp")


def along_by_jax(function: Callable, point: tuple, direction: tuple) -> Any:
    """`jax.jvp(function, point, direction)[1]` of a function of arrays with one array, where `jacobian_by_jax` takes it."""

    def by_slopes():
        slopes = jax.jacrev(function, tuple(range(len(point))))(*point)
        return sum(jnp.tensordot(slope, x, jnp.ndim(x)) for slope, x in zip(slopes, direction, strict=True))

    return _or(lambda: jax.jvp(function, point, direction)[1], by_slopes, TypeError, "custom_vjp")
