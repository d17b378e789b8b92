"""Functions by their graph: at concrete values on the host, where nothing is compiled, and at traced ones as scalar programs."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.program.evaluation.by_jax import by_jax
from dirax.program.evaluation.host_function import HostFunction
from dirax.program.evaluation.on_host import KEPT, on_host, traced
from dirax.program.graph import NODE_LIMIT, Graph, GraphTooLarge
from dirax.program.interpreter import RULES, Interpreter, Nodes, Unavailable


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
    found = _graph_of(function, structure, [jax.ShapeDtypeStruct(np.shape(leaf), jnp.result_type(leaf)) for leaf in leaves])
    if found is None:
        return None
    graph, (nodes,) = found[0].graph, found[0].results
    entries = [graph.value[node] if graph.is_constant(node) else np.nan for node in nodes.ravel().tolist()]
    return np.array(entries, dtype=float).reshape(nodes.shape)


def _graph_of(function: Callable, structure: Any, shapes: list) -> tuple[HostFunction, Any] | None:
    """The graph of a function of flat arguments, and the structure of its results; None where it has none."""
    return traced(lambda *leaves: function(*jax.tree.unflatten(structure, leaves)), shapes, {})


def scalar_program(function: Callable, values: tuple) -> tuple | None:
    """(`function(*values)`,) of traced values by the operations of its graph; None where it has none."""
    leaves, structure = jax.tree.flatten(values)
    if any(jnp.result_type(leaf) != jnp.float64 for leaf in leaves):
        return None
    program = _scalar_program(function, structure, tuple(jnp.shape(leaf) for leaf in leaves))
    return None if program is None else (program(*leaves),)


@functools.lru_cache(KEPT)
def _scalar_program(function: Callable, structure: Any, shapes: tuple) -> Callable | None:
    found = _graph_of(function, structure, [jax.ShapeDtypeStruct(shape, jnp.float64) for shape in shapes])
    if found is None or not found[0].results:
        return None
    made, of_results = found
    outputs = [node for nodes in made.results for node in nodes.ravel().tolist()]
    ends = np.cumsum([nodes.size for nodes in made.results])[:-1].tolist()

    @jax.jit
    def program(*leaves):
        values: dict[int, Any] = {}
        for nodes, leaf in zip(made.inputs, leaves, strict=True):
            values.update(zip(nodes.ravel().tolist(), jnp.ravel(leaf), strict=True))
        parts = jnp.split(by_jax(made.graph, outputs, values), ends) if outputs else [jnp.zeros(0)] * len(made.results)
        arrays = [part.reshape(nodes.shape) for part, nodes in zip(parts, made.results, strict=True)]
        return jax.tree.unflatten(of_results, arrays)

    return program


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
