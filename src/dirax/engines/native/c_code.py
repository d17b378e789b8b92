"""A kernel's LLVM IR as C: one statement an instruction, so that the C does what the kernel does, rounding for rounding."""

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field

from dirax.engines.native.functions import coefficients as c
from dirax.engines.native.functions.far_reduction import FAR_NAME, NEAR
from dirax.program.interpreter import UnsupportedPrimitive

TYPES = {"double": "double", "i64": "int64_t", "i1": "unsigned char", "i8": "char", "ptr": "void *", "void": "void"}
INTRINSICS = {
    **{"fabs": "fabs", "fma": "fma", "sqrt": "sqrt", "copysign": "copysign", "floor": "floor", "ceil": "ceil"},
    **{"trunc": "trunc", "roundeven": "roundeven_", "rint": "rint"},
}
ARITHMETIC = {"fadd": "+", "fsub": "-", "fmul": "*", "fdiv": "/"}
WHOLE = {"add": "+", "sub": "-", "mul": "*", "and": "&", "or": "|", "xor": "^", "shl": "<<", "lshr": ">>"}
SIGNED = {"sdiv": "/", "srem": "%", "ashr": ">>"}
ORDERED = {"oeq": "==", "olt": "<", "ole": "<=", "ogt": ">", "oge": ">=", "une": "!="}
UNORDERED = {"ult": ">=", "ule": ">", "ugt": "<=", "uge": "<"}
COMPARED = {"eq": "==", "ne": "!=", "slt": "<", "sle": "<=", "sgt": ">", "sge": ">="}

HELPERS = """\
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#if defined(__GNUC__)
#pragma GCC diagnostic ignored "-Wunused-but-set-variable"
#pragma GCC diagnostic ignored "-Wunused-function"
#endif

static double of_bits(int64_t i) { double x; memcpy(&x, &i, 8); return x; }
static int64_t bits_of(double x) { int64_t i; memcpy(&i, &x, 8); return i; }
static double roundeven_(double x) {
    double r = round(x);
    return fabs(x - trunc(x)) == 0.5 ? 2.0 * round(x / 2.0) : r;
}
"""

FAR_REDUCTION = """\
static const uint64_t two_over_pi[] = {{{words}}};

/* arguments of sine and cosine beyond 2^20 modulo pi/2 (Payne and Hanek) */
static void {name}(void *px, void *phigh, void *plow, void *pquadrant, int64_t count) {{
    for (int64_t i = 0; i < count; i++) {{
        double v = ((double *)px)[i];
        if (!(fabs(v) > {near} && fabs(v) < INFINITY)) continue;
        uint64_t bits = (uint64_t)bits_of(fabs(v)), m = (bits & 4503599627370495u) | 4503599627370496u;
        int64_t from = (int64_t)(bits >> 52) - 1077, start = from < 0 ? 0 : from, shortage = from < 0 ? -from : 0;
        const uint64_t *w = two_over_pi + (start >> 6);
        int s = (int)(start & 63), k = (int)shortage;
        uint64_t a[3], r[4];
        for (int j = 0; j < 3; j++) a[j] = s ? w[j] << s | w[j + 1] >> (64 - s) : w[j];
        if (k) {{ a[2] = a[2] >> k | a[1] << (64 - k); a[1] = a[1] >> k | a[0] << (64 - k); a[0] >>= k; }}
        unsigned __int128 p = (unsigned __int128)a[2] * m;
        r[0] = (uint64_t)p; p = (p >> 64) + (unsigned __int128)a[1] * m;
        r[1] = (uint64_t)p; p = (p >> 64) + (unsigned __int128)a[0] * m;
        r[2] = (uint64_t)p; r[3] = (uint64_t)(p >> 64);
        uint64_t raw = r[2] >> 62 | r[3] << 2;
        unsigned __int128 rest = (unsigned __int128)(r[1] >> 63 | r[2] << 1) << 64 | (r[0] >> 63 | r[1] << 1);
        unsigned __int128 f = rest << 1;
        uint64_t q = raw + (uint64_t)(f >> 127);
        if (v < 0.0) {{ f = -f; q = -q; }}
        int minus = (int)(f >> 127), zeros = 0;
        unsigned __int128 size = minus ? -f : f;
        if (!size) zeros = 128;
        else while (!(size >> 127)) {{ size <<= 1; zeros++; }}
        double h = (double)(uint64_t)(size >> 75) * of_bits((int64_t)(970 - zeros) << 52);
        double l = (double)(uint64_t)((size << 53) >> 75) * of_bits((int64_t)(917 - zeros) << 52);
        if (minus) {{ h = -h; l = -l; }}
        double high = h * {half_pi}, error = fma(h, {half_pi}, -high);
        ((double *)phigh)[i] = high;
        ((double *)plow)[i] = error + (h * {half_pi_low} + l * {half_pi});
        ((int64_t *)pquadrant)[i] = (int64_t)q;
    }}
}}
"""

