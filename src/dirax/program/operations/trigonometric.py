"""sin, cos and tan."""

import numpy as np
from jax import lax

from dirax.program.operations.operation import elementary, square

OPERATIONS = (
    elementary("sin", np.sin, lax.sin, lambda g, x, f: g.make("cos", x)),
    elementary("cos", np.cos, lax.cos, lambda g, x, f: g.neg(g.make("sin", x))),
    elementary("tan", np.tan, lax.tan, lambda g, x, f: g.add(g.one, square(g, f))),
)
