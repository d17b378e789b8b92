"""The reduction of huge arguments of sine, cosine and tangent modulo π/2 (Payne and Hanek): a function in LLVM IR of its own.

It is called for the few arguments beyond `NEAR`, one entry at a time, and multiplies them by as many bits of 2/π as it takes.
"""

from dirax.engines.native.functions import coefficients as c
from dirax.engines.native.ir.emitter import Body, Emitter, Module

NEAR = 2.0**20
"""The size up to which three pieces of π/2 are enough."""

FAR_NAME = "far_reduction"


def add_far_reduction(module: Module, linkage: str = "internal ") -> None:
    """`far_reduction(x, high, low, quadrant, count)`: the same reduction for the entries of x beyond `NEAR`, in place.

    x = m·2^e with a whole m < 2^53. Of the product m·(2/π)·2^e the bits above the point modulo 4 are the quadrant and
    the 128 bits below are kept; 192 bits of 2/π, from the bit of weight 2^(1−e) on, are enough for both.
    """
    words = ", ".join(f"i64 {w - 2**64 if w >= 2**63 else w}" for w in c.TWO_OVER_PI)
    module.globals.append(f"@two_over_pi = internal constant [{len(c.TWO_OVER_PI)} x i64] [{words}]")
    body = Body(module)
    e = Emitter(body, 1)
    size = e.abs("%v")
    product, error = e.two_product("%h", e.const(c.PI_2[0]))
    head, tail = body.lines[:1], body.lines[1:]
    numbers = {"near": e.const(NEAR), "inf": e.const(float("inf")), "half_pi": e.const(c.PI_2[0])}
    numbers["half_pi_low"] = e.const(c.PI_2[1])
    module.functions.append(
        FAR_REDUCTION.format(
            linkage=linkage,
            name=FAR_NAME,
            n=len(c.TWO_OVER_PI),
            take_size="\n".join(head),
            size=size,
            multiply="\n".join(tail),
            product=product,
            error=error,
            **numbers,
        )
    )


