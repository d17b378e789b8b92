"""Nodes of a scalar graph level by level in JAX: equal operations on nodes of one depth are one operation on arrays.

A machine of many equal parts has as many scalar operations as parts, and no more levels than one of them.
"""

from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from dirax.program.graph import Graph
from dirax.program.operations import JAX

Place = tuple[int, int]
"""Of a node's value: the number of an array, and the place in it."""


def in_levels(graph: Graph, inputs: Sequence[int], outputs: Sequence[int]) -> Callable[[Any], Any]:
    """(values of the inputs (n,)) ↦ values of the outputs, in order."""
    constants, groups = _groups(graph, graph.reachable(outputs, set(inputs)))
    fixed = np.array([float(graph.value[node]) for node in constants])
    places: dict[int, Place] = {node: (0, k) for k, node in enumerate((*inputs, *constants))}
    sizes, planned = [len(places)], []
    for number, ((_, op), nodes) in enumerate(groups, start=1):
        operands = zip(*(graph.args[node] for node in nodes), strict=True)
        truths = [graph.is_boolean(a) for a in graph.args[nodes[0]]]
        planned.append((op, [(_read(places, sizes, of), truth) for of, truth in zip(operands, truths, strict=True)]))
        places.update({node: (number, k) for k, node in enumerate(nodes)})
        sizes.append(len(nodes))
    last = _read(places, sizes, outputs)

    def function(given: Any) -> Any:
        arrays = [jnp.concatenate([jnp.asarray(given, float), fixed])]
        for op, operands in planned:
            taken = [(read(arrays) != 0.0) if truth else read(arrays) for read, truth in operands]
            arrays.append(jnp.asarray(JAX[op](*taken), float))  # truth values are 0 and 1 in between
        return last(arrays)

    return function


def _read(places: dict[int, Place], sizes: list[int], nodes: Sequence[int]) -> Callable[[list[Any]], Any]:
    """(arrays) ↦ the values of these nodes."""
    used = sorted({places[node][0] for node in nodes})
    starts = dict(zip(used, np.cumsum([0, *(sizes[number] for number in used)]).tolist(), strict=False))
    indices = np.array([starts[number] + k for number, k in map(places.__getitem__, nodes)], np.int32)

    def read(arrays: list[Any]) -> Any:
        whole = jnp.concatenate([arrays[number] for number in used])
        return whole.at[indices].get(mode="promise_in_bounds")

    return read


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
