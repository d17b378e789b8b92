"""The functions of a step as one jaxpr, traced once at the flat sizes, for all that reads it."""

from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr

from dirax.engines.parameters import Parameters
from dirax.program.memo import Memo, Same

KEPT = 128
"""Jaxprs kept in memory."""

_jaxprs: Memo[ClosedJaxpr] = Memo(KEPT)


def step_jaxpr(equation: Any, p: Parameters) -> ClosedJaxpr:
    """(u, state, previous, t, h, parameters) ↦ guess, residual, advance and the fields of a row in the order of their names,
    of one StepEquation."""
    return _jaxprs.get((Same(equation), p.key), lambda: _traced(equation, p))


def _traced(equation: Any, p: Parameters) -> ClosedJaxpr:
    s, k = equation.state_size, equation.unknowns
    scalar, vector = jax.ShapeDtypeStruct((), jnp.float64), lambda n: jax.ShapeDtypeStruct((n,), jnp.float64)
    leaf_shapes = [jax.ShapeDtypeStruct(shape, jnp.float64) for shape in p.shapes]

    def everything(u, state, previous, t, h, leaves):
        params = p.rebuild(leaves)
        row = equation.unpack(state, u, t, h, params)
        return (
            equation.guess(state, previous, h, params),
            equation.residual(u, state, t, h, params),
            equation.advance(u, state, t, h, params),
            [jnp.asarray(row[name]) for name in sorted(row)],
        )

    return jax.make_jaxpr(everything)(vector(k), vector(s), vector(k), scalar, scalar, leaf_shapes)
