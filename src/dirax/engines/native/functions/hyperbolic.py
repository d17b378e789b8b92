"""sinh, cosh and tanh, from the parts of e^|x|."""

from dirax.engines.native.functions.exponential import split
from dirax.engines.native.functions.powers_of_two import clamp, power_of_two
from dirax.engines.native.ir.emitter import Emitter

LARGEST = 710.5
"""The hyperbolic functions overflow before this."""


def _hyperbolic(e: Emitter, x: str):
    """For |x|: a = 2^(n−2), b = 2^(−n−2) and p, and w = p/(1 + p) in two doubles: e^x/4 = a(1 + p), e^−x/4 = b(1 − w)."""
    size = clamp(e, e.abs(x), 0.0, LARGEST)
    p = split(e, size)
    a = power_of_two(e, e.sub(p.n, e.const(2.0)))
    b = power_of_two(e, e.sub(e.const(-2.0), e.select(e.compare("ogt", p.n, e.const(1000.0)), e.const(1000.0), p.n)))
    below, below_low = e.quick_two_sum(e.const(1.0), p.high)
    w = e.div(p.high, below)
    error = e.sub(e.product_minus(w, below, p.high), e.sub(p.low, e.mul(w, e.add(below_low, p.low))))
    return a, b, p, w, e.neg(e.div(error, below))


def _or_infinite(e: Emitter, x: str, value: str) -> str:
    return e.select(e.compare("ogt", e.abs(x), e.const(LARGEST)), e.const(float("inf")), value)


def sinh(e: Emitter, x: str) -> str:
    """2[(a − b) + a p + b w]·sign x."""
    a, b, p, w, w_low = _hyperbolic(e, x)
    first, lost = e.two_sum(e.mul(a, p.high), e.mul(b, w))
    total, error = e.two_sum(e.sub(a, b), first)
    low = e.add(e.add(error, lost), e.fma(a, p.low, e.mul(b, w_low)))
    low = e.add(low, e.sub(e.sub(a, e.sub(a, b)), b))
    half = e.add(total, low)
    return e.copysign(_or_infinite(e, x, e.add(half, half)), x)


def cosh(e: Emitter, x: str) -> str:
    """2[(a + b) + a p − b w]."""
    a, b, p, w, w_low = _hyperbolic(e, x)
    first, lost = e.two_sum(e.mul(a, p.high), e.neg(e.mul(b, w)))
    base, base_low = e.two_sum(a, b)
    total, error = e.two_sum(base, first)
    low = e.add(e.add(error, e.add(lost, base_low)), e.sub(e.mul(a, p.low), e.mul(b, w_low)))
    half = e.add(total, low)
    return _or_infinite(e, x, e.add(half, half))


def tanh(e: Emitter, x: str) -> str:
    """E/(E + 2) with E = e^(2|x|) − 1."""
    size = clamp(e, e.abs(x), 0.0, 20.0)
    p = split(e, e.add(size, size))
    two = power_of_two(e, p.n)
    top, top_low = e.two_sum(e.sub(two, e.const(1.0)), e.mul(two, p.high))
    top_low = e.fma(two, p.low, top_low)
    top, top_low = e.quick_two_sum(top, top_low)
    bottom, bottom_low = e.two_sum(top, e.const(2.0))
    bottom_low = e.add(bottom_low, top_low)
    t = e.div(top, bottom)
    error = e.sub(e.product_minus(t, bottom, top), e.sub(top_low, e.mul(t, bottom_low)))
    return e.copysign(e.sub(t, e.div(error, bottom)), x)


MACHINE_CODE = {"sinh": sinh, "cosh": cosh, "tanh": tanh}
