"""erf and erfc: a polynomial up to 1, beyond it e^(−x²) times another."""

from dirax.engines.native.functions import coefficients as c
from dirax.engines.native.functions.exponential import exp_two
from dirax.engines.native.functions.powers_of_two import clamp
from dirax.engines.native.ir.emitter import Emitter


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


MACHINE_CODE = {"erf": erf, "erfc": erfc}