TABLE = re.compile(r"@(\w+) = internal constant \[(\d+) x (\w+)\] \[(.*)\]")
HEAD = re.compile(r"define (?:internal )?(\w+) @(\w+)\((.*?)\)[^{]*\{")
PHI = re.compile(r"\[ (\S+), %(\S+) \]")


@dataclass
class _Function:
    """One function under translation."""

    head: str
    own: dict[str, str] = field(default_factory=dict)
    """The type of every value."""
    memory: list[str] = field(default_factory=list)
    lines: list[str] = field(default_factory=list)
    phis: dict[str, list[tuple[str, str]]] = field(default_factory=dict)
    """Block → what is to be given on at its end: (variable, value)."""

    def text(self) -> str:
        values: dict[str, list[str]] = {}
        for name, kind in self.own.items():
            values.setdefault(kind, []).append(name)
        star = lambda kind, name: f"*{name}" if kind == "void *" else name
        declared = [
            f"    {kind.removesuffix(' *')} {', '.join(star(kind, name) for name in names[i : i + 12])};"
            for kind, names in values.items()
            for i in range(0, len(names), 12)
        ]
        return "\n".join([self.head, *declared, *self.memory, *self.lines, "}", ""])


def c_code(module: str) -> str:
    """The functions of a module as C, static all of them. Raises `UnsupportedPrimitive` for vectors of lanes."""
    parts, function, block = [HELPERS], None, ""
    phis: dict[str, list[tuple[str, str, str]]] = {}
    for line in _lines(module):
        if (table := TABLE.match(line)) and table[1] != "two_over_pi":
            values = ", ".join(_value(entry.split()[1], table[3]) for entry in table[4].split(","))
            parts.append(f"static {_type(table[3])} v_{table[1]}[{table[2]}] = {{{values}}};")
        elif found := HEAD.match(line):
            name = found[2]
            if name == FAR_NAME:
                function = None
                parts.append(_far_reduction())
                continue
            arguments = [part.split() for part in found[3].split(",")]
            listed = ", ".join(f"{TYPES[a[0]]} {_name(a[-1])}".replace("* ", "*") for a in arguments)
            function, block = _Function(f"static {TYPES[found[1]]} {name}({listed}) {{"), "entry"
            phis = _phis(module, name)
        elif line == "}" and function is not None:
            parts.append(function.text())
            function = None
        elif function is None or line.startswith("declare") or line.startswith("@"):
            continue
        elif line.endswith(":"):
            block = line[:-1]
            if block != "entry":  # to which nothing jumps
                function.lines.append(f"{_label(block)}: ;")
        else:
            _statement(function, line, block, phis)
    return "\n".join(parts)


def _no_c(what: str) -> UnsupportedPrimitive:
    return UnsupportedPrimitive(what, "is in the kernel and has no translation to C", "dirax/engines/native/c_code.py")


def _lines(module: str) -> Iterator[str]:
    for line in module.splitlines():
        stripped = line.split(";")[0].strip()
        if stripped:
            yield stripped


def _phis(module: str, name: str) -> dict[str, list[tuple[str, str, str]]]:
    """Of one function: block → the (variable, type, value) that it gives on."""
    found: dict[str, list[tuple[str, str, str]]] = {}
    inside = False
    for line in _lines(module):
        if head := HEAD.match(line):
            inside = head[2] == name
        elif inside and " = phi " in line:
            variable, rest = line.split(" = phi ")
            for value, before in PHI.findall(rest):
                found.setdefault(before, []).append((_name(variable), rest.split()[0], value))
    return found


def _far_reduction() -> str:
    words = ", ".join(f"{w}u" for w in c.TWO_OVER_PI)
    numbers = {"near": float(NEAR).hex(), "half_pi": float(c.PI_2[0]).hex(), "half_pi_low": float(c.PI_2[1]).hex()}
    return FAR_REDUCTION.format(words=words, name=FAR_NAME, **numbers)


def _name(value: str) -> str:
    return "v_" + value.lstrip("%@").replace(".", "_")


def _label(block: str) -> str:
    return "L_" + block.replace(".", "_")


def _value(text: str, kind: str) -> str:
    """A value or a literal of a type."""
    text = text.strip()
    if text.startswith("%"):
        return _name(text)
    if kind == "double":
        if text.startswith("0x"):
            return _literal(int(text, 16))
        return repr(float(text)) if "e" in text or "." in text else f"{text}.0"
    if kind == "i1":
        return {"true": "1", "false": "0"}.get(text, text)
    return f"INT64_C({text})" if kind == "i64" else text


def _literal(bits: int) -> str:
    x = struct.unpack("<d", bits.to_bytes(8, "little"))[0]
    if x != x:
        return "NAN"
    if x in (float("inf"), float("-inf")):
        return "INFINITY" if x > 0 else "(-INFINITY)"
    return f"({x.hex()})" if x < 0 or str(x).startswith("-") else x.hex()


