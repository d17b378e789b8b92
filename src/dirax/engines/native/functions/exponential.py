"""exp and its relatives, from e^x = 2^n (1 + p) with |p| ≤ √2 − 1 in two doubles; and erf, erfc."""

from dataclasses import dataclass

from dirax.engines.native.functions import coefficients as c
from dirax.engines.native.functions.trigonometric import MAGIC
from dirax.engines.native.ir.emitter import Emitter

LARGEST = 710.5
"""The hyperbolic functions overflow before this."""


@dataclass(frozen=True)
class Parts:
    """e^x = 2^n (1 + high + low), n a whole number held as a double."""

    high: str
    low: str
    n: str


def clamp(e: Emitter, x: str, low: float, high: float) -> str:
    """x within bounds; NaN stays NaN."""
    x = e.select(e.compare("ogt", x, e.const(high)), e.const(high), x)
    return e.select(e.compare("olt", x, e.const(low)), e.const(low), x)


def split(e: Emitter, x: str, x_low: str | None = None) -> Parts:
    """The parts of e^(x + x_low), for |x| < 2^40."""
    n = e.sub(e.add(e.mul(x, e.const(1.4426950408889634)), e.const(MAGIC)), e.const(MAGIC))
    first = e.sub(x, e.mul(n, e.const(c.LN2[0])))
    r, r_low = e.two_sum(first, e.mul(n, e.const(-c.LN2[1])))
    if x_low is not None:
        r, more = e.two_sum(r, x_low)
        r_low = e.add(r_low, more)
    curve = e.mul(e.mul(r, r), e.polynomial(c.EXPONENTIAL, r))
    high, low = e.quick_two_sum(r, e.fma(r_low, e.add(e.const(1.0), r), curve))
    return Parts(high, low, n)


def power_of_two(e: Emitter, n: str) -> str:
    """2^n for whole −1022 ≤ n ≤ 1024 (the last gives infinity)."""
    bits = e.bits(e.add(n, e.const(MAGIC)))
    return e.from_bits(e.ints("shl", e.ints("add", bits, e.integer(1023)), e.integer(52)))


def scale(e: Emitter, x: str, n: str) -> str:
    """x·2^n for whole |n| ≤ 2000, rounded once when the result is subnormal."""
    half = e.intrinsic("floor", e.mul(n, e.const(0.5)))
    return e.mul(e.mul(x, power_of_two(e, half)), power_of_two(e, e.sub(n, half)))


def exp(e: Emitter, x: str) -> str:
    return exp_two(e, x, None)


def exp_two(e: Emitter, x: str, x_low: str | None) -> str:
    """e^(x + x_low)."""
    p = split(e, clamp(e, x, -760.0, 720.0), x_low)
    return scale(e, e.add(e.const(1.0), e.add(p.high, p.low)), p.n)


def exp2(e: Emitter, x: str) -> str:
    x = clamp(e, x, -1100.0, 1100.0)
    n = e.sub(e.add(x, e.const(MAGIC)), e.const(MAGIC))
    r = e.sub(x, n)
    ln2 = 0.6931471805599453
    high, low = e.two_product(r, e.const(ln2))
    low = e.fma(r, e.const(2.3190468138462996e-17), low)
    curve = e.mul(e.mul(high, high), e.polynomial(c.EXPONENTIAL, high))
    total, rest = e.quick_two_sum(high, e.fma(low, e.add(e.const(1.0), high), curve))
    return scale(e, e.add(e.const(1.0), e.add(total, rest)), n)


def expm1(e: Emitter, x: str) -> str:
    """(2^n − 1) + 2^n p."""
    x = clamp(e, x, -50.0, 720.0)
    p = split(e, x)
    large = e.compare("ogt", p.n, e.const(60.0))
    n = e.select(large, e.const(0.0), p.n)
    two = power_of_two(e, n)
    total, error = e.two_sum(e.sub(two, e.const(1.0)), e.mul(two, p.high))
    near = e.add(total, e.fma(two, p.low, error))
    far = scale(e, e.add(e.const(1.0), e.add(p.high, p.low)), p.n)
    return e.select(large, far, near)


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


def _complement(e: Emitter, size: str) -> str:
    """erfc for 1 ≤ size ≤ 28: e^(−x²) times a polynomial in (x − 2)/(x + 2) over x + 2."""
    square, error = e.two_product(size, size)
    shifted = e.add(size, e.const(2.0))
    t = e.div(e.sub(size, e.const(2.0)), shifted)
    return e.mul(exp_two(e, e.neg(square), e.neg(error)), e.div(e.polynomial(c.COMPLEMENT, t), shifted))


def erf(e: Emitter, x: str) -> str:
    size = clamp(e, e.abs(x), 0.0, 28.0)
    z = e.mul(x, x)
    slope = 1.1283791670955126
    near = e.fma(x, e.polynomial(c.ERROR_FUNCTION, z), e.mul(x, e.const(slope)))
    far = e.sub(e.const(1.0), _complement(e, e.max(size, e.const(1.0))))
    return e.select(e.compare("ogt", size, e.const(1.0)), e.copysign(far, x), near)


def erfc(e: Emitter, x: str) -> str:
    size = clamp(e, e.abs(x), 0.0, 28.0)
    far = _complement(e, e.max(size, e.const(1.0)))
    reflected = e.select(e.compare("olt", x, e.const(0.0)), e.sub(e.const(2.0), far), far)
    slope, slope_low = 1.1283791670955126, 1.533545961316588e-17  # 2/√π
    product, lost = e.two_product(x, e.const(slope))
    total, error = e.two_sum(e.const(1.0), e.neg(product))
    small = e.sub(e.fma(x, e.const(-slope_low), error), lost)
    near = e.add(total, e.fma(e.neg(x), e.polynomial(c.ERROR_FUNCTION, e.mul(x, x)), small))
    return e.select(e.compare("ogt", size, e.const(1.0)), reflected, near)
