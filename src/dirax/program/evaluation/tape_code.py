"""The two compiled loops of tapes, over a table of operations on numbers and over one of operations on rows of numbers."""

import ctypes
import functools
import importlib.util
import re
from typing import Any

LANES = 8
"""Entries that a loop computes side by side."""

_DOUBLES = f"<{LANES} x double>"
_TRUTHS = f"<{LANES} x i1>"
_ONE, _ZERO, _INFINITY = "splat (double 1.0)", "zeroinitializer", "splat (double 0x7FF0000000000000)"
_TRUTH = f"%r = select {_TRUTHS} %c, {_DOUBLES} {_ONE}, {_DOUBLES} {_ZERO}"
_BOTH = [f"%d = fcmp une {_DOUBLES} %x, {_ZERO}", f"%e = fcmp une {_DOUBLES} %y, {_ZERO}"]
_CHOICE = [f"%c = fcmp une {_DOUBLES} %x, {_ZERO}", f"%r = select {_TRUTHS} %c, {_DOUBLES} %y, {_DOUBLES} %z"]

CODE: dict[str, list[str]] = {
    **{name: [f"%r = f{name} {_DOUBLES} %x, %y"] for name in ("add", "sub", "mul")},
    "neg": [f"%r = fneg {_DOUBLES} %x"],
    "recip": [f"%r = fdiv {_DOUBLES} {_ONE}, %x"],
    "abs": [f"%r = call {_DOUBLES} @llvm.fabs.v{LANES}f64({_DOUBLES} %x)"],
    "sqrt": [f"%r = call {_DOUBLES} @llvm.sqrt.v{LANES}f64({_DOUBLES} %x)"],
    **{
        name: [f"%c = fcmp {how} {_DOUBLES} %x, %y", _TRUTH]
        for name, how in (("lt", "olt"), ("le", "ole"), ("eq", "oeq"), ("ne", "une"))
    },
    "finite": [
        f"%s = call {_DOUBLES} @llvm.fabs.v{LANES}f64({_DOUBLES} %x)",
        f"%c = fcmp olt {_DOUBLES} %s, {_INFINITY}",
        _TRUTH,
    ],
    **{name: [*_BOTH, f"%c = {name} {_TRUTHS} %d, %e", _TRUTH] for name in ("and", "or")},
    "not": [f"%c = fcmp oeq {_DOUBLES} %x, {_ZERO}", _TRUTH],
    "select": _CHOICE,
}
"""The instructions of an operation of x, y and z whose result is r; truth values are 1.0 and 0.0."""

ROW_CODE = {
    "product": [f"%r = fmul {_DOUBLES} %f, %x"],
    "more": [f"%m = fmul {_DOUBLES} %f, %x", f"%r = fadd {_DOUBLES} %o, %m"],
    "choice": [f"%c = fcmp une {_DOUBLES} %f, {_ZERO}", f"%r = select {_TRUTHS} %c, {_DOUBLES} %x, {_DOUBLES} %y"],
}
"""The same of an operation on rows x and y with a factor f, where the row o was."""

NUMBER = {name: k for k, name in enumerate((*CODE, *ROW_CODE))}


@functools.cache
def compiles() -> bool:
    """Whether LLVM is installed, which compiles the loops; where it is not, NumPy computes what they would."""
    try:
        return importlib.util.find_spec("llvmlite") is not None
    except ImportError:
        return False


@functools.cache
def loops() -> tuple[Any, Any]:
    """`numbers(table, count, values, first, blocks, slots)`: operations (number, x, y, z) whose results follow one another from
    slot `first` on, in every block of values; and `rows(table, count, values, rows, columns)`: operations (number, row, x, y, f)
    on rows of one block, with factors among its values."""
    from dirax.program import machine_code  # LLVM is imported when it is used

    library = machine_code.load(machine_code.object_code(_numbers() + _rows()), ("numbers", "rows"))
    pointer, whole = ctypes.c_void_p, ctypes.c_int64
    numbers = machine_code.function(library, "numbers", ctypes.CFUNCTYPE(None, pointer, whole, pointer, whole, whole, whole))
    return numbers, machine_code.function(library, "rows", ctypes.CFUNCTYPE(None, pointer, whole, pointer, pointer, whole))


