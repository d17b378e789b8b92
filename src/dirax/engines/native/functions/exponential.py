"""exp, exp2 and expm1, from e^x = 2^n (1 + p) with |p| ≤ √2 − 1 in two doubles."""

from dataclasses import dataclass

from dirax.engines.native.functions import coefficients as c
from dirax.engines.native.functions.powers_of_two import MAGIC, clamp, power_of_two, scale
from dirax.engines.native.ir.emitter import Emitter


@dataclass(frozen=True)
class Parts:
    """e^x = 2^n (1 + high + low), n a whole number held as a double."""

    high: str
    low: str
    n: str


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


MACHINE_CODE = {"exp": exp, "exp2": exp2, "expm1": expm1}
