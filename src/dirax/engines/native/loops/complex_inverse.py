"""Inverses of complex matrices at run time, and their products with vectors, in IR: rows in vectors."""

from collections.abc import Iterator
from contextlib import contextmanager

from dirax.engines.native.ir.emitter import Body, Emitter, Module

WIDE = 8
"""Entries of a row that are computed side by side."""


def padded(n: int) -> int:
    """The length of a row of so many entries in memory."""
    return -(-n // WIDE) * WIDE


def add_complex_inverse(module: Module, n: int) -> None:
    """`complex_inverse(re, im)`: (n, 2·padded) doubles each, the matrix in the left half and its inverse, in the right half, by
    Gauss and Jordan with partial pivoting. `complex_product(re, im, x, y, u, v)`: (u + iv)_k = Σ_j (x + iy)_j inverse_jk."""
    _define_inverse(module, n)
    _define_product(module, n)


def _define_inverse(module: Module, n: int) -> None:
    b = Body(module)
    one, wide, width = Emitter(b, 1), Emitter(b, WIDE), 2 * padded(n)
    parts = "%re", "%im"

    def row(base: str, i: int | str) -> str:
        return b.at("double", base, b.put(f"mul i64 {i}, {width}"))

    @contextmanager
    def blocks(first: str) -> Iterator[str]:
        """Blocks of a row from the one with entry `first` on."""
        with b.loop(b.put(f"lshr i64 {first}, 3"), width // WIDE) as block:
            yield b.put(f"shl i64 {block}, 3")

    def size(i: int | str, c: str) -> str:
        return one.add(*(one.abs(b.load("double", b.at("double", row(base, i), c))) for base in parts))

    with b.loop(0, n) as i:
        for base in parts:
            with b.loop(padded(n), width) as j:
                b.store("double", one.const(0.0), b.at("double", row(base, i), j))
        diagonal = b.put(f"add i64 {i}, {padded(n)}")
        b.store("double", one.const(1.0), b.at("double", row("%re", i), diagonal))
    best, chosen = b.alloca("double"), b.alloca("i64")
    with b.loop(0, n) as c:
        b.store("double", size(c, c), best)
        b.store("i64", c, chosen)
        with b.loop(b.put(f"add i64 {c}, 1"), n) as i:
            here = size(i, c)
            with b.when(one.compare("ogt", here, b.load("double", best))):
                b.store("double", here, best)
                b.store("i64", i, chosen)
        pivot = b.load("i64", chosen)
        re, im = (b.load("double", b.at("double", row(base, pivot), c)) for base in parts)
        norm = one.fma(re, re, one.mul(im, im))
        re, im = wide.splat(one.div(re, norm)), wide.splat(one.neg(one.div(im, norm)))
        with blocks(c) as j:
            own, others = ([b.at("double", row(base, i), j) for base in parts] for i in (c, pivot))
            (a, d), (x, y) = ([b.load(wide.real, place) for place in places] for places in (own, others))
            b.store(wide.real, a, others[0])
            b.store(wide.real, d, others[1])
            b.store(wide.real, wide.fma(x, re, wide.neg(wide.mul(y, im))), own[0])
            b.store(wide.real, wide.fma(x, im, wide.mul(y, re)), own[1])
        with b.loop(0, n) as i, b.when(b.put(f"icmp ne i64 {i}, {c}")):
            re, im = (wide.splat(one.neg(b.load("double", b.at("double", row(base, i), c)))) for base in parts)
            with blocks(c) as j:
                own, others = ([b.at("double", row(base, k), j) for base in parts] for k in (i, c))
                (a, d), (x, y) = ([b.load(wide.real, place) for place in places] for places in (own, others))
                b.store(wide.real, wide.fma(wide.neg(y), im, wide.fma(x, re, a)), own[0])
                b.store(wide.real, wide.fma(y, re, wide.fma(x, im, d)), own[1])
    b.line("ret void")
    module.define("define internal void @complex_inverse(ptr noalias %re, ptr noalias %im) noinline", b)


def _define_product(module: Module, n: int) -> None:
    b = Body(module)
    wide, width = Emitter(b, WIDE), 2 * padded(n)
    total = [b.alloca(wide.real) for _ in range(2)]
    with b.loop(0, padded(n) // WIDE) as block:
        first = b.put(f"shl i64 {block}, 3")
        for part in total:
            b.store(wide.real, wide.const(0.0), part)
        with b.loop(0, n) as j:
            place = b.put(f"add i64 {b.put(f'mul i64 {j}, {width}')}, {b.put(f'add i64 {first}, {padded(n)}')}")
            re, im = (b.load(wide.real, b.at("double", base, place)) for base in ("%re", "%im"))
            x, y = (wide.splat(b.load("double", b.at("double", base, j))) for base in ("%x", "%y"))
            u, v = (b.load(wide.real, part) for part in total)
            b.store(wide.real, wide.fma(wide.neg(y), im, wide.fma(x, re, u)), total[0])
            b.store(wide.real, wide.fma(y, re, wide.fma(x, im, v)), total[1])
        for part, out in zip(total, ("%u", "%v"), strict=True):
            b.store(wide.real, b.load(wide.real, part), b.at("double", out, first))
    b.line("ret void")
    pointers = ", ".join(f"ptr noalias %{name}" for name in ("re", "im", "x", "y", "u", "v"))
    module.define(f"define internal void @complex_product({pointers}) noinline", b)
