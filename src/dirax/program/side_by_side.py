"""Functions at many entries by XLA: side by side, or one after the other where its threads would wait for one another.

On a CPU XLA gives a decomposition or a solve of many matrices as work to its threads, and a thread that has begun one waits until
others have done it. As soon as as many are begun at a time as there are threads, all wait and none ends: on two cores for a
Lagrangian with two inverses in it.
"""

import os
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from dirax.numerics.processors import processors
from dirax.program.counts import array_operations

SHARED = {
    *("lu", "triangular_solve", "cholesky", "qr", "geqrf", "householder_product", "svd", "eigh", "eig", "schur"),
    *("dirax_solve", "dirax_scaled_inverse", "dirax_pseudo_inverse", "dirax_least_change", "dirax_root"),
}
"""What is shared out to threads, in the words of JAX and of dirax."""

DERIVED = 4
"""How many a derivative has for one of its function."""


def side_by_side(function: Callable, in_axes: tuple, waiting: bool | None = None) -> Callable:
    """`jax.vmap(function, in_axes)` for axes 0 and None, but for a function whose entries would wait for one another, as
    `waiting` says, or `waits` of it."""

    def call(*values: Any) -> Any:
        entry = [of_one(value, axis is not None) for value, axis in zip(values, in_axes, strict=True)]
        waits_now = waits(function, *entry) if waiting is None else waiting
        return (one_by_one if waits_now else jax.vmap)(function, in_axes)(*values)

    return call


def one_by_one(function: Callable, in_axes: tuple) -> Callable:
    """What `jax.vmap(function, in_axes)` computes, entry after entry, each as a batch of one: what dirax has primitives for is
    made of JAX's then as under `jax.vmap`, and not while XLA's modules are being built."""

    def call(*values: Any) -> Any:
        moving = [value for value, axis in zip(values, in_axes, strict=True) if axis is not None]

        def at(given: list[Any]) -> Any:
            rest = iter(jax.tree.map(lambda a: a[None], given))
            batch = [next(rest) if axis is not None else value for value, axis in zip(values, in_axes, strict=True)]
            return jax.tree.map(lambda a: a[0], jax.vmap(function, in_axes)(*batch))

        return lax.map(at, moving)

    return call


def of_one(values: Any, axes: int) -> Any:
    """The shapes of arrays without so many axes in front."""
    return jax.tree.map(lambda a: jax.ShapeDtypeStruct(jnp.shape(a)[axes:], jnp.result_type(a)), values)


def waits(function: Callable, *values: Any) -> bool:
    """Whether a function of values like these, side by side, could have all threads of XLA wait for one another."""
    if jax.default_backend() != "cpu":
        return False
    return array_operations(jax.make_jaxpr(function)(*values).jaxpr, DERIVED, SHARED.__contains__) >= threads()


def threads() -> int:
    """How many XLA has."""
    given = os.environ.get("NPROC", "")
    return int(given) if given.isdigit() and int(given) else processors()
