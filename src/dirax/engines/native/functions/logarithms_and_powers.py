"""log, log1p, pow and cbrt, from x = 2^n m with √½ ≤ m < √2."""

from dirax.engines.native.functions import coefficients as c
from dirax.engines.native.functions.exponential import split
from dirax.engines.native.functions.powers_of_two import clamp, exponent_and_fraction, scale
from dirax.engines.native.ir.emitter import Emitter

LN2_HIGH, LN2_LOW = c.LN2
LN2_THIRD = -1.3124698417785255e-27
TWO_THIRDS = (0.6666666666666666, 3.700743415417188e-17)


def _log_of(e: Emitter, n: str, f: str) -> str:
    """n ln 2 + log(1 + f): with s = f/(2 + f), log(1 + f) = f − (f²/2 − s (f²/2 + R(s²)))."""
    s = e.div(f, e.add(e.const(2.0), f))
    z = e.mul(s, s)
    tail = e.mul(z, e.polynomial(c.LOGARITHM, z))
    half = e.mul(e.mul(f, f), e.const(0.5))
    inner = e.fma(s, e.add(half, tail), e.mul(n, e.const(LN2_LOW)))
    return e.fma(n, e.const(LN2_HIGH), e.sub(f, e.sub(half, inner)))


def _outside(e: Emitter, x: str, value: str, zero_at: float) -> str:
    """−∞ at the pole, NaN below it, ∞ at ∞, NaN at NaN."""
    value = e.select(e.compare("oeq", x, e.const(zero_at)), e.const(float("-inf")), value)
    value = e.select(e.compare("oeq", x, e.const(float("inf"))), x, value)
    return e.select(e.compare("uge", x, e.const(zero_at)), e.select(e.compare("uno", x, x), x, value), e.const(float("nan")))


def log(e: Emitter, x: str) -> str:
    n, m = exponent_and_fraction(e, x)
    return _outside(e, x, _log_of(e, n, e.sub(m, e.const(1.0))), 0.0)


def log1p(e: Emitter, x: str) -> str:
    """log(1 + x), with what 1 + x rounds off added to the fraction."""
    total, lost = e.two_sum(e.const(1.0), x)
    n, m = exponent_and_fraction(e, total)
    f = e.add(e.sub(m, e.const(1.0)), scale(e, lost, clamp(e, e.neg(n), -1020.0, 1020.0)))
    tiny = e.compare("olt", e.abs(x), e.const(2.0**-54))
    return e.select(tiny, x, _outside(e, x, _log_of(e, n, f), -1.0))


def _log_two(e: Emitter, x: str) -> tuple[str, str]:
    """log x for positive finite x, in two doubles, relative error about 2^−65."""
    n, m = exponent_and_fraction(e, x)
    f = e.sub(m, e.const(1.0))
    below, below_low = e.two_sum(e.const(2.0), f)
    s = e.div(f, below)
    error = e.sub(e.product_minus(s, below, f), e.neg(e.mul(s, below_low)))
    s_low = e.neg(e.div(error, below))
    z, z_low = e.two_product(s, s)
    z_low = e.add(z_low, e.mul(e.mul(s, s_low), e.const(2.0)))
    # 2 atanh s = 2 s + s z (2/3 + z T(z))
    tail = e.mul(z, e.polynomial(c.LOGARITHM_TAIL, z))
    factor, factor_low = e.quick_two_sum(e.const(TWO_THIRDS[0]), tail)
    factor_low = e.add(factor_low, e.const(TWO_THIRDS[1]))
    zf, zf_low = e.two_product(z, factor)
    zf_low = e.add(zf_low, e.add(e.mul(z, factor_low), e.mul(z_low, factor)))
    cube, cube_low = e.two_product(s, zf)
    cube_low = e.add(cube_low, e.add(e.mul(s, zf_low), e.mul(s_low, zf)))
    high, low = e.quick_two_sum(e.mul(s, e.const(2.0)), cube)
    low = e.add(low, e.add(cube_low, e.mul(s_low, e.const(2.0))))
    base, base_low = e.two_sum(e.mul(n, e.const(LN2_HIGH)), high)
    low = e.add(base_low, low)
    # ln 2 beyond its first 32 bits, in two doubles
    second, second_low = e.two_product(n, e.const(LN2_LOW))
    third = e.mul(n, e.const(LN2_THIRD))
    high, more = e.two_sum(base, second)
    low = e.add(e.add(low, more), e.add(second_low, third))
    return e.quick_two_sum(high, low)


