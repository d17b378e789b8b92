"""Comparisons, logic, and the choice between two numbers."""

import operator
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax

from dirax.program.operations.operation import Operation


def _truth(name: str, numpy, jax, **more: Any) -> Operation:
    return Operation(name=name, numpy=numpy, jax=jax, boolean=True, **more)


OPERATIONS = (
    Operation(
        name="select",
        numpy=np.where,
        jax=lambda condition, yes, no: lax.select(condition, *map(jnp.asarray, (yes, no))),
        derivative=lambda g, f, condition, yes, no: [
            None,
            g.select(condition, g.one, g.zero),
            g.select(condition, g.zero, g.one),
        ],
    ),
    _truth("lt", np.less, lax.lt, exact=operator.lt),
    _truth("le", np.less_equal, lax.le, exact=operator.le),
    _truth("eq", np.equal, lax.eq, exact=operator.eq, commutative=True),
    _truth("ne", np.not_equal, lax.ne, exact=operator.ne, commutative=True),
    _truth("finite", np.isfinite, lax.is_finite),
    _truth("and", np.logical_and, lax.bitwise_and, commutative=True),
    _truth("or", np.logical_or, lax.bitwise_or, commutative=True),
    _truth("not", np.logical_not, lax.bitwise_not),
)