FAR_REDUCTION = """
define {linkage}void @{name}(ptr %x, ptr %high, ptr %low, ptr %quadrant, i64 %count) noinline cold {{
entry:
  br label %loop
loop:
  %i = phi i64 [ 0, %entry ], [ %next, %continue ]
  %px = getelementptr double, ptr %x, i64 %i
  %v = load double, ptr %px, align 8
{take_size}
  %above = fcmp ogt double {size}, {near}
  %below = fcmp olt double {size}, {inf}
  %far = and i1 %above, %below
  br i1 %far, label %reduce, label %continue
reduce:
  %bits = bitcast double {size} to i64
  %biased = lshr i64 %bits, 52
  %fraction = and i64 %bits, 4503599627370495
  %m = or i64 %fraction, 4503599627370496
  %e = sub i64 %biased, 1075
  ; the bit of 2/pi with weight 2^-k is bit number k - 1 from the top; bits of weight 2^(1-e) and below matter
  %from = sub i64 %e, 2
  %negative = icmp slt i64 %from, 0
  %start = select i1 %negative, i64 0, i64 %from
  %shortage.raw = sub i64 0, %from
  %shortage = select i1 %negative, i64 %shortage.raw, i64 0
  %word = lshr i64 %start, 6
  %offset = and i64 %start, 63
  %p0 = getelementptr [{n} x i64], ptr @two_over_pi, i64 0, i64 %word
  %p1 = getelementptr i64, ptr %p0, i64 1
  %p2 = getelementptr i64, ptr %p0, i64 2
  %p3 = getelementptr i64, ptr %p0, i64 3
  %w0 = load i64, ptr %p0, align 8
  %w1 = load i64, ptr %p1, align 8
  %w2 = load i64, ptr %p2, align 8
  %w3 = load i64, ptr %p3, align 8
  %a0 = call i64 @llvm.fshl.i64(i64 %w0, i64 %w1, i64 %offset)
  %a1 = call i64 @llvm.fshl.i64(i64 %w1, i64 %w2, i64 %offset)
  %a2 = call i64 @llvm.fshl.i64(i64 %w2, i64 %w3, i64 %offset)
  ; a = a0 a1 a2 (192 bits) has its top bit at weight 2^(1-e) when nothing is short: m a / 2^192 * 2^2 is the product modulo 4
  %A0 = zext i64 %a0 to i256
  %A1 = zext i64 %a1 to i256
  %A2 = zext i64 %a2 to i256
  %s0 = shl i256 %A0, 128
  %s1 = shl i256 %A1, 64
  %sum0 = or i256 %s0, %s1
  %sum = or i256 %sum0, %A2
  %S = zext i64 %shortage to i256
  %aligned = lshr i256 %sum, %S
  %M = zext i64 %m to i256
  %product = mul i256 %aligned, %M
  ; modulo 2^192: two bits of quadrant, 190 bits of fraction
  %top = lshr i256 %product, 190
  %q.raw = trunc i256 %top to i64
  %rest = lshr i256 %product, 63
  %rest128 = trunc i256 %rest to i128
  ; rest128: bit 126 has weight 1/2, bit 127 is the low bit of the quadrant
  %shifted = shl i128 %rest128, 1
  %up = icmp slt i128 %shifted, 0
  %one = zext i1 %up to i64
  %q.up = add i64 %q.raw, %one
  ; as a signed number of 128 bits, shifted / 2^128 is the fraction in [-1/2, 1/2)
  %sign = fcmp olt double %v, 0.0
  %reversed = sub i128 0, %shifted
  %f = select i1 %sign, i128 %reversed, i128 %shifted
  %q.minus = sub i64 0, %q.up
  %q = select i1 %sign, i64 %q.minus, i64 %q.up
  %f.high = ashr i128 %f, 64
  %fh = trunc i128 %f.high to i64
  %leading.sign = ashr i128 %f, 127
  %magnitude.x = xor i128 %f, %leading.sign
  %magnitude = sub i128 %magnitude.x, %leading.sign
  %zeros = call i128 @llvm.ctlz.i128(i128 %magnitude, i1 false)
  %normal = shl i128 %magnitude, %zeros
  ; the two leading pieces of 53 bits of the fraction, exactly
  %h.int128 = lshr i128 %normal, 75
  %h.int = trunc i128 %h.int128 to i64
  %l.int128.0 = shl i128 %normal, 53
  %l.int128 = lshr i128 %l.int128.0, 75
  %l.int = trunc i128 %l.int128 to i64
  %h.double = uitofp i64 %h.int to double
  %l.double = uitofp i64 %l.int to double
  %z64 = trunc i128 %zeros to i64
  ; scale 2^(-53 - zeros): fraction = h.int 2^(75 - 128 - zeros)
  %hexp = sub i64 970, %z64
  %hscale.bits = shl i64 %hexp, 52
  %hscale = bitcast i64 %hscale.bits to double
  %lexp = sub i64 917, %z64
  %lscale.bits = shl i64 %lexp, 52
  %lscale = bitcast i64 %lscale.bits to double
  %h.size = fmul double %h.double, %hscale
  %l.size = fmul double %l.double, %lscale
  %minus = icmp slt i128 %f, 0
  %h.minus = fneg double %h.size
  %l.minus = fneg double %l.size
  %h = select i1 %minus, double %h.minus, double %h.size
  %l = select i1 %minus, double %l.minus, double %l.size
  ; times pi/2 in two doubles
{multiply}
  %r.low.0 = fmul double %h, {half_pi_low}
  %r.low.1 = fmul double %l, {half_pi}
  %r.low.2 = fadd double %r.low.0, %r.low.1
  %r.low = fadd double {error}, %r.low.2
  %ph = getelementptr double, ptr %high, i64 %i
  %pl = getelementptr double, ptr %low, i64 %i
  %pq = getelementptr i64, ptr %quadrant, i64 %i
  store double {product}, ptr %ph, align 8
  store double %r.low, ptr %pl, align 8
  store i64 %q, ptr %pq, align 8
  br label %continue
continue:
  %next = add i64 %i, 1
  %more = icmp slt i64 %next, %count
  br i1 %more, label %loop, label %done
done:
  ret void
}}
declare i64 @llvm.fshl.i64(i64, i64, i64)
declare i128 @llvm.ctlz.i128(i128, i1)
"""
