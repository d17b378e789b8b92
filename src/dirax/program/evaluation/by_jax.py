"""Nodes of a scalar graph as operations of JAX on scalars."""

from typing import Any

import jax.numpy as jnp

from dirax.program.graph import Graph
from dirax.program.operations import JAX


def by_jax(g: Graph, outputs: list[int], values: dict[int, Any]) -> Any:
    """Nodes of a graph as one array, from the `values` of its inputs, to which those of all others are added."""
    for node in g.reachable(outputs, values):
        if g.is_constant(node):
            values[node] = jnp.asarray(g.value[node])
    return jnp.stack([jnp.asarray(x, float) for x in g.evaluate(outputs, {}, JAX, values)])
