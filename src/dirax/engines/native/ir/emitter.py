"""Writes LLVM IR text for scalars or vectors of `width` lanes: the same sequence of roundings whatever the width."""

import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

LONG = 1000
"""Lines of a block after which straight code goes on in another one: LLVM takes a time that grows with the square of a block's
length where code is to be ready soon."""


class Module:
    """A module under construction: its functions and the intrinsics that they declare.

    `groups`: whether functions of several scalars may be found side by side in a vector, which changes no bit.
    """

    def __init__(self, fma: bool, groups: bool = True):
        self.fma, self.groups = fma, groups
        self.functions: list[str] = []
        self.globals: list[str] = []
        self.declared: set[str] = set()

    def define(self, head: str, body: "Body") -> None:
        """Add a function: its head without braces, its body ending in a terminator."""
        self.functions.append("\n".join([head + " {", "entry:", *body.entry, *body.lines, "}"]))

    def text(self) -> str:
        return "\n".join([*self.globals, *sorted(self.declared), *self.functions, ""])


class Body:
    """The lines of one function, with fresh names."""

    def __init__(self, module: Module):
        self.module, self.lines, self._count = module, [], 0
        self.entry: list[str] = []
        self.block, self._began = "entry", 0

    def fresh(self) -> str:
        self._count += 1
        return f"v{self._count}"

    def line(self, text: str) -> None:
        self.lines.append("  " + text)

    def put(self, text: str) -> str:
        name = "%" + self.fresh()
        self.line(f"{name} = {text}")
        return name

    def label(self, name: str) -> None:
        """Begin a block, to which `block` then points."""
        self.lines.append(f"{name}:")
        self.block, self._began = name, len(self.lines)

    def go_on(self) -> None:
        """Begin another block if this one is LONG, between two instructions of straight code."""
        if len(self.lines) - self._began > LONG:
            following = self.fresh()
            self.branch(following)
            self.label(following)

    def branch(self, target: str) -> None:
        self.line(f"br label %{target}")

    def branch_if(self, condition: str, yes: str, no: str) -> None:
        self.line(f"br i1 {condition}, label %{yes}, label %{no}")

    @contextmanager
    def loop(self, start: int | str, stop: int | str) -> Iterator[str]:
        """A loop over whole numbers from start to stop − 1; gives the number."""
        counter, head, inside, out = self.alloca("i64"), self.fresh(), self.fresh(), self.fresh()
        self.store("i64", str(start), counter)
        self.branch(head)
        self.label(head)
        index = self.load("i64", counter)
        self.branch_if(self.put(f"icmp slt i64 {index}, {stop}"), inside, out)
        self.label(inside)
        yield index
        self.store("i64", self.put(f"add i64 {index}, 1"), counter)
        self.branch(head)
        self.label(out)

    @contextmanager
    def when(self, condition: str) -> Iterator[None]:
        """A block that runs only if the condition holds."""
        inside, out = self.fresh(), self.fresh()
        self.branch_if(condition, inside, out)
        self.label(inside)
        yield
        self.branch(out)
        self.label(out)

    def alloca(self, kind: str, count: int = 1) -> str:
        """Memory of the function's frame, reserved in its entry block."""
        name = "%" + self.fresh()
        self.entry.append(f"  {name} = alloca {kind}, i64 {count}, align 64")
        return name

    def at(self, kind: str, pointer: str, index: int | str) -> str:
        return self.put(f"getelementptr inbounds {kind}, ptr {pointer}, i64 {index}")

    def load(self, kind: str, pointer: str, align: int = 8) -> str:
        return self.put(f"load {kind}, ptr {pointer}, align {align}")

    def store(self, kind: str, value: str, pointer: str, align: int = 8) -> None:
        self.line(f"store {kind} {value}, ptr {pointer}, align {align}")


