"""Whether the indices of a function stay inside its arrays."""

import math
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

import dirax.program.rules  # noqa: F401  (registers the rules)
from dirax.program.graph import NODE_LIMIT, Graph, GraphTooLarge
from dirax.program.interpreter import RULES, Interpreter, Nodes, Unavailable


def reads_inside(jaxpr: Any, values: tuple | None) -> bool:
    """Whether every index of a closed jaxpr is inside its array at these values, at any by default; False where that is not
    found."""
    inside: list[bool] = []

    def watched(name: str) -> Callable:
        def read(interpreter: Interpreter, equation: Any, x: Nodes, *starts: Nodes):
            inside.append(_inside(interpreter, equation, x.shape, starts))
            return RULES[name](interpreter, equation, x, *starts)

        return read

    graph = Graph(NODE_LIMIT)
    interpreter = Interpreter(graph, {name: watched(name) for name in ("gather", "dynamic_slice")})
    try:
        if values is None:
            operands = [_unknown(graph, f"x{number}", v.aval.shape) for number, v in enumerate(jaxpr.jaxpr.invars)]
        else:
            operands = [interpreter.constants(leaf) for leaf in jax.tree.leaves(values)]
        results = interpreter.run(jaxpr, *operands)
    except GraphTooLarge:
        return False
    return all(inside) and not any(isinstance(result, Unavailable) for result in results)


def _unknown(graph: Graph, name: str, shape: tuple[int, ...]) -> Nodes:
    return np.array([graph.input(f"{name}_{i}") for i in range(math.prod(shape))], np.int64).reshape(shape)


def _inside(interpreter: Interpreter, equation: Any, shape: tuple[int, ...], starts: tuple[Nodes, ...]) -> bool:
    p = equation.params
    if equation.primitive.name == "gather":
        axes, indices = p["dimension_numbers"].start_index_map, starts[0]
    else:
        axes, indices = range(len(shape)), np.stack(starts, axis=-1)
    known = interpreter.static(indices)
    last = np.array([shape[axis] - p["slice_sizes"][axis] for axis in axes])
    return known is not None and bool(np.all((known >= 0) & (known <= last)))
