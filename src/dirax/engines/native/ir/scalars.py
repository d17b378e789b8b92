"""A module's vectors taken apart into numbers, one instruction a lane: what has no vectors, C, can say it then."""

import itertools
import re
from collections.abc import Callable

VECTOR = re.compile(r"<(\d+) x (\w+)>")
VALUE = re.compile(r"%[\w.]+")
SHIFTED = re.compile(r"%([\w.]+) = (.*)")

TYPE = r"(<\d+ x \w+>|\w+)"
OPERAND = r"(splat \([^)]*\)|<[^<>]*>|[^\s,()]+)"
"""A value: a name, a number, or the lanes of a constant."""

FORMS: dict[str, re.Pattern] = {
    name: re.compile(form.replace("TYPE", TYPE).replace("VALUE", OPERAND))
    for name, form in {
        "alloca": r"alloca TYPE, i64 (\d+)",
        "load": r"load TYPE, ptr (\S+),",
        "store": r"store TYPE VALUE, ptr (\S+),",
        "getelementptr": r"getelementptr inbounds TYPE, ptr (\S+), i64 (\S+)",
        "insertelement": r"insertelement TYPE VALUE, \w+ VALUE, i64 (\d+)",
        "extractelement": r"extractelement TYPE VALUE, i64 (\d+)",
        "shufflevector": r"shufflevector TYPE VALUE, TYPE VALUE, TYPE VALUE",
        "select": r"select TYPE VALUE, TYPE VALUE, TYPE VALUE",
        "phi": r"phi TYPE (.*)",
        "call": r"call TYPE @([\w.]+)\((.*)\)",
        "fcmp": r"(fcmp|icmp) (\w+) TYPE VALUE, VALUE",
        "cast": r"(\w+) TYPE VALUE to TYPE",
        "binary": r"(\w+) TYPE VALUE, VALUE",
        "unary": r"(\w+) TYPE VALUE",
    }.items()
}
FORMS["icmp"] = FORMS["fcmp"]
GIVEN = re.compile(rf"{TYPE} {OPERAND}")
MOVES = "insertelement", "extractelement", "shufflevector"
"""Instructions that only say which lane is which."""


def scalars(module: str) -> str:
    """The module without vectors: the same operations in the same order for each lane, with the same roundings."""
    out: list[str] = []
    function: list[str] = []
    for line in module.splitlines():
        if line.startswith("define"):
            function = [line]
        elif function:
            function.append(line)
            if line == "}":
                out += _Function(function).text()
                function = []
        elif not (line.startswith("declare") and VECTOR.search(line)):
            out.append(line)
    return "\n".join(out)


def _lanes_of(kind: str) -> tuple[int, str]:
    """How many lanes a type has, and what each of them is; 0 for a number."""
    found = VECTOR.fullmatch(kind)
    return (int(found[1]), found[2]) if found else (0, kind)


