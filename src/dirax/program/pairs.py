"""Functions of complex numbers as pairs of real ones."""

from typing import Any, NamedTuple

import jax.numpy as jnp


class Pair(NamedTuple):
    """The real and the imaginary part of an array."""

    re: Any
    im: Any


def as_pair(x: Any) -> Pair:
    """A real array as a complex one; a pair as it is."""
    return x if isinstance(x, Pair) else Pair(x, jnp.zeros_like(x))


def add(x: Pair, y: Pair) -> Pair:
    """x + y."""
    return Pair(x.re + y.re, x.im + y.im)


def subtract(x: Pair, y: Pair) -> Pair:
    """x − y."""
    return Pair(x.re - y.re, x.im - y.im)


def negative(x: Pair) -> Pair:
    """−x."""
    return Pair(-x.re, -x.im)


def multiply(x: Pair, y: Pair) -> Pair:
    """x y."""
    return Pair(x.re * y.re - x.im * y.im, x.re * y.im + x.im * y.re)


def divide(x: Pair, y: Pair) -> Pair:
    """x/y."""
    size = y.re * y.re + y.im * y.im
    return Pair((x.re * y.re + x.im * y.im) / size, (x.im * y.re - x.re * y.im) / size)


def power(x: Pair, n: int) -> Pair:
    """xⁿ by products."""
    if n < 0:
        return divide(Pair(jnp.ones_like(x.re), jnp.zeros_like(x.re)), power(x, -n))
    found = None
    while n:
        if n & 1:
            found = x if found is None else multiply(found, x)
        n >>= 1
        x = multiply(x, x) if n else x
    return Pair(jnp.ones_like(x.re), jnp.zeros_like(x.re)) if found is None else found


def size(x: Pair) -> Any:
    """|x|, whose derivative at zero is zero."""
    square = x.re * x.re + x.im * x.im
    return jnp.where(square == 0.0, 0.0, jnp.sqrt(jnp.where(square == 0.0, 1.0, square)))


def sign(x: Pair) -> Pair:
    """x/|x|, and zero at zero."""
    length = size(x)
    length = jnp.where(length == 0.0, 1.0, length)
    return Pair(x.re / length, x.im / length)


def exp(x: Pair) -> Pair:
    """e to the x."""
    e = jnp.exp(x.re)
    return Pair(e * jnp.cos(x.im), e * jnp.sin(x.im))


def expm1(x: Pair) -> Pair:
    """e to the x, less one."""
    s = jnp.sin(x.im / 2)
    return Pair(jnp.expm1(x.re) * jnp.cos(x.im) - 2 * s * s, jnp.exp(x.re) * jnp.sin(x.im))


def logistic(x: Pair) -> Pair:
    """1/(1 + e to the −x)."""
    e = exp(negative(x))
    return power(Pair(1 + e.re, e.im), -1)


def log(x: Pair) -> Pair:
    """The logarithm, with an imaginary part between −π and π."""
    return Pair(jnp.log(x.re * x.re + x.im * x.im) / 2, jnp.arctan2(x.im, x.re))


def log1p(x: Pair) -> Pair:
    """The logarithm of 1 + x, where 1 + x is small from itself."""
    re = 1 + x.re
    square = re * re + x.im * x.im
    small = square < 0.25
    more = jnp.where(small, 0.0, x.re * (2 + x.re) + x.im * x.im)
    of_size = jnp.where(small, jnp.log(jnp.where(small, square, 1.0)), jnp.log1p(more))
    return Pair(of_size / 2, jnp.arctan2(x.im, re))


def sqrt(x: Pair) -> Pair:
    """The root with a real part that is not negative; zero, with no derivative, at zero."""
    zero = (x.re == 0.0) & (x.im == 0.0)
    re, im = jnp.where(zero, 1.0, x.re), x.im
    t = jnp.sqrt((size(Pair(re, im)) + jnp.abs(re)) / 2)
    other = im / (2 * t)
    right = re >= 0.0
    found = Pair(jnp.where(right, t, jnp.abs(other)), jnp.where(right, other, jnp.where(im < 0.0, -t, t)))
    return Pair(*(jnp.where(zero, jnp.sqrt(jnp.where(zero, x.re, 1.0)), part) for part in found))


def sin(x: Pair) -> Pair:
    """The sine."""
    return Pair(jnp.sin(x.re) * jnp.cosh(x.im), jnp.cos(x.re) * jnp.sinh(x.im))


def cos(x: Pair) -> Pair:
    """The cosine."""
    return Pair(jnp.cos(x.re) * jnp.cosh(x.im), -jnp.sin(x.re) * jnp.sinh(x.im))


def sinh(x: Pair) -> Pair:
    """The hyperbolic sine."""
    return Pair(jnp.sinh(x.re) * jnp.cos(x.im), jnp.cosh(x.re) * jnp.sin(x.im))


def cosh(x: Pair) -> Pair:
    """The hyperbolic cosine."""
    return Pair(jnp.cosh(x.re) * jnp.cos(x.im), jnp.sinh(x.re) * jnp.sin(x.im))


def tanh(x: Pair) -> Pair:
    """(tanh a + i sin b cos b / cosh² a)/(cos² b + tanh² a sin² b)."""
    a, c, s, b = jnp.tanh(x.re), jnp.cos(x.im), jnp.sin(x.im), 1 / jnp.cosh(x.re)
    below = c * c + a * a * s * s
    return Pair(a / below, s * c * b * b / below)


def tan(x: Pair) -> Pair:
    """The tangent."""
    turned = tanh(Pair(-x.im, x.re))
    return Pair(turned.im, -turned.re)


def power_of(x: Pair, y: Pair) -> Pair:
    """exp(y log x); where x is zero, 0 for exponents with a positive real part, 1 for zero, and else NaN."""
    zero = (x.re == 0.0) & (x.im == 0.0)
    found = exp(multiply(y, log(Pair(jnp.where(zero, 1.0, x.re), x.im))))
    at_zero = jnp.where(y.re > 0.0, 0.0, jnp.where((y.re == 0.0) & (y.im == 0.0), 1.0, jnp.nan))
    return Pair(jnp.where(zero, at_zero, found.re), jnp.where(zero, jnp.where(at_zero == 1.0, 0.0, at_zero), found.im))
