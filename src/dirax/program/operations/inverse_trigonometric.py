"""asin, acos, atan and atan2."""

import numpy as np
from jax import lax

from dirax.program.operations.operation import Builder, Operation, elementary, root, square


def _angle(g: Builder, node: int, y: int, x: int) -> list[int | None]:
    r = g.recip(g.add(square(g, y), square(g, x)))
    return [g.mul(x, r), g.neg(g.mul(y, r))]


OPERATIONS = (
    elementary("asin", np.arcsin, lax.asin, lambda g, x, f: g.recip(root(g, g.sub(g.one, square(g, x)))), edge=True),
    elementary("acos", np.arccos, lax.acos, lambda g, x, f: g.neg(g.recip(root(g, g.sub(g.one, square(g, x))))), edge=True),
    elementary("atan", np.arctan, lax.atan, lambda g, x, f: g.recip(g.add(g.one, square(g, x)))),
    Operation(name="atan2", numpy=np.arctan2, jax=lax.atan2, derivative=_angle, c="atan2", edge=True),
)