class Emitter:
    """Arithmetic on values of one width; a value is its name or literal in the text, its type follows from its use."""

    def __init__(self, body: Body, width: int):
        self.body, self.width, self.fma_available = body, width, body.module.fma
        self.real = "double" if width == 1 else f"<{width} x double>"
        self.int = "i64" if width == 1 else f"<{width} x i64>"
        self.bool = "i1" if width == 1 else f"<{width} x i1>"
        self.suffix = "f64" if width == 1 else f"v{width}f64"
        self.true, self.false = self._splat("i1", "true"), self._splat("i1", "false")

    # ------------------------------------------------------------------ constants and conversions

    def _splat(self, kind: str, text: str) -> str:
        return text if self.width == 1 else f"splat ({kind} {text})"

    def const(self, value: float) -> str:
        bits = struct.unpack("<Q", struct.pack("<d", value))[0]
        return self._splat("double", f"0x{bits:016X}")

    def integer(self, value: int) -> str:
        return self._splat("i64", str(value))

    def boolean(self, value: bool) -> str:
        return self.true if value else self.false

    def splat(self, scalar: str) -> str:
        """A scalar double in every lane."""
        if self.width == 1:
            return scalar
        first = self.body.put(f"insertelement {self.real} poison, double {scalar}, i64 0")
        return self.body.put(f"shufflevector {self.real} {first}, {self.real} poison, <{self.width} x i32> zeroinitializer")

    def bits(self, a: str) -> str:
        return self.body.put(f"bitcast {self.real} {a} to {self.int}")

    def from_bits(self, i: str) -> str:
        return self.body.put(f"bitcast {self.int} {i} to {self.real}")

    def extract(self, a: str, lane: int, kind: str | None = None) -> str:
        return a if self.width == 1 else self.body.put(f"extractelement {kind or self.real} {a}, i64 {lane}")

    def pack(self, scalars: Sequence[str]) -> str:
        """A value of this width from scalar doubles."""
        if self.width == 1:
            return scalars[0]
        value = "poison"
        for lane, scalar in enumerate(scalars):
            value = self.body.put(f"insertelement {self.real} {value}, double {scalar}, i64 {lane}")
        return value

    def any(self, condition: str) -> str:
        """Whether a condition holds in one lane at least."""
        return condition if self.width == 1 else self._reduce("or", condition)

    def all(self, condition: str) -> str:
        return condition if self.width == 1 else self._reduce("and", condition)

    def _reduce(self, how: str, condition: str) -> str:
        name = f"llvm.vector.reduce.{how}.v{self.width}i1"
        self.body.module.declared.add(f"declare i1 @{name}({self.bool})")
        return self.body.put(f"call i1 @{name}({self.bool} {condition})")

    # ------------------------------------------------------------------ arithmetic

    def add(self, a: str, b: str) -> str:
        return self.body.put(f"fadd {self.real} {a}, {b}")

    def sub(self, a: str, b: str) -> str:
        return self.body.put(f"fsub {self.real} {a}, {b}")

    def mul(self, a: str, b: str) -> str:
        return self.body.put(f"fmul {self.real} {a}, {b}")

    def div(self, a: str, b: str) -> str:
        return self.body.put(f"fdiv {self.real} {a}, {b}")

    def neg(self, a: str) -> str:
        return self.body.put(f"fneg {self.real} {a}")

    def intrinsic(self, name: str, *args: str) -> str:
        full = f"llvm.{name}.{self.suffix}"
        self.body.module.declared.add(f"declare {self.real} @{full}({', '.join([self.real] * len(args))})")
        return self.body.put(f"call {self.real} @{full}({', '.join(f'{self.real} {a}' for a in args)})")

    def fma(self, a: str, b: str, c: str) -> str:
        """a b + c, rounded once where the processor can, else twice."""
        return self.intrinsic("fma", a, b, c) if self.fma_available else self.add(self.mul(a, b), c)

    def abs(self, a: str) -> str:
        return self.intrinsic("fabs", a)

    def sqrt(self, a: str) -> str:
        return self.intrinsic("sqrt", a)

    def copysign(self, size: str, sign: str) -> str:
        return self.intrinsic("copysign", size, sign)

    def rem(self, a: str, b: str) -> str:
        return self.body.put(f"frem {self.real} {a}, {b}")

    def compare(self, predicate: str, a: str, b: str) -> str:
        return self.body.put(f"fcmp {predicate} {self.real} {a}, {b}")

    def select(self, condition: str, yes: str, no: str) -> str:
        return self.body.put(f"select {self.bool} {condition}, {self.real} {yes}, {self.real} {no}")

    def max(self, a: str, b: str) -> str:
        return self.select(self.compare("ogt", a, b), a, b)

    def both(self, a: str, b: str) -> str:
        return self.body.put(f"and {self.bool} {a}, {b}")

    def either(self, a: str, b: str) -> str:
        return self.body.put(f"or {self.bool} {a}, {b}")

    def invert(self, a: str) -> str:
        return self.body.put(f"xor {self.bool} {a}, {self.true}")

    def ints(self, op: str, a: str, b: str) -> str:
        return self.body.put(f"{op} {self.int} {a}, {b}")

    def int_equal(self, a: str, b: str) -> str:
        return self.body.put(f"icmp eq {self.int} {a}, {b}")

    # ------------------------------------------------------------------ sums and products without error

    def two_sum(self, a: str, b: str) -> tuple[str, str]:
        """(s, e) with s + e = a + b exactly (Knuth)."""
        s = self.add(a, b)
        back = self.sub(s, a)
        return s, self.add(self.sub(a, self.sub(s, back)), self.sub(b, back))

    def quick_two_sum(self, a: str, b: str) -> tuple[str, str]:
        """The same for |a| ≥ |b| (Dekker)."""
        s = self.add(a, b)
        return s, self.sub(b, self.sub(s, a))

    def two_product(self, a: str, b: str) -> tuple[str, str]:
        """(p, e) with p + e = a b exactly."""
        p = self.mul(a, b)
        if self.fma_available:
            return p, self.fma(a, b, self.neg(p))
        (ah, al), (bh, bl) = self._split(a), self._split(b)
        e = self.sub(self.mul(ah, bh), p)
        e = self.add(self.add(e, self.mul(ah, bl)), self.mul(al, bh))
        return p, self.add(e, self.mul(al, bl))

    def _split(self, a: str) -> tuple[str, str]:
        c = self.mul(self.const(134217729.0), a)
        high = self.sub(c, self.sub(c, a))
        return high, self.sub(a, high)

    def product_minus(self, a: str, b: str, c: str) -> str:
        """a b − c with the product exact: the remainder of a division or a root."""
        p, e = self.two_product(a, b)
        return self.add(self.sub(p, c), e)

    def quotient(self, a: str, b: str) -> tuple[str, str]:
        """a/b as a sum of two doubles."""
        q = self.div(a, b)
        return q, self.neg(self.div(self.product_minus(q, b, a), b))

    def polynomial(self, coefficients: Sequence[float], x: str) -> str:
        """Even and odd parts side by side (Estrin's first level): half the latency of Horner's rule."""
        if len(coefficients) < 6:
            return self.horner(coefficients, x)
        square = self.mul(x, x)
        even, odd = self.horner(coefficients[0::2], square), self.horner(coefficients[1::2], square)
        return self.fma(odd, x, even)

    def horner(self, coefficients: Sequence[float], x: str) -> str:
        total = self.const(coefficients[-1])
        for c in reversed(coefficients[:-1]):
            total = self.fma(total, x, self.const(c))
        return total
