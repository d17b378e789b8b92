"""Nodes of a scalar graph as operations of JAX on scalars."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from dirax.program.graph import Graph

OPERATIONS: dict[str, Callable] = {
    **{name: getattr(jax.lax, name) for name in ("add", "sub", "mul", "neg", "abs", "sqrt", "floor", "ceil", "sign")},
    **{name: getattr(jax.lax, name) for name in ("max", "min", "rem", "sin", "cos", "tan", "asin", "acos", "atan", "atan2")},
    **{name: getattr(jax.lax, name) for name in ("sinh", "cosh", "tanh", "asinh", "acosh", "atanh", "exp", "exp2", "expm1")},
    **{name: getattr(jax.lax, name) for name in ("log", "log1p", "pow", "cbrt", "erf", "erfc", "lt", "le", "eq", "ne")},
    "recip": jax.lax.reciprocal,
    "round": jnp.rint,
    "trunc": jnp.trunc,
    "select": lambda condition, yes, no: jax.lax.select(condition, *map(jnp.asarray, (yes, no))),
    "finite": jax.lax.is_finite,
    "and": jax.lax.bitwise_and,
    "or": jax.lax.bitwise_or,
    "not": jax.lax.bitwise_not,
}
"""What the operations of the graph are on scalars in JAX."""


def by_jax(g: Graph, outputs: list[int], values: dict[int, Any]) -> Any:
    """Nodes of a graph as one array, from the `values` of its inputs, to which those of all others are added."""
    for node in g.reachable(outputs, values):
        if g.is_constant(node):
            values[node] = jnp.asarray(g.value[node])
    return jnp.stack([jnp.asarray(x, float) for x in g.evaluate(outputs, {}, OPERATIONS, values)])
