"""Functions of a few numbers by their scalar programs: in NumPy, where nothing is compiled, which is quicker where they run
once; and written in scalars for JAX. Every function here is traced once for arguments of one kind."""

import math
from collections.abc import Callable, Hashable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr

import dirax.program.rules  # noqa: F401  (registers the rules)
from dirax.numerics.one_thread import one_thread
from dirax.program.evaluation.noise import Noise
from dirax.program.graph import GraphTooLarge
from dirax.program.interpreter import UnsupportedPrimitive
from dirax.program.memo import Memo
from dirax.program.primitives import binds
from dirax.program.scalar_program import ScalarProgram, program_p

KEPT = 128
"""Functions kept in memory."""

MOST_NUMBERS = 1024
"""Numbers that a function takes from which on it is not taken apart into operations on scalars: compiling is quicker."""

_programs: Memo[tuple[ScalarProgram, Any] | None] = Memo(KEPT)
_jaxprs: Memo[tuple[ClosedJaxpr, Any]] = Memo(KEPT)


def in_numpy(
    function: Callable, leaves: list[np.ndarray], key: Hashable, for_few: bool = False, noise: Noise | None = None
) -> Any:
    """`function(*arguments)` for each entry of `leaves`, arguments (entries, …): a pytree of arrays with that leading axis.

    None where the function has a primitive for which there is no rule, or closes over values that JAX traces. `key` is
    equal for functions that are, and has everything in it on which `function` depends; `for_few` and `noise` as a `ScalarProgram`
    has them.
    """
    found = program_of(function, [jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype) for leaf in leaves], key, for_few)
    if found is None:
        return None
    with one_thread():
        return jax.tree.unflatten(found[1], found[0].in_numpy(leaves, noise))


def program_of(
    function: Callable, shapes: list[jax.ShapeDtypeStruct], key: Hashable, for_few: bool = False
) -> tuple[ScalarProgram, Any] | None:
    """The program by which `in_numpy` evaluates arguments of these shapes, and the structure of what the function returns."""
    kinds = [(s.shape, s.dtype.str) for s in shapes]
    return _programs.get((key, *kinds, for_few), lambda: _traced(function, shapes, True, for_few))


def graph_program_of(function: Callable, shapes: list[jax.ShapeDtypeStruct], key: Hashable) -> ScalarProgram | None:
    """The same as operations of the graph alone, which can be compiled; None where it has no such program."""
    key = ("graph", key, *((s.shape, s.dtype.str) for s in shapes))
    found = _programs.get(key, lambda: _traced(function, shapes, False))
    return found and found[0]


def at_values(function: Callable, values: tuple) -> tuple | None:
    """(`function(*values)`,) in NumPy, for concrete values; None where that cannot be."""
    leaves, structure = jax.tree.flatten(values)
    if not leaves or not all(isinstance(leaf, bool | int | float | np.ndarray | np.generic | jax.Array) for leaf in leaves):
        return None
    try:
        hash(function)
    except TypeError:
        return None
    arrays = [np.asarray(leaf)[None] for leaf in leaves]
    found = in_numpy(_flat(function, structure), arrays, (function, structure))
    return None if found is None else (jax.tree.map(lambda leaf: leaf[0], found),)


def program_at(function: Callable, values: tuple) -> ScalarProgram | None:
    """The program of `at_values`, a function of the leaves of the values; None where there is none."""
    leaves, structure = jax.tree.flatten(values)
    shapes = [jax.ShapeDtypeStruct(np.shape(leaf), np.asarray(leaf).dtype) for leaf in leaves]
    found = program_of(_flat(function, structure), shapes, (function, structure))
    return found and found[0]


def in_scalars(function: Callable, values: tuple) -> tuple | None:
    """(`function(*values)`,) while JAX traces, for JAX by the operations of its scalar program; None where that cannot be."""
    leaves, structure = jax.tree.flatten(values)
    if not binds(*leaves):
        return None
    shapes = [jax.ShapeDtypeStruct(jnp.shape(leaf), jnp.float64) for leaf in leaves]
    key = function, structure, *(s.shape for s in shapes)
    jaxpr, result = _jaxprs.get(key, lambda: jax.make_jaxpr(_flat(function, structure), return_shape=True)(*shapes))
    if any(isinstance(c, Tracer) for c in jaxpr.consts) or any(a.dtype != np.float64 for a in jaxpr.out_avals):
        return None
    return (jax.tree.unflatten(jax.tree.structure(result), program_p.bind(*leaves, jaxpr=jaxpr)),)


def constants(function: Callable, values: tuple) -> np.ndarray | None:
    """The array that `function(*values)` is, or the first of several, NaN in entries that are not constant; None where it has no
    program."""
    leaves, structure = jax.tree.flatten(values)
    found = None if any(isinstance(leaf, Tracer) for leaf in leaves) else program_at(function, values)
    if found is None or found.opaque:  # what NumPy computes may be written out, and constant
        shapes = [jax.ShapeDtypeStruct(np.shape(leaf), jnp.result_type(leaf)) for leaf in leaves]
        traced = _traced(_flat(function, structure), shapes, False)
        found = traced and traced[0]
    return None if found is None else found.constants(found.results[0])


def _flat(function: Callable, structure: Any) -> Callable:
    return lambda *leaves: function(*jax.tree.unflatten(structure, leaves))


def _traced(
    function: Callable, shapes: list[jax.ShapeDtypeStruct], by_numpy: bool, for_few: bool = False
) -> tuple[ScalarProgram, Any] | None:
    """The program of a function, and the structure of its result; None where it has none, or one of too many numbers."""
    if sum(math.prod(shape.shape) for shape in shapes) > MOST_NUMBERS:
        return None
    closed, result = jax.make_jaxpr(function, return_shape=True)(*shapes)
    if any(isinstance(c, Tracer) for c in closed.consts):
        return None
    try:
        return ScalarProgram.of(closed, by_numpy, for_few), jax.tree.structure(result)
    except (UnsupportedPrimitive, GraphTooLarge):
        return None
