"""exp, exp2 and expm1."""

import math

import numpy as np
from jax import lax

from dirax.program.operations.operation import elementary

OPERATIONS = (
    elementary("exp", np.exp, lax.exp, lambda g, x, f: f),
    elementary("exp2", np.exp2, lax.exp2, lambda g, x, f: g.mul(g.constant(math.log(2)), f)),
    elementary("expm1", np.expm1, lax.expm1, lambda g, x, f: g.add(f, g.one)),
)
