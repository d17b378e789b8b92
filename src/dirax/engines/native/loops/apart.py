"""Values over the nodes of a step in IR, one node after the other, trajectories in the lanes of vectors."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from dirax.engines.native.ir.emitter import Body, Emitter
from dirax.engines.native.ir.lower import Region
from dirax.engines.native.loops.over_nodes import SHAPES, OverNodes, Pair, summed, ways

TOGETHER = 4
"""Products that share a row of the matrix: more of them do not find room in the registers."""


class Swapped(Pair):
    """Rooms one behind the other, and where they begin."""

    def __init__(self, over: OverNodes, count: int):
        super().__init__(over, count)
        body, self._size = over.emitter.body, over.count
        self._begins = body.alloca("ptr"), body.alloca("ptr")
        for begin in self._begins:
            body.store("ptr", body.alloca(over.emitter.real, max(1, count * self._size)), begin)

    def _rooms(self, begin: str) -> list[str]:
        body, real = self.over.emitter.body, self.over.emitter.real
        first = body.load("ptr", begin)
        return [body.at(real, first, i * self._size) for i in range(self.count)]

    def now(self):
        return self._rooms(self._begins[0])

    def others(self):
        return self._rooms(self._begins[1])

    def swap(self):
        body = self.over.emitter.body
        first, second = (body.load("ptr", begin) for begin in self._begins)
        body.store("ptr", second, self._begins[0])
        body.store("ptr", first, self._begins[1])


class Apart(OverNodes):
    """A loop over the nodes, with trajectories in the lanes of a vector."""

    def __init__(self, body: Body, count: int, trajectories: int):
        self.body, self.count = body, count
        self.one = self.emitter = Emitter(body, trajectories)

    @contextmanager
    def at(self) -> Iterator[str]:
        with self.body.loop(0, self.count) as node:
            yield node

    def splat(self, number):
        return number

    def table(self, values, factor="", weights=False):
        return self._memory(values, factor)

    def _memory(self, values: np.ndarray, factor: str) -> str:
        number, table = Emitter(self.body, 1), self.body.alloca("double", values.size)
        for i, value in enumerate(values.ravel().tolist()):
            entry = number.mul(number.const(value), factor) if factor else number.const(value)
            self.body.store("double", entry, self.body.at("double", table, i))
        return table

    def of(self, table, node):
        return self.emitter.splat(self.body.load("double", self.body.at("double", table, node)))

    def matrix(self, values, factor=""):
        return self._memory(values, factor), values.shape[1]

    def product(self, matrix, rooms, node, starts, of):
        (table, columns), found = matrix, []
        row = self.body.at("double", table, self.body.put(f"mul i64 {node}, {columns}"))
        for first in range(0, len(rooms), TOGETHER):
            found += self._products(row, columns, rooms[first : first + TOGETHER], starts[first : first + TOGETHER], of)
        return found

    def _products(self, row: str, columns: int, rooms: list[str], starts: Sequence[str | None], of: OverNodes) -> list[str]:
        e, many = self.emitter, ways(columns)
        parts: list[list[str | None]] = [[start, *[None] * (many - 1)] for start in starts]
        for j in range(columns):
            factor = self.of(row, str(j))
            for sums, room in zip(parts, rooms, strict=True):
                entry, part = of.load(room, str(j)), sums[j % many]
                sums[j % many] = e.mul(factor, entry) if part is None else e.fma(factor, entry, part)
        return [summed(e, sums) for sums in parts]

    def room(self):
        return self.body.alloca(self.emitter.real, self.count)

    def load(self, room, node):
        return self.body.load(self.emitter.real, self.body.at(self.emitter.real, room, node), 64)

    def store(self, value, room, node):
        self.body.store(self.emitter.real, value, self.body.at(self.emitter.real, room, node), 64)

    def last(self, room):
        return self.load(room, str(self.count - 1))

    def final(self, room):
        return self.last(room)

    def total(self, room):
        values, width = [self.load(room, str(i)) for i in range(self.count)], next(n for n in SHAPES if n >= self.count)
        while width > 1:
            width //= 2
            low, high = values[:width], values[width:]
            values = [*(self.one.add(a, b) for a, b in zip(low, high, strict=False)), *low[len(high) :]]
        return values[0]

    def pair(self, count):
        return Swapped(self, count)

    def seldom(self, condition):
        return self.body.when(self.one.any(condition))

    def marked(self, flag):
        return self.body.load(self.one.bool, flag)

    def peak(self):
        peak = self.body.alloca(self.one.real)
        self.body.store(self.one.real, self.one.const(0.0), peak)
        return peak

    def raised(self, peak, value):
        self.body.store(self.one.real, self.one.max(value, self.body.load(self.one.real, peak)), peak)

    def highest(self, peak):
        return self.body.load(self.one.real, peak)

    def chosen(self, condition, yes, no):
        return self.one.select(condition, yes, no)

    def read(self, places, room):
        for i, place in enumerate(places):
            self.store(self.body.load(self.one.real, place), room, str(i))

    def write(self, room, places):
        for i, place in enumerate(places):
            self.body.store(self.one.real, self.load(room, str(i)), place)

    def constants(self, known):
        return known

    def handed_on(self, region, outputs, node):
        e, graph, needed = self.emitter, region.graph, region.operands_of(outputs)
        rooms = self.rooms(len(needed))
        truth = [graph.is_boolean(n) for n in needed]
        number = lambda n, is_truth: e.select(region.value(n), e.const(1.0), e.const(0.0)) if is_truth else region.value(n)
        self.filled(rooms, [number(n, is_truth) for n, is_truth in zip(needed, truth, strict=True)], node)

        def again(node: str) -> Region:
            other = Region(e, graph, region.parent)
            for n, is_truth, room in zip(needed, truth, rooms, strict=True):
                value = self.load(room, node)
                other.bind(n, e.compare("ogt", value, e.const(0.5)) if is_truth else value)
            return other

        return again
