"""Numbers whose derivatives are not those of their values: with these a graph has the derivatives that JAX has of functions with
rules of their own."""

import jax
import numpy as np
from jax import lax

from dirax.program.operations.operation import Operation


@jax.custom_jvp
def _ruled(value, along):
    return value


_ruled.defjvps(None, lambda tangent, _, value, along: tangent)

OPERATIONS = (
    Operation(name="held", numpy=lambda x: x, jax=lax.stop_gradient, formula=lambda g, x: x),
    Operation(
        name="motion",
        numpy=np.zeros_like,
        jax=lambda x: x - lax.stop_gradient(x),
        derivative=lambda g, f, x: [g.one],
        formula=lambda g, x: g.zero,
    ),
    Operation(
        name="ruled",
        numpy=lambda x, along: x,
        jax=_ruled,
        derivative=lambda g, f, x, along: [None, g.one],
        formula=lambda g, x, along: x,
    ),
)
"""A number that does not move, the motion of a number, which is zero with derivative one, and a number that moves along another
one."""