def _numbers() -> str:
    return f"""
declare {_DOUBLES} @llvm.fabs.v{LANES}f64({_DOUBLES})
declare {_DOUBLES} @llvm.sqrt.v{LANES}f64({_DOUBLES})
define void @numbers(ptr %table, i64 %count, ptr %values, i64 %first, i64 %blocks, i64 %slots) {{
entry:
  br label %block
block:
  %k = phi i64 [0, %entry], [%k.next, %after]
  %offset = mul i64 %k, %slots
  %v = getelementptr {_DOUBLES}, ptr %values, i64 %offset
  br label %head
head:
  %i = phi i64 [0, %block], [%i.next, %tail]
  %more = icmp slt i64 %i, %count
  br i1 %more, label %body, label %after
body:
  %entry.at = getelementptr [4 x i32], ptr %table, i64 %i
  %number = load i32, ptr %entry.at
{_operand("x", 1)}{_operand("y", 2)}{_operand("z", 3)}
  %to = add i64 %first, %i
  %r.at = getelementptr {_DOUBLES}, ptr %v, i64 %to
{_cases(CODE)}
tail:
  %i.next = add i64 %i, 1
  br label %head
after:
  %k.next = add i64 %k, 1
  %again = icmp slt i64 %k.next, %blocks
  br i1 %again, label %block, label %done
done:
  ret void
}}
"""


def _rows() -> str:
    row = lambda name, place: (
        f"""
  %{name}.of = getelementptr i32, ptr %entry.at, i64 {place}
  %{name}.row = load i32, ptr %{name}.of
  %{name}.wide = sext i32 %{name}.row to i64
  %{name}.first = mul i64 %{name}.wide, %columns"""
    )
    column = lambda name: (
        f"""
  %{name}.slot = add i64 %{name}.first, %j
  %{name}.at = getelementptr {_DOUBLES}, ptr %rows, i64 %{name}.slot
  %{name} = load {_DOUBLES}, ptr %{name}.at, align 8"""
    )
    return f"""
define void @rows(ptr %table, i64 %count, ptr %v, ptr %rows, i64 %columns) {{
entry:
  br label %head
head:
  %i = phi i64 [0, %entry], [%i.next, %after]
  %more = icmp slt i64 %i, %count
  br i1 %more, label %body, label %done
body:
  %entry.at = getelementptr [5 x i32], ptr %table, i64 %i
  %number = load i32, ptr %entry.at{row("o", 1)}{row("x", 2)}{row("y", 3)}
{_operand("f", 4)}
  br label %column
column:
  %j = phi i64 [0, %body], [%j.next, %tail]{column("o")}{column("x")}{column("y")}
  %r.at = getelementptr {_DOUBLES}, ptr %o.at, i64 0
{_cases(ROW_CODE)}
tail:
  %j.next = add i64 %j, 1
  %wide = icmp slt i64 %j.next, %columns
  br i1 %wide, label %column, label %after
after:
  %i.next = add i64 %i, 1
  br label %head
done:
  ret void
}}
"""


def _operand(name: str, place: int) -> str:
    return f"""
  %{name}.of = getelementptr i32, ptr %entry.at, i64 {place}
  %{name}.slot = load i32, ptr %{name}.of
  %{name}.wide = sext i32 %{name}.slot to i64
  %{name}.at = getelementptr {_DOUBLES}, ptr %v, i64 %{name}.wide
  %{name} = load {_DOUBLES}, ptr %{name}.at, align 8"""


def _cases(code: dict[str, list[str]]) -> str:
    """The choice of the operation by its number, and the code of each, with names of its own."""
    lines = ["  switch i32 %number, label %none [", *(f"    i32 {NUMBER[name]}, label %do.{name}" for name in code), "  ]"]
    lines += ["none:", "  unreachable"]
    for name, body in code.items():
        own = [re.sub(r"%([rcdesm])\b", rf"%\1.{name}", line) for line in body]
        lines += [f"do.{name}:", *(f"  {line}" for line in own)]
        lines += [f"  store {_DOUBLES} %r.{name}, ptr %r.at, align 8", "  br label %tail"]
    return "\n".join(lines)
