"""Functions of the user at concrete values, for the checks before a run: evaluated on the host, nothing is compiled."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from dirax.engines.native.graph import Graph, GraphTooLarge
from dirax.engines.native.host_function import interpreted
from dirax.engines.native.interpret import RULES, Interpreter, Nodes, Unavailable, UnsupportedPrimitive
from dirax.engines.native.on_host import on_host
from dirax.engines.native.trace import NODE_LIMIT
from dirax.tracing import in_scalars


def evaluated(function: Callable, values: tuple) -> tuple | None:
    """(`function(*values)`,) with NumPy arrays, known again for equal functions; None where the graph cannot say it."""
    leaves, structure = jax.tree.flatten(values)
    if not all(isinstance(leaf, bool | int | float | np.ndarray | np.generic | jax.Array) for leaf in leaves):
        return None
    try:
        hash(function)
    except TypeError:
        return None
    arrays = [np.asarray(leaf)[None] for leaf in leaves]
    flat = lambda *leaves: function(*jax.tree.unflatten(structure, leaves))
    found = on_host(flat, arrays or [np.zeros(1)], (), (function, structure)) if arrays else None
    return None if found is None else (jax.tree.map(lambda leaf: leaf[0], found),)


def constant_entries(function: Callable, values: tuple) -> np.ndarray | None:
    """The array that `function(*values)` is, NaN in entries that are no constants of the graph; None where it has none."""
    leaves, structure = jax.tree.flatten(values)
    with in_scalars():
        closed = jax.make_jaxpr(lambda *leaves: function(*jax.tree.unflatten(structure, leaves)))(*leaves)
    try:
        made = interpreted(closed)
    except (UnsupportedPrimitive, GraphTooLarge):
        return None
    (nodes,), graph = made.results, made.graph
    entries = [graph.value[node] if graph.is_constant(node) else np.nan for node in nodes.ravel().tolist()]
    return np.array(entries, dtype=float).reshape(nodes.shape)


def reads_inside(jaxpr: Any, values: tuple) -> bool:
    """Whether every index of a closed jaxpr is inside its array at these values; False where that is not found."""
    inside: list[bool] = []

    def watched(name: str) -> Callable:
        def read(interpreter: Interpreter, equation: Any, x: Nodes, *starts: Nodes):
            inside.append(_inside(interpreter, equation, x.shape, starts))
            return RULES[name](interpreter, equation, x, *starts)

        return read

    interpreter = Interpreter(Graph(NODE_LIMIT), {name: watched(name) for name in ("gather", "dynamic_slice")})
    operands = [interpreter.constants(leaf) for leaf in jax.tree.leaves(values)]
    try:
        results = interpreter.run(jaxpr, *operands)
    except GraphTooLarge:
        return False
    return all(inside) and not any(isinstance(result, Unavailable) for result in results)


def _inside(interpreter: Interpreter, equation: Any, shape: tuple[int, ...], starts: tuple[Nodes, ...]) -> bool:
    p = equation.params
    if equation.primitive.name == "gather":
        axes, indices = p["dimension_numbers"].start_index_map, starts[0]
    else:
        axes, indices = range(len(shape)), np.stack(starts, axis=-1)
    known = interpreter.static(indices)
    last = np.array([shape[axis] - p["slice_sizes"][axis] for axis in axes])
    return known is not None and bool(np.all((known >= 0) & (known <= last)))
