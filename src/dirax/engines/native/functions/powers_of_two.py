"""Numbers as a power of two times a fraction, and back: what exponentials and logarithms begin and end with."""

from dirax.engines.native.ir.emitter import Emitter

MAGIC = 1.5 * 2.0**52
"""Added to |x| < 2^51, leaves the nearest whole number in the low bits."""

SQRT_HALF_BITS = 0x3FE6A09E667F3BCD


def clamp(e: Emitter, x: str, low: float, high: float) -> str:
    """x within bounds; NaN stays NaN."""
    x = e.select(e.compare("ogt", x, e.const(high)), e.const(high), x)
    return e.select(e.compare("olt", x, e.const(low)), e.const(low), x)


def power_of_two(e: Emitter, n: str) -> str:
    """2^n for whole −1022 ≤ n ≤ 1024 (the last gives infinity)."""
    bits = e.bits(e.add(n, e.const(MAGIC)))
    return e.from_bits(e.ints("shl", e.ints("add", bits, e.integer(1023)), e.integer(52)))


def scale(e: Emitter, x: str, n: str) -> str:
    """x·2^n for whole |n| ≤ 2000, rounded once when the result is subnormal."""
    half = e.intrinsic("floor", e.mul(n, e.const(0.5)))
    return e.mul(e.mul(x, power_of_two(e, half)), power_of_two(e, e.sub(n, half)))


def exponent_and_fraction(e: Emitter, x: str) -> tuple[str, str]:
    """(n, m) as doubles with x = 2^n m and √½ ≤ m < √2, for positive finite x, subnormal ones included."""
    tiny = e.compare("olt", x, e.const(2.2250738585072014e-308))
    bits = e.bits(e.select(tiny, e.mul(x, e.const(2.0**54)), x))
    shifted = e.ints("sub", bits, e.integer(SQRT_HALF_BITS))
    n = e.ints("ashr", shifted, e.integer(52))
    m = e.from_bits(e.ints("sub", bits, e.ints("shl", n, e.integer(52))))
    magic_bits = 0x4338000000000000
    as_double = e.sub(e.from_bits(e.ints("add", n, e.integer(magic_bits))), e.const(MAGIC))
    return e.select(tiny, e.sub(as_double, e.const(54.0)), as_double), m