def power(e: Emitter, x: str, y: str) -> str:
    """x^y as C's pow has it: e^(y log|x|), with the sign of odd whole y and the special values."""
    one, zero, infinity = e.const(1.0), e.const(0.0), e.const(float("inf"))
    size = e.abs(x)
    inside = e.both(e.compare("ogt", size, zero), e.compare("olt", size, infinity))
    high, low = _log_two(e, e.select(inside, size, one))
    bounded = clamp(e, y, -1e30, 1e30)
    product, error = e.two_product(bounded, high)
    error = e.fma(bounded, low, error)
    cut = clamp(e, product, -760.0, 720.0)
    error = e.select(e.compare("oeq", cut, product), error, zero)
    p = split(e, cut, error)
    value = scale(e, e.add(one, e.add(p.high, p.low)), p.n)
    # |x| = 0 or ∞ by the sign of y
    grows = e.either(
        e.both(e.compare("oeq", size, infinity), e.compare("ogt", y, zero)),
        e.both(e.compare("oeq", size, zero), e.compare("olt", y, zero)),
    )
    value = e.select(inside, value, e.select(grows, infinity, zero))
    # the sign: whole y, odd if y/2 is not whole; NaN for negative x and broken y
    negative = e.int_equal(e.ints("lshr", e.bits(x), e.integer(63)), e.integer(1))
    whole = e.compare("oeq", e.intrinsic("floor", y), y)
    half = e.mul(y, e.const(0.5))
    odd = e.both(whole, e.compare("one", e.intrinsic("floor", half), half))
    signed = e.select(e.both(negative, odd), e.neg(value), value)
    broken = e.both(e.both(negative, inside), e.invert(whole))
    signed = e.select(broken, e.const(float("nan")), signed)
    signed = e.select(e.either(e.compare("uno", x, x), e.compare("uno", y, y)), e.add(x, y), signed)
    always_one = e.either(e.compare("oeq", y, zero), e.compare("oeq", x, one))
    unit = e.both(e.compare("oeq", size, one), e.compare("oeq", e.abs(y), infinity))
    return e.select(e.either(always_one, unit), one, signed)


def cbrt(e: Emitter, x: str) -> str:
    """2^(n/3) by thirds, a polynomial start on [1, 8), two Halley steps and one Newton step with an exact residual."""
    size = e.abs(x)
    inside = e.both(e.compare("ogt", size, e.const(0.0)), e.compare("olt", size, e.const(float("inf"))))
    n, m = exponent_and_fraction(e, e.select(inside, size, e.const(1.0)))
    n, m = e.sub(n, e.const(1.0)), e.mul(m, e.const(2.0))  # now √2 ≤ m < 2√2
    third = e.intrinsic("floor", e.mul(e.add(n, e.const(0.5)), e.const(1 / 3)))
    rest = e.sub(n, e.mul(third, e.const(3.0)))
    m = scale(e, m, rest)  # √2 ≤ m < 8√2
    r = e.horner(c.CUBE_ROOT, m)
    for _ in range(2):
        cube = e.mul(e.mul(r, r), r)
        r = e.mul(r, e.div(e.add(cube, e.add(m, m)), e.add(e.add(cube, cube), m)))
    square, square_low = e.two_product(r, r)
    residual = e.fma(square_low, r, e.product_minus(square, r, m))
    r = e.sub(r, e.div(residual, e.mul(square, e.const(3.0))))
    return e.select(inside, e.copysign(scale(e, r, third), x), x)


def asinh(e: Emitter, x: str) -> str:
    """log1p(|x| + x²/(1 + √(1 + x²))), and log|x| + ln 2 where x² is too large."""
    size = e.abs(x)
    large = e.compare("ogt", size, e.const(1e8))
    a = e.select(large, e.const(1.0), size)
    square = e.mul(a, a)
    root = e.sqrt(e.add(square, e.const(1.0)))
    near = log1p(e, e.add(a, e.div(square, e.add(root, e.const(1.0)))))
    far = e.add(log(e, size), e.const(0.6931471805599453))
    return e.copysign(e.select(large, far, near), x)


def acosh(e: Emitter, x: str) -> str:
    """log1p(t + √(2t + t²)) with t = x − 1."""
    large = e.compare("ogt", x, e.const(1e8))
    t = e.sub(e.select(large, e.const(2.0), x), e.const(1.0))
    near = log1p(e, e.add(t, e.sqrt(e.mul(t, e.add(t, e.const(2.0))))))
    value = e.select(large, e.add(log(e, x), e.const(0.6931471805599453)), near)
    return e.select(e.compare("olt", x, e.const(1.0)), e.const(float("nan")), value)


def atanh(e: Emitter, x: str) -> str:
    """½ log1p(2|x|/(1 − |x|))."""
    size = e.abs(x)
    value = e.mul(e.const(0.5), log1p(e, e.div(e.add(size, size), e.sub(e.const(1.0), size))))
    return e.copysign(value, x)


MACHINE_CODE = {"log": log, "log1p": log1p, "pow": power, "cbrt": cbrt}
