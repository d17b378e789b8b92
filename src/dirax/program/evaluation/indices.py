"""Whether the indices of a function stay inside its arrays."""

import math
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

import dirax.program.rules  # noqa: F401  (registers the rules)
from dirax.program.graph import NODE_LIMIT, Graph, GraphTooLarge
from dirax.program.indexed import INDEXING, unguarded
from dirax.program.interpreter import RULES, Interpreter, Nodes, Unavailable


def reads_inside(jaxpr: Any, values: tuple | None) -> bool | None:
    """Whether every index of a closed jaxpr that has to be inside its array is so at these values, at any by default; None where
    that is not found."""
    found = _indices(jaxpr, values)
    return None if found is None or (None in found and False not in found) else all(found)


def reads_outside(jaxpr: Any) -> bool:
    """Whether an index of a closed jaxpr is outside of its array whatever the values are."""
    return False in (_indices(jaxpr, None) or ())


def _indices(jaxpr: Any, values: tuple | None) -> list[bool | None] | None:
    """Whether each index is inside its array, None where that depends on more than these values; None where not all are found."""
    inside: list[bool | None] = []

    def watched(name: str) -> Callable:
        def read(interpreter: Interpreter, equation: Any, x: Nodes, *starts: Nodes):
            if unguarded(equation):
                inside.append(_inside(interpreter, equation, x.shape, starts))
            return RULES[name](interpreter, equation, x, *starts)

        return read

    graph = Graph(NODE_LIMIT)
    interpreter = Interpreter(graph, {name: watched(name) for name in INDEXING})
    try:
        if values is None:
            operands = [_unknown(graph, f"x{number}", v.aval.shape) for number, v in enumerate(jaxpr.jaxpr.invars)]
        else:
            operands = [interpreter.constants(leaf) for leaf in jax.tree.leaves(values)]
        results = interpreter.run(jaxpr, *operands)
    except GraphTooLarge:
        return None
    return None if any(isinstance(result, Unavailable) for result in results) else inside


def _unknown(graph: Graph, name: str, shape: tuple[int, ...]) -> Nodes:
    return np.array([graph.input(f"{name}_{i}") for i in range(math.prod(shape))], np.int64).reshape(shape)


def _inside(interpreter: Interpreter, equation: Any, shape: tuple[int, ...], starts: tuple[Nodes, ...]) -> bool | None:
    p = equation.params
    if equation.primitive.name == "gather":
        axes, indices = p["dimension_numbers"].start_index_map, starts[0]
    else:
        axes, indices = range(len(shape)), np.stack(starts, axis=-1)
    known = interpreter.static(indices)
    last = np.array([shape[axis] - p["slice_sizes"][axis] for axis in axes])
    return None if known is None else bool(np.all((known >= 0) & (known <= last)))
