"""Nodes of a scalar graph level by level in JAX: equal operations on nodes of one depth are one operation on arrays.

A machine of many equal parts has as many scalar operations as parts, and no more levels than one of them.
"""

from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.program.graph import Graph
from dirax.program.operations import JAX


def in_levels(graph: Graph, inputs: Sequence[int], outputs: Sequence[int]) -> Callable[[Any], Any]:
    """(values of the inputs (n,)) ↦ values of the outputs, in order. Truth values are 0 and 1 in between."""
    constants, groups = _groups(graph, graph.reachable(outputs, set(inputs)))
    place = {node: k for k, node in enumerate((*inputs, *constants))}
    known, planned = len(place), []
    for (_, op), nodes in groups:
        operands = [np.array([place[graph.args[node][k]] for node in nodes], np.int32) for k in range(len(graph.args[nodes[0]]))]
        planned.append((op, len(place), operands, [graph.is_boolean(a) for a in graph.args[nodes[0]]]))
        place.update({node: len(place) + k for k, node in enumerate(nodes)})
    read = np.array([place[node] for node in outputs], np.int32)
    fixed = np.array([float(graph.value[node]) for node in constants])
    size = len(place)

    def function(given: Any) -> Any:
        values = jnp.concatenate([jnp.asarray(given, float), fixed, jnp.zeros(size - known)])
        for op, start, operands, truths in planned:
            taken = [values[a] != 0.0 if truth else values[a] for a, truth in zip(operands, truths, strict=True)]
            found = jnp.asarray(JAX[op](*taken), float)
            values = jax.lax.dynamic_update_slice(values, found, (start,))
        return values[read]

    return function


def _groups(graph: Graph, nodes: Sequence[int]) -> tuple[list[int], list[tuple[tuple[int, str], list[int]]]]:
    """The constants among the nodes, and the others by their depth and operation, in an order in which they can be computed."""
    depth, constants, found = {}, [], defaultdict(list)
    for node in nodes:
        if graph.is_constant(node):
            constants.append(node)
            continue
        depth[node] = 1 + max((depth.get(a, 0) for a in graph.args[node]), default=0)
        found[depth[node], graph.op[node]].append(node)
    return constants, sorted(found.items())
