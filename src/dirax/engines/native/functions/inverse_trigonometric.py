"""atan, atan2, asin and acos."""

from dirax.engines.native.functions import coefficients as c
from dirax.engines.native.ir.emitter import Emitter

TAN_PI_8 = 0.41421356237309503


def atan2(e: Emitter, y: str, x: str) -> str:
    """The angle of (x, y): arctangent of smaller over larger, moved by π/4 where the ratio exceeds tan π/8, then unfolded."""
    zero, one, infinity = e.const(0.0), e.const(1.0), e.const(float("inf"))
    ax, ay = e.abs(x), e.abs(y)
    steep = e.compare("ogt", ay, ax)
    large, small = e.select(steep, ay, ax), e.select(steep, ax, ay)
    # infinities, zeros and numbers whose sum overflows are replaced by others of the same ratio
    both_infinite = e.compare("oeq", small, infinity)
    large, small = e.select(both_infinite, one, large), e.select(both_infinite, one, small)
    endless = e.compare("oeq", large, infinity)
    large, small = e.select(endless, one, large), e.select(endless, zero, small)
    large = e.select(e.compare("oeq", large, zero), one, large)
    overflows = e.compare("ogt", large, e.const(2.0**1000))
    large = e.select(overflows, e.mul(large, e.const(2.0**-60)), large)
    small = e.select(overflows, e.mul(small, e.const(2.0**-60)), small)
    middle = e.compare("ogt", small, e.mul(large, e.const(TAN_PI_8)))
    difference, difference_low = e.two_sum(small, e.neg(large))
    total, total_low = e.two_sum(small, large)
    top, top_low = e.select(middle, difference, small), e.select(middle, difference_low, zero)
    bottom, bottom_low = e.select(middle, total, large), e.select(middle, total_low, zero)
    t = e.div(top, bottom)
    error = e.sub(e.product_minus(t, bottom, top), e.sub(top_low, e.mul(t, bottom_low)))
    # far below, the remainder of the division underflows, and does not matter beside the rounding of t
    exact = e.compare("ogt", top, e.const(2.0**-900))
    t_low = e.select(e.either(exact, middle), e.neg(e.div(error, bottom)), zero)
    z = e.mul(t, t)
    angle_low = e.add(t_low, e.mul(e.mul(t, z), e.polynomial(c.ARCTANGENT, z)))
    # the sum of a constant and ± the angle: steep reflects at π/4, negative x at π/2
    left = e.int_equal(e.ints("lshr", e.bits(x), e.integer(63)), e.integer(1))
    turns = (
        (zero, zero),
        *((e.const(a), e.const(b)) for a, b in (c.PI_4, c.PI_2, (2.356194490192345, 9.184850993605148e-17), c.PI)),
    )
    choose = lambda part: e.select(
        middle,
        e.select(left, turns[3][part], turns[1][part]),
        e.select(steep, turns[2][part], e.select(left, turns[4][part], turns[0][part])),
    )
    base, base_low = choose(0), choose(1)
    flip = e.body.put(f"xor {e.bool} {steep}, {left}")
    s, s_low = e.select(flip, e.neg(t), t), e.select(flip, e.neg(angle_low), angle_low)
    first, lost = e.quick_two_sum(base, s)
    lost = e.select(e.compare("oeq", base, zero), zero, lost)
    angle = e.add(first, e.add(lost, e.add(base_low, s_low)))
    angle = e.copysign(angle, y)
    return e.select(e.compare("uno", x, y), e.add(x, y), angle)


def atan(e: Emitter, x: str) -> str:
    return atan2(e, x, e.const(1.0))


def _arcsine_near(e: Emitter, t: str) -> str:
    """asin t − t for |t| ≤ ½."""
    z = e.mul(t, t)
    return e.mul(e.mul(t, z), e.polynomial(c.ARCSINE, z))


def _half_angle(e: Emitter, size: str) -> tuple[str, str]:
    """√((1 − size)/2) in two doubles."""
    w = e.mul(e.sub(e.const(1.0), size), e.const(0.5))
    s = e.sqrt(w)
    low = e.neg(e.div(e.product_minus(s, s, w), e.add(s, s)))
    return s, e.select(e.compare("oeq", w, e.const(0.0)), e.const(0.0), low)


def asin(e: Emitter, x: str) -> str:
    """Near ±1: π/2 − 2 asin √((1 − |x|)/2)."""
    size = e.abs(x)
    near = e.compare("ole", size, e.const(0.5))
    s, s_low = _half_angle(e, size)
    t = e.select(near, size, s)
    curve = _arcsine_near(e, t)
    rest = e.add(s_low, curve)
    first, lost = e.quick_two_sum(e.const(c.PI_2[0]), e.mul(e.const(-2.0), s))
    far = e.add(first, e.add(lost, e.fma(e.const(-2.0), rest, e.const(c.PI_2[1]))))
    return e.copysign(e.select(near, e.add(size, curve), far), x)


def acos(e: Emitter, x: str) -> str:
    """π/2 − asin x in the middle, 2 asin √((1 − x)/2) and π minus it at the ends."""
    size = e.abs(x)
    near = e.compare("ole", size, e.const(0.5))
    s, s_low = _half_angle(e, size)
    t = e.select(near, x, s)
    curve = _arcsine_near(e, t)
    first, lost = e.quick_two_sum(e.const(c.PI_2[0]), e.neg(x))
    middle = e.add(first, e.sub(e.add(lost, e.const(c.PI_2[1])), curve))
    rest = e.add(s_low, curve)
    right = e.mul(e.const(2.0), e.add(s, rest))
    head, more = e.quick_two_sum(e.const(c.PI[0]), e.mul(e.const(-2.0), s))
    left = e.add(head, e.add(more, e.fma(e.const(-2.0), rest, e.const(c.PI[1]))))
    end = e.select(e.compare("olt", x, e.const(0.0)), left, right)
    return e.select(near, middle, end)


MACHINE_CODE = {"asin": asin, "acos": acos, "atan": atan, "atan2": atan2}
