"""Values over the nodes of a step in IR, the nodes of one trajectory in the lanes of a vector."""

from contextlib import nullcontext
from functools import reduce

from dirax.engines.native.ir.emitter import Body, Emitter
from dirax.engines.native.ir.lower import Region
from dirax.engines.native.loops.over_nodes import SHAPES, OverNodes, Pair, summed, ways


class Copied(Pair):
    """Rooms that registers stand for."""

    def __init__(self, over: OverNodes, count: int):
        super().__init__(over, count)
        self._now, self._others = over.rooms(count), over.rooms(count)

    def now(self):
        return self._now

    def others(self):
        return self._others

    def swap(self):
        with self.over.at() as node:
            self.over.filled(self._now, [self.over.load(room, node) for room in self._others], node)


class InLanes(OverNodes):
    """The nodes of one trajectory in the lanes of a vector."""

    def __init__(self, body: Body, count: int):
        self.body, self.one, self.count = body, Emitter(body, 1), count
        self.emitter = Emitter(body, next(n for n in SHAPES if n >= count))

    def at(self):
        return nullcontext("")

    def splat(self, number):
        return self.emitter.splat(number)

    def table(self, values, factor="", weights=False):
        last = 0.0 if weights else float(values[-1])
        padded = [*values.tolist(), *[last] * (self.emitter.width - len(values))]
        vector = f"<{', '.join(f'double {self.one.const(x)}' for x in padded)}>"
        return self.emitter.mul(vector, self.emitter.splat(factor)) if factor else vector

    def of(self, table, node):
        return table

    def matrix(self, values, factor=""):
        return [self.table(column, factor) for column in values.T]

    def product(self, matrix, rooms, node, starts, of):
        return [self._product(matrix, of.load(room, node), start, of) for room, start in zip(rooms, starts, strict=True)]

    def _product(self, columns: list[str], x: str, start: str | None, of: OverNodes) -> str:
        e, many = self.emitter, ways(len(columns))
        parts: list[str | None] = [start, *[None] * (many - 1)]
        for j, column in enumerate(columns):
            entry, part = self._everywhere(x, j, of), parts[j % many]
            parts[j % many] = e.mul(column, entry) if part is None else e.fma(column, entry, part)
        return summed(e, parts)

    def _everywhere(self, x: str, lane: int, of: OverNodes) -> str:
        real, width = of.emitter.real, self.emitter.width
        mask = ", ".join([f"i32 {lane}"] * width)
        return self.body.put(f"shufflevector {real} {x}, {real} poison, <{width} x i32> <{mask}>")

    def room(self):
        return self.body.alloca(self.emitter.real)

    def load(self, room, node):
        return self.body.load(self.emitter.real, room, 64)

    def store(self, value, room, node):
        self.body.store(self.emitter.real, value, room, 64)

    def last(self, room):
        return self._everywhere(self.load(room, ""), self.count - 1, self)

    def final(self, room):
        return self.emitter.extract(self.load(room, ""), self.count - 1)

    def total(self, room):
        value, width = self.load(room, ""), self.emitter.width
        while width > 1:
            half = width // 2
            kind = f"<{width} x double>"
            low, high = (
                self.body.put(
                    f"shufflevector {kind} {value}, {kind} poison, <{half} x i32> "
                    f"<{', '.join(f'i32 {i}' for i in range(first, first + half))}>"
                )
                for first in (0, half)
            )
            value = self.body.put(f"fadd <{half} x double> {low}, {high}")
            width = half
        return self.body.put(f"extractelement <1 x double> {value}, i64 0")

    def pair(self, count):
        return Copied(self, count)

    def seldom(self, condition):
        return nullcontext()

    def marked(self, flag):
        return self.emitter.any(self.body.load(self.emitter.bool, flag))

    def peak(self):
        peak = self.room()
        self.store(self.emitter.const(0.0), peak, "")
        return peak

    def raised(self, peak, value):
        self.store(self.emitter.max(value, self.load(peak, "")), peak, "")

    def highest(self, peak):
        value = self.load(peak, "")
        entries = (self.emitter.extract(value, lane) for lane in range(self.count))
        return reduce(lambda most, entry: self.one.max(entry, most), entries, self.one.const(0.0))

    def chosen(self, condition, yes, no):
        real = self.emitter.real
        return self.body.put(f"select i1 {condition}, {real} {yes}, {real} {no}")

    def read(self, places, room):
        numbers = [self.body.load("double", place) for place in places]
        self.store(self.emitter.pack(numbers + numbers[-1:] * (self.emitter.width - len(numbers))), room, "")

    def write(self, room, places):
        value = self.load(room, "")
        for lane, place in enumerate(places):
            self.body.store("double", self.emitter.extract(value, lane), place)

    def constants(self, known):
        region = Region(self.emitter, known.graph)
        for node, value in known.values.items():
            region.bind(node, self.splat(value))
        return region

    def handed_on(self, region, outputs, node):
        return lambda node: region
