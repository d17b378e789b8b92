"""Values over the nodes of a step in IR: nodes in the lanes of one vector, or one after the other, trajectories in the lanes.

Both round alike: what is added to what, and in what order, does not depend on where it stands.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import reduce
from typing import Any

import numpy as np

from dirax.engines.native.ir.emitter import Body, Emitter
from dirax.engines.native.ir.lower import Region

SHAPES = (2, 4, 8, 16)
"""Numbers of lanes: those that are missing to the next of them repeat the last node, with weights of zero."""

TOGETHER = 4
"""Products that share a row of the matrix: more of them do not find room in the registers."""

Table = Any
"""Constants of the nodes: names of vectors, or where they stand in memory."""


class OverNodes(ABC):
    """What is written `at` the `count` nodes: `emitter` writes what belongs to a node, and `one` what a trajectory has one of.

    What is to be known at other nodes as well stands in a `room`, of which there is one for every node.
    """

    one: Emitter
    emitter: Emitter
    count: int

    @abstractmethod
    def at(self) -> AbstractContextManager[str]:
        """A stretch of code for every node; gives the node."""

    @abstractmethod
    def splat(self, number: str) -> str:
        """A number of the trajectory."""

    @abstractmethod
    def table(self, values: np.ndarray, factor: str = "", weights: bool = False) -> Table:
        """Constants, one a node, times a double; `weights` are zero where there is no node."""

    @abstractmethod
    def of(self, table: Table, node: str) -> str:
        """The constant of a node."""

    @abstractmethod
    def matrix(self, values: np.ndarray, factor: str = "") -> Table:
        """A matrix with a row for every node, times a double."""

    @abstractmethod
    def product(self, matrix: Table, rooms: list[str], node: str, starts: Sequence[str | None], of: "OverNodes") -> list[str]:
        """start + matrix·x at a node, for several x over the nodes of `of`."""

    @abstractmethod
    def room(self) -> str:
        """Memory for a value at every node."""

    @abstractmethod
    def load(self, room: str, node: str) -> str:
        """What stands there at a node."""

    @abstractmethod
    def store(self, value: str, room: str, node: str) -> None:
        """Put it there."""

    @abstractmethod
    def last(self, room: str) -> str:
        """What stands there at the last node, at every node."""

    @abstractmethod
    def final(self, room: str) -> str:
        """What stands there at the last node, a number."""

    @abstractmethod
    def total(self, room: str) -> str:
        """The sum over the nodes, a number."""

    @abstractmethod
    def pair(self, count: int) -> "Pair":
        """Two times so many rooms."""

    @abstractmethod
    def seldom(self, condition: str) -> AbstractContextManager[None]:
        """A stretch that matters only where a condition holds at the node that is being written."""

    @abstractmethod
    def flag(self) -> str:
        """Memory for conditions at the nodes, which hold nowhere."""

    @abstractmethod
    def clear(self, flag: str) -> None:
        """They hold nowhere again."""

    @abstractmethod
    def mark(self, flag: str, condition: str) -> None:
        """Note that one holds at the node that is being written."""

    @abstractmethod
    def marked(self, flag: str) -> str:
        """Whether one holds at some node of a trajectory."""

    @abstractmethod
    def peak(self) -> str:
        """Memory for the largest of numbers at the nodes, which is zero."""

    @abstractmethod
    def raised(self, peak: str, value: str) -> None:
        """Note a number at the node that is being written."""

    @abstractmethod
    def highest(self, peak: str) -> str:
        """The largest of them in a trajectory."""

    @abstractmethod
    def chosen(self, condition: str, yes: str, no: str) -> str:
        """One of two by a condition on the trajectory."""

    @abstractmethod
    def read(self, places: Sequence[str], room: str) -> None:
        """Fill a room from one number in memory a node."""

    @abstractmethod
    def write(self, room: str, places: Sequence[str]) -> None:
        """The other way round."""

    @abstractmethod
    def constants(self, known: Region) -> Region:
        """What is known of a trajectory in numbers, for regions at the nodes to begin from."""

    @abstractmethod
    def handed_on(self, region: Region, outputs: list[int], node: str) -> Callable[[str], Region]:
        """What a region at a node knows that these outputs will need, for another stretch at that node."""

    def filled(self, rooms: list[str], values: list[str], node: str) -> None:
        """Put values into rooms."""
        for value, room in zip(values, rooms, strict=True):
            self.store(value, room, node)

    def rooms(self, count: int) -> list[str]:
        """Several of them."""
        return [self.room() for _ in range(count)]


def ways(columns: int) -> int:
    """Sums side by side that a product of so many columns is made of."""
    return 4 if columns >= 8 else 2 if columns >= 4 else 1


def summed(e: Emitter, parts: list[str | None]) -> str:
    """One sum of those side by side."""
    sums = [part for part in parts if part is not None]
    while len(sums) > 1:
        sums = [e.add(a, b) for a, b in zip(sums[0::2], sums[1::2], strict=True)]
    return sums[0]


class Pair(ABC):
    """Rooms `now` and others, which take their place."""

    def __init__(self, over: OverNodes, count: int):
        self.over, self.count = over, count

    @abstractmethod
    def now(self) -> list[str]:
        """Those that are in use."""

    @abstractmethod
    def others(self) -> list[str]:
        """Those that are not."""

    @abstractmethod
    def swap(self) -> None:
        """From here on the others are in use."""


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

    def flag(self):
        flag = self.body.alloca(self.emitter.bool)
        self.clear(flag)
        return flag

    def clear(self, flag):
        self.body.store(self.emitter.bool, self.emitter.false, flag)

    def mark(self, flag, condition):
        condition = self.emitter.either(self.body.load(self.emitter.bool, flag), condition)
        self.body.store(self.emitter.bool, condition, flag)

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

    def flag(self):
        flag = self.body.alloca(self.one.bool)
        self.clear(flag)
        return flag

    def clear(self, flag):
        self.body.store(self.one.bool, self.one.false, flag)

    def mark(self, flag, condition):
        self.body.store(self.one.bool, self.one.either(self.body.load(self.one.bool, flag), condition), flag)

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
