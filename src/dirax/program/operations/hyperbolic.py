"""sinh, cosh and tanh, and their inverses by formulas."""

import numpy as np
from jax import lax

from dirax.program.operations.operation import Builder, elementary, root, square

LARGE = 1e8
"""The size from which on x² + 1 = x² to the last place."""

LN2 = 0.6931471805599453


def _asinh(g: Builder, x: int) -> int:
    """log1p(|x| + x²/(1 + √(1 + x²))) with the sign of x, and log|x| + ln 2 where x² may be too large."""
    size = g.make("abs", x)
    large = g.make("lt", g.constant(LARGE), size)
    a = g.select(large, g.one, size)
    near = g.make("log1p", g.add(a, g.div(square(g, a), g.add(root(g, g.add(square(g, a), g.one)), g.one))))
    far = g.add(g.make("log", size), g.constant(LN2))
    return g.mul(g.make("sign", x), g.select(large, far, near))


def _acosh(g: Builder, x: int) -> int:
    """log1p(t + √(2t + t²)) with t = x − 1."""
    large = g.make("lt", g.constant(LARGE), x)
    t = g.sub(g.select(large, g.constant(2.0), x), g.one)
    near = g.make("log1p", g.add(t, root(g, g.mul(t, g.add(t, g.constant(2.0))))))
    value = g.select(large, g.add(g.make("log", x), g.constant(LN2)), near)
    return g.select(g.make("lt", x, g.one), g.constant(float("nan")), value)


def _atanh(g: Builder, x: int) -> int:
    """½ log1p(2|x|/(1 − |x|)) with the sign of x."""
    size = g.make("abs", x)
    ratio = g.div(g.add(size, size), g.sub(g.one, size))
    return g.mul(g.make("sign", x), g.mul(g.constant(0.5), g.make("log1p", ratio)))


OPERATIONS = (
    elementary("sinh", np.sinh, lax.sinh, lambda g, x, f: g.make("cosh", x)),
    elementary("cosh", np.cosh, lax.cosh, lambda g, x, f: g.make("sinh", x)),
    elementary("tanh", np.tanh, lax.tanh, lambda g, x, f: g.sub(g.one, square(g, f))),
    elementary("asinh", np.arcsinh, lax.asinh, lambda g, x, f: g.recip(root(g, g.add(square(g, x), g.one))), formula=_asinh),
    elementary(
        "acosh", np.arccosh, lax.acosh, lambda g, x, f: g.recip(root(g, g.sub(square(g, x), g.one))), formula=_acosh, edge=True
    ),
    elementary("atanh", np.arctanh, lax.atanh, lambda g, x, f: g.recip(g.sub(g.one, square(g, x))), formula=_atanh),
)