def _statement(f: _Function, line: str, block: str, phis: dict[str, list[tuple[str, str, str]]]) -> None:
    """One instruction."""
    put = f.lines.append
    target, equals, rest = line.partition(" = ")
    if not equals:
        word = line.split(" ")[0]
        if word == "store":
            kind, value, pointer = re.match(r"store (\S+) (\S+), ptr (\S+),", line).groups()  # type: ignore[union-attr]
            put(f"    *({_type(kind)} *){_name(pointer)} = {_value(value, kind)};")
        elif word == "br":
            given = phis.get(block, ())
            f.lines += [f"    {name}_in = {_value(value, kind)};" for name, kind, value in given]
            jumps = re.findall(r"label %([^\s,]+)", line)
            if len(jumps) == 1:
                put(f"    goto {_label(jumps[0])};")
            else:
                condition = _value(line.split()[2].rstrip(","), "i1")
                put(f"    if ({condition}) goto {_label(jumps[0])}; else goto {_label(jumps[1])};")
        elif word == "ret":
            put("    return;")
        elif word == "call":
            put(f"    {_call(line)};")
        else:
            raise _no_c(line)
        return
    name, word = _name(target), rest.split(" ")[0]
    if word == "alloca":
        kind, count = re.match(r"alloca (\S+), i64 (\d+)", rest).groups()  # type: ignore[union-attr]
        f.memory.append(f"    {_type(kind)} {name}_m[{count}]; void *{name} = {name}_m;")
        return
    kind, value = _expression(rest, word)
    f.own[name] = _type(kind)
    if word == "phi":
        f.own[f"{name}_in"] = _type(kind)
        value = f"{name}_in"
    put(f"    {name} = {value};")


def _type(kind: str) -> str:
    if kind not in TYPES:
        raise _no_c(f"values of type {kind}")
    return TYPES[kind]


def _call(rest: str) -> str:
    kind, name, listed = re.match(r"call (\S+) @([\w.]+)\((.*)\)", rest).groups()  # type: ignore[union-attr]
    arguments = [part.split() for part in listed.split(", ")]
    values = ", ".join(_value(argument[-1], argument[0]) for argument in arguments)
    if name.startswith("llvm."):
        function = name.split(".")[1]
        if function not in INTRINSICS or kind != "double":
            raise _no_c(name)
        name = INTRINSICS[function]
    return f"{name}({values})"


def _expression(rest: str, word: str) -> tuple[str, str]:
    """(type, C) of the right side of an instruction."""
    tokens = rest.replace(",", "").split()
    if word == "phi":
        return tokens[1], ""
    if word == "load":
        return tokens[1], f"*({_type(tokens[1])} *){_name(tokens[3])}"
    if word == "getelementptr":
        kind, pointer, index = re.match(r"getelementptr (?:inbounds )?(\S+), ptr (\S+), i64 (\S+)", rest).groups()  # type: ignore[union-attr]
        return "ptr", f"({_type(kind)} *){_name(pointer)} + {_value(index, 'i64')}"
    if word == "call":
        return tokens[1], _call(rest)
    if word == "select":
        condition, kind = tokens[2], tokens[3]
        return kind, f"{_value(condition, 'i1')} ? {_value(tokens[4], kind)} : {_value(tokens[6], kind)}"
    if word == "fneg":
        return "double", f"-{_value(tokens[2], 'double')}"
    if word == "bitcast":
        into = tokens[4]
        return into, f"{'bits_of' if into == 'i64' else 'of_bits'}({_value(tokens[2], tokens[1])})"
    if word in ("sitofp", "uitofp", "fptosi", "zext", "trunc"):
        kind, value, into = tokens[1], _value(tokens[2], tokens[1]), tokens[4]
        value = f"(uint64_t){value}" if word == "uitofp" and kind == "i64" else value
        return into, f"({_type(into)})({value})" + (" & 1" if word == "trunc" and into == "i1" else "")
    return _binary(tokens, word)


def _binary(tokens: list[str], word: str) -> tuple[str, str]:
    if word in ("fcmp", "icmp"):
        predicate, kind = tokens[1], tokens[2]
        a, b = _value(tokens[3], kind), _value(tokens[4], kind)
        if predicate in ("uno", "ord"):
            either = f"(isnan({a}) || isnan({b}))"
            return "i1", either if predicate == "uno" else f"!{either}"
        if predicate == "one":
            return "i1", f"({a} < {b} || {a} > {b})"
        if predicate in UNORDERED and word == "fcmp":
            return "i1", f"!({a} {UNORDERED[predicate]} {b})"
        table = ORDERED if word == "fcmp" else COMPARED
        if predicate not in table:
            raise _no_c(f"the comparison {predicate}")
        return "i1", f"({a} {table[predicate]} {b})"
    kind = tokens[1]
    a, b = _value(tokens[2], kind), _value(tokens[3], kind)
    if word == "frem":
        return "double", f"fmod({a}, {b})"
    if word in ARITHMETIC:
        return kind, f"{a} {ARITHMETIC[word]} {b}"
    if word in WHOLE:
        if kind == "i1":
            return kind, f"{a} {WHOLE[word]} {b}"
        return kind, f"(int64_t)((uint64_t){a} {WHOLE[word]} (uint64_t){b})"
    if word in SIGNED:
        return kind, f"{a} {SIGNED[word]} {b}"
    raise _no_c(f"the instruction {word}")
