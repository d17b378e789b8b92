"""erf and erfc."""

import math
from collections.abc import Callable

import numpy as np
from jax import lax

from dirax.program.operations.operation import Builder, elementary, square


def _bell(factor: float) -> Callable[[Builder, int, int], int]:
    """factor·2/√π·exp(−x²)."""
    height = factor * 2 / math.sqrt(math.pi)
    return lambda g, x, f: g.mul(g.constant(height), g.make("exp", g.neg(square(g, x))))


OPERATIONS = (
    elementary("erf", np.vectorize(math.erf, otypes=[np.float64]), lax.erf, _bell(1.0)),
    elementary("erfc", np.vectorize(math.erfc, otypes=[np.float64]), lax.erfc, _bell(-1.0)),
)
