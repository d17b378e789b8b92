"""sin, cos and tan in vectors: reduction to [−π/4, π/4] in two doubles, then polynomials.

Arguments up to `NEAR` are reduced with π/2 in three pieces, whose products with the quadrant are exact (Cody and Waite);
beyond, the function of `far_reduction` is called. Sines, cosines and tangents that are wanted at the same place are made
`together`: one branch to the slow reduction for all of them, and scalar arguments side by side in vectors.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from dirax.engines.native.functions import coefficients as c
from dirax.engines.native.functions.far_reduction import FAR_NAME, NEAR
from dirax.engines.native.functions.powers_of_two import MAGIC
from dirax.engines.native.ir.emitter import Body, Emitter


@dataclass(frozen=True)
class Reduced:
    """x = quadrant·π/2 + high + low; only the two lowest bits of the quadrant count."""

    high: str
    low: str
    quadrant: str


def reduce_near(e: Emitter, x: str) -> Reduced:
    shifted = e.add(e.mul(x, e.const(0.6366197723675814)), e.const(MAGIC))
    n = e.sub(shifted, e.const(MAGIC))
    p1, p2, p3 = (e.const(p) for p in c.HALF_PI)
    a = e.sub(x, e.mul(n, p1))
    b = e.mul(n, p2)
    high, low = e.two_sum(a, e.neg(b))
    low = e.sub(low, e.mul(n, p3))
    high, low = e.quick_two_sum(high, low)
    return Reduced(high, low, e.bits(shifted))


def is_far(e: Emitter, x: str) -> str:
    """Whether x is too large for `reduce_near`; infinities and NaN are not, they give NaN there."""
    size = e.abs(x)
    return e.both(e.compare("ogt", size, e.const(NEAR)), e.compare("olt", size, e.const(float("inf"))))


def sine_kernel(e: Emitter, r: Reduced) -> str:
    z = e.mul(r.high, r.high)
    tail = e.mul(e.mul(r.high, z), e.polynomial(c.SINE, z))
    slope = e.fma(z, e.const(-0.5), e.const(1.0))
    return e.add(r.high, e.fma(r.low, slope, tail))


def cosine_kernel(e: Emitter, r: Reduced) -> str:
    z = e.mul(r.high, r.high)
    half = e.mul(z, e.const(0.5))
    first = e.sub(e.const(1.0), half)
    lost = e.sub(e.sub(e.const(1.0), first), half)
    tail = e.mul(e.mul(z, z), e.polynomial(c.COSINE, z))
    return e.add(first, e.add(lost, e.sub(tail, e.mul(r.high, r.low))))


def of_quadrant(e: Emitter, quadrant: str, even: str, odd: str) -> str:
    """`even` or `odd` by the lowest bit, its sign by the next one."""
    swap = e.int_equal(e.ints("and", quadrant, e.integer(1)), e.integer(1))
    value = e.bits(e.select(swap, odd, even))
    sign = e.ints("shl", e.ints("and", quadrant, e.integer(2)), e.integer(62))
    return e.from_bits(e.ints("xor", value, sign))


def sine(e: Emitter, r: Reduced, s: str, co: str) -> str:
    """sin x from its reduction and the two kernels."""
    return of_quadrant(e, r.quadrant, s, co)


def cosine(e: Emitter, r: Reduced, s: str, co: str) -> str:
    return of_quadrant(e, e.ints("add", r.quadrant, e.integer(1)), s, co)


def tangent(e: Emitter, r: Reduced) -> str:
    """sin/cos of the reduced argument, both in two doubles."""
    z, z_low = e.two_product(r.high, r.high)
    z_low = e.add(z_low, e.mul(e.mul(r.high, r.low), e.const(2.0)))
    # sin r = r − r³/6 + …, cos r = 1 − r²/2 + …: the leading terms carry the rounding errors of z
    cube = e.mul(e.mul(r.high, z), e.polynomial(c.SINE, z))
    s, s_low = e.quick_two_sum(r.high, cube)
    s_low = e.add(s_low, e.mul(r.low, e.fma(z, e.const(-0.5), e.const(1.0))))
    half = e.mul(z, e.const(0.5))
    k, k_low = e.quick_two_sum(e.const(1.0), e.neg(half))
    quartic = e.mul(e.mul(z, z), e.polynomial(c.COSINE, z))
    k, more = e.quick_two_sum(k, quartic)
    k_low = e.add(e.sub(k_low, e.mul(z_low, e.const(0.5))), more)
    swap = e.int_equal(e.ints("and", r.quadrant, e.integer(1)), e.integer(1))
    top, top_low = e.select(swap, k, s), e.select(swap, k_low, s_low)
    bottom, bottom_low = e.select(swap, e.neg(s), k), e.select(swap, e.neg(s_low), k_low)
    t = e.div(top, bottom)
    error = e.sub(e.product_minus(t, bottom, top), e.sub(top_low, e.mul(t, bottom_low)))
    return e.sub(t, e.div(error, bottom))


def together(e: Emitter, wanted: Sequence[Collection[str]], values: Sequence[str]) -> list[dict[str, str]]:
    """By name, the functions wanted of each of the values; in scalar code the values share vectors."""
    packed, group = list(values), Emitter(e.body, _group_width(len(values))) if e.width == 1 and e.body.module.groups else e
    if group.width > e.width:
        padded = packed + packed[:1] * (-len(packed) % group.width)
        packed = [group.pack(padded[i : i + group.width]) for i in range(0, len(padded), group.width)]
    results: list[dict[str, str]] = [{} for _ in values]
    for i, r in enumerate(reduce_all(group, packed)):
        here = range(i * group.width, min((i + 1) * group.width, len(values))) if e.width == 1 else range(i, i + 1)
        needed = set().union(*(wanted[a] for a in here))
        s = sine_kernel(group, r) if needed & {"sin", "cos"} else ""
        co = cosine_kernel(group, r) if needed & {"sin", "cos"} else ""
        for name in sorted(needed):
            result = tangent(group, r) if name == "tan" else (sine if name == "sin" else cosine)(group, r, s, co)
            for lane, a in enumerate(here):
                if name in wanted[a]:
                    results[a][name] = group.extract(result, lane) if e.width == 1 else result
    return results


def _group_width(count: int) -> int:
    return 1 if count == 1 else 2 if count == 2 else 4 if count <= 4 else 8


def reduce_all(e: Emitter, values: list[str]) -> list[Reduced]:
    """The reductions of several arguments, with one branch for all of them to the slow way."""
    body: Body = e.body
    near = [reduce_near(e, x) for x in values]
    far = e.false
    for x in values:
        far = e.either(far, is_far(e, x))
    before, slow, join = body.block, body.fresh(), body.fresh()
    body.branch_if(e.any(far), slow, join)
    body.label(slow)
    count = len(values)
    columns = [values, *([getattr(r, part) for r in near] for part in ("high", "low", "quadrant"))]
    kinds = (e.real, e.real, e.real, e.int)
    memory = [body.alloca(kind, count) for kind in kinds]
    for kind, place, column in zip(kinds, memory, columns, strict=True):
        for i, value in enumerate(column):
            body.store(kind, value, body.at(kind, place, i))
    pointers = ", ".join(f"ptr {m}" for m in memory)
    body.line(f"call void @{FAR_NAME}({pointers}, i64 {count * e.width})")
    after = [
        [body.load(kind, body.at(kind, place, i)) for i in range(count)]
        for kind, place in zip(kinds[1:], memory[1:], strict=True)
    ]
    body.branch(join)
    body.label(join)
    merged = [
        [body.put(f"phi {kind} [ {old}, %{before} ], [ {new}, %{slow} ]") for old, new in zip(column, changed, strict=True)]
        for kind, column, changed in zip(kinds[1:], columns[1:], after, strict=True)
    ]
    return [Reduced(*parts) for parts in zip(*merged, strict=True)]


def _alone(name: str):
    return lambda e, x: together(e, [{name}], [x])[0][name]


MACHINE_CODE = {name: _alone(name) for name in ("sin", "cos", "tan")}