class _Function:
    """One function: its vectors by name, each a list of values."""

    def __init__(self, lines: list[str]):
        self.lines = lines
        self.made = {found[1]: found[2] for line in lines if (found := SHIFTED.match(line.strip()))}
        self.known: dict[str, list[str] | str] = {}
        self.places = itertools.count()

    def text(self) -> list[str]:
        out: list[str] = []
        for line in self.lines:
            target, equals, rest = line.strip().partition(" = ")
            if not equals:
                target, rest = "", line.strip()
            word = rest.partition(" ")[0]
            if VECTOR.search(rest) and word not in MOVES and not line.startswith("define"):
                out += [f"  {one}" for one in self._taken_apart(target, word, rest)]
            elif word not in MOVES:
                out.append(VALUE.sub(lambda found: self._number(found[0]), line))
        return out

    def _number(self, name: str) -> str:
        """A number, which may be a lane of a vector."""
        rest = self.made.get(name[1:], "")
        if not rest.startswith("extractelement"):
            return name
        if name not in self.known:
            kind, vector, lane = FORMS["extractelement"].match(rest).groups()  # type: ignore[union-attr]
            self.known[name] = self._lanes(kind, vector)[int(lane)]
        return str(self.known[name])

    def _lanes(self, kind: str, text: str) -> list[str]:
        """The lanes of a value of a type; of a number, the number."""
        count, each = _lanes_of(kind)
        if not count:
            return [self._number(text)]
        if text.startswith("splat"):
            return [text[text.index("(") + 1 : -1].split()[-1]] * count
        if text.startswith("<"):
            return [part.split()[-1] for part in text[1:-1].split(",")]
        if not text.startswith("%"):  # zeroinitializer, or poison, which nobody reads
            return ["0.0" if each == "double" else "0"] * count
        if text not in self.known:
            rest = self.made.get(text[1:], "")
            moved = getattr(self, f"_{rest.partition(' ')[0]}", None) if rest.startswith(MOVES) else None
            self.known[text] = moved(rest) if moved else [f"{text}.{k}" for k in range(count)]
        return list(self.known[text])

    def _insertelement(self, rest: str) -> list[str]:
        kind, vector, number, lane = FORMS["insertelement"].match(rest).groups()  # type: ignore[union-attr]
        found = self._lanes(kind, vector)
        found[int(lane)] = self._number(number)
        return found

    def _shufflevector(self, rest: str) -> list[str]:
        a, first, b, second, wide, mask = FORMS["shufflevector"].match(rest).groups()  # type: ignore[union-attr]
        both = [*self._lanes(a, first), *self._lanes(b, second)]
        return [both[0] if lane == "poison" else both[int(lane)] for lane in self._lanes(wide, mask)]

    def _taken_apart(self, target: str, word: str, rest: str) -> list[str]:
        form = word if word in FORMS else "cast" if " to " in rest else "binary" if FORMS["binary"].match(rest) else "unary"
        found = FORMS[form].match(rest)
        if found is None:
            raise ValueError(f"no instruction for numbers is known for {rest!r}")
        return getattr(self, f"_of_{'fcmp' if form == 'icmp' else form}")(target, *found.groups())

    def _each(self, target: str, kind: str, write: Callable[[int], str]) -> list[str]:
        count, _ = _lanes_of(kind)
        return [f"{target}.{k} = {write(k)}" for k in range(count)]

    def _of_alloca(self, target: str, kind: str, many: str) -> list[str]:
        count, each = _lanes_of(kind)
        return [f"{target} = alloca {each}, i64 {count * int(many)}, align 64"]

    def _of_load(self, target: str, kind: str, pointer: str) -> list[str]:
        count, each = _lanes_of(kind)
        places = [f"{target}.at{k} = getelementptr inbounds {each}, ptr {pointer}, i64 {k}" for k in range(count)]
        return [*places, *self._each(target, kind, lambda k: f"load {each}, ptr {target}.at{k}, align 8")]

    def _of_store(self, target: str, kind: str, value: str, pointer: str) -> list[str]:
        _, each = _lanes_of(kind)
        lines = []
        for k, lane in enumerate(self._lanes(kind, value)):
            place = self._fresh()
            lines.append(f"{place} = getelementptr inbounds {each}, ptr {pointer}, i64 {k}")
            lines.append(f"store {each} {lane}, ptr {place}, align 8")
        return lines

    def _of_getelementptr(self, target: str, kind: str, pointer: str, index: str) -> list[str]:
        count, each = _lanes_of(kind)
        first = self._fresh()
        return [
            f"{first} = mul i64 {self._number(index)}, {count}",
            f"{target} = getelementptr inbounds {each}, ptr {pointer}, i64 {first}",
        ]

    def _fresh(self) -> str:
        return f"%place.{next(self.places)}"

    def _of_select(self, target: str, kind: str, test: str, a: str, yes: str, b: str, no: str) -> list[str]:
        count, each = _lanes_of(a)
        tests = self._lanes(kind, test) * (1 if _lanes_of(kind)[0] else count)
        x, y = self._lanes(a, yes), self._lanes(b, no)
        return self._each(target, a, lambda k: f"select i1 {tests[k]}, {each} {x[k]}, {each} {y[k]}")

    def _of_phi(self, target: str, kind: str, given: str) -> list[str]:
        _, each = _lanes_of(kind)
        pairs = [(self._lanes(kind, value), before) for value, before in re.findall(rf"\[ {OPERAND}, (%[\w.]+) \]", given)]
        return self._each(target, kind, lambda k: f"phi {each} " + ", ".join(f"[ {v[k]}, {b} ]" for v, b in pairs))

    def _of_call(self, target: str, kind: str, name: str, given: str) -> list[str]:
        values = [(_lanes_of(a)[1], self._lanes(a, value)) for a, value in GIVEN.findall(given)]
        _, each = _lanes_of(kind)
        if name == f"llvm.vector.reduce.or.v{len(values[0][1])}i1":
            lanes = values[0][1]
            steps = [*(f"{target}.{k}" for k in range(1, len(lanes) - 1)), target]
            pairs = zip(steps, [lanes[0], *steps], lanes[1:] or ["false"], strict=False)
            return [f"{new} = or i1 {old}, {lane}" for new, old, lane in pairs]
        plain = re.sub(r"\.v\d+(f64|i64)$", r".\1", name)
        listed = lambda k: ", ".join(f"{a} {lanes[k]}" for a, lanes in values)
        return self._each(target, kind, lambda k: f"call {each} @{plain}({listed(k)})")

    def _of_fcmp(self, target: str, word: str, test: str, kind: str, a: str, b: str) -> list[str]:
        x, y = self._lanes(kind, a), self._lanes(kind, b)
        return self._each(target, kind, lambda k: f"{word} {test} {_lanes_of(kind)[1]} {x[k]}, {y[k]}")

    def _of_cast(self, target: str, word: str, kind: str, value: str, into: str) -> list[str]:
        x = self._lanes(kind, value)
        return self._each(target, kind, lambda k: f"{word} {_lanes_of(kind)[1]} {x[k]} to {_lanes_of(into)[1]}")

    def _of_binary(self, target: str, word: str, kind: str, a: str, b: str) -> list[str]:
        x, y = self._lanes(kind, a), self._lanes(kind, b)
        return self._each(target, kind, lambda k: f"{word} {_lanes_of(kind)[1]} {x[k]}, {y[k]}")

    def _of_unary(self, target: str, word: str, kind: str, value: str) -> list[str]:
        x = self._lanes(kind, value)
        return self._each(target, kind, lambda k: f"{word} {_lanes_of(kind)[1]} {x[k]}")
