"""Functions of a few numbers through the scalar graph and NumPy: nothing is compiled, which is quicker where they run once."""

from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.core import Tracer

from dirax.engines.native import host_rules  # noqa: F401  (registers its rules)
from dirax.engines.native.graph import GraphTooLarge
from dirax.engines.native.host_function import HOST_RULES, HostFunction, Values, in_parts, interpreted
from dirax.engines.native.interpret import UnsupportedPrimitive
from dirax.engines.native.program import program
from dirax.tracing import in_scalars

KEPT = 128
"""Functions kept in memory."""

IN_NUMBERS = 2**22
"""Derivatives of nodes up to which a Jacobian is found in numbers, which is quicker once than to write it as nodes."""

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


def linearized(equation: Any, params: Any, batch_params: bool, u, state, t, h) -> tuple[np.ndarray, np.ndarray] | None:
    """(residual, Jacobian) of the first stage of `equation`, (entries, k) and (entries, k, k), from the graph that the native
    engine compiles; arguments have an axis of entries, `params` with `batch_params`. None where it does not compile the step."""
    try:
        made, _ = program(equation, params, batch_params)
        first, shared, graph, k = made.equations[0], made.shared, made.graph, equation.stages[0][0].unknowns
        few = len(u) * k * len(graph) <= IN_NUMBERS
        entries = [] if few else [row.get(j, graph.zero) for row in made.jacobian(0) for j in range(k)]
    except (UnsupportedPrimitive, GraphTooLarge):
        return None
    graph = graph.copy() if few else graph
    node = lambda nodes: np.asarray(nodes, dtype=np.int64)
    leaves = np.broadcast_to(made.parameters.flatten(params, len(u) if batch_params else None), (len(u), made.parameters.size))

    def part(arguments: list[np.ndarray]) -> list[np.ndarray]:
        known = Values(graph, len(arguments[0]))
        for nodes, array in zip((first.unknowns, first.state, shared.t, shared.h, shared.params), arguments, strict=True):
            known.bind(node(nodes), array)
        slopes = known.slopes(first.residual, first.unknowns) if few else known.read(node(entries).reshape(k, k))
        return [known.read(node(first.residual)), slopes]

    residual, jacobian = in_parts(part, [u, state, t, h, leaves])
    return residual, jacobian
