"""Functions of a few numbers through the scalar graph and NumPy: nothing is compiled, which is quicker where they run once."""

from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.core import Tracer

from dirax.program.evaluation.host_function import HOST_RULES, HostFunction, interpreted
from dirax.program.graph import GraphTooLarge
from dirax.program.interpreter import UnsupportedPrimitive
from dirax.program.rules import host_rules  # noqa: F401  (registers its rules)
from dirax.program.tracing import in_scalars

KEPT = 128
"""Functions kept in memory."""

_functions: OrderedDict[tuple, tuple[Any, tuple[HostFunction, Any] | None]] = OrderedDict()


def on_host(function: Callable, leaves: list[np.ndarray], kept: tuple, key: Any = None) -> Any:
    """`function(*arguments)` for each entry of `leaves`, arguments (entries, …): a pytree of arrays with that leading axis.

    None where the function has a primitive for which there is no rule, or closes over values that JAX traces. What was
    traced is remembered by the identity of the objects `kept`, on which `function` may depend, and by `key`.
    """
    shapes = [jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype) for leaf in leaves]
    known = (*map(id, kept), key, *((s.shape, s.dtype.str) for s in shapes))
    if known not in _functions:
        _functions[known] = kept, traced(function, shapes)
        if len(_functions) > KEPT:
            _functions.popitem(last=False)
    _functions.move_to_end(known)
    made = _functions[known][1]
    return None if made is None else jax.tree.unflatten(made[1], made[0](leaves))


def traced(
    function: Callable, shapes: list[jax.ShapeDtypeStruct], rules: dict[str, Callable] = HOST_RULES
) -> tuple[HostFunction, Any] | None:
    """`function` with these host rules, and the structure of its result; None as above."""
    with in_scalars():
        closed, result = jax.make_jaxpr(function, return_shape=True)(*shapes)
    if any(isinstance(c, Tracer) for c in closed.consts):
        return None
    try:
        return interpreted(closed, rules), jax.tree.structure(result)
    except (UnsupportedPrimitive, GraphTooLarge):
        return None
