"""log and log1p, powers and cube roots."""

import numpy as np
from jax import lax

from dirax.program.operations.operation import Builder, Operation, elementary, square


def _power(g: Builder, node: int, x: int, y: int) -> list[int | None]:
    by_x = g.mul(y, g.make("pow", x, g.sub(y, g.one)))
    positive = g.make("lt", g.zero, x)
    by_y = g.select(positive, g.mul(node, g.make("log", g.select(positive, x, g.one))), g.zero)
    return [by_x, None if g.is_constant(y) else by_y]


OPERATIONS = (
    elementary("log", np.log, lax.log, lambda g, x, f: g.recip(x)),
    elementary("log1p", np.log1p, lax.log1p, lambda g, x, f: g.recip(g.add(g.one, x))),
    Operation(name="pow", numpy=np.power, jax=lax.pow, derivative=_power, c="pow", edge=True),
    elementary("cbrt", np.cbrt, lax.cbrt, lambda g, x, f: g.recip(g.mul(g.constant(3.0), square(g, f))), edge=True),
)
