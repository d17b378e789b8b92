"""Values over the nodes of a step in IR: nodes in the lanes of one vector, or apart, each in a vector over trajectories.

Both round alike: what is added to what does not depend on where it stands.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from functools import partial, reduce
from typing import Any

import numpy as np

from dirax.engines.native.ir.emitter import Body, Emitter
from dirax.engines.native.ir.lower import Region
from dirax.program.graph import Graph

SHAPES = (2, 4, 8, 16)
"""Numbers of lanes: those that are missing to the next of them repeat the last node, with weights of zero."""

Over = Any
"""A value over the nodes: a name in the text, or a list of them."""


class OverNodes(ABC):
    """Arithmetic on values over `count` nodes; `one` writes what a trajectory has one of, and `emitter` what a value is made of."""

    one: Emitter
    emitter: Emitter
    count: int

    @abstractmethod
    def each(self, operation: Callable[..., str], *values: Over) -> Over:
        """An operation of the emitter at every node."""

    @abstractmethod
    def splat(self, number: str) -> Over:
        """The same number at every node."""

    @abstractmethod
    def vector(self, values: np.ndarray, weights: bool = False) -> Over:
        """A constant with one entry a node; `weights` are zero where there is no node."""

    @abstractmethod
    def entry(self, value: Over, node: int, to: "OverNodes") -> Over:
        """What stands at one node, at all nodes of `to`."""

    @abstractmethod
    def total(self, value: Over) -> str:
        """The sum over the nodes, a number."""

    @abstractmethod
    def largest(self, value: Over) -> str:
        """The largest entry that is not negative, a number."""

    @abstractmethod
    def any(self, condition: Over) -> str:
        """Whether it holds at some node of a trajectory."""

    @abstractmethod
    def all(self, condition: Over) -> str:
        """Whether it holds at every node of a trajectory."""

    @abstractmethod
    def chosen(self, condition: str, yes: Over, no: Over) -> Over:
        """One of two by a condition on the trajectory."""

    @abstractmethod
    def read(self, places: Sequence[str]) -> Over:
        """From one number in memory a node."""

    @abstractmethod
    def write(self, value: Over, places: Sequence[str]) -> None:
        """To one number in memory a node."""

    @abstractmethod
    def room(self) -> Over:
        """Memory for a value."""

    @abstractmethod
    def constants(self, graph: Graph, known: Region) -> Region:
        """What is `known` of a trajectory by numbers, for regions over the nodes to begin from."""

    @abstractmethod
    def region(self, graph: Graph, parent: Region) -> "Region | Regions":
        """A region at every node."""

    def load(self, pointer: Over) -> Over:
        """What stands in a room."""
        return self.each(lambda p: self.emitter.body.load(self.emitter.real, p, 64), pointer)

    def store(self, value: Over, pointer: Over) -> None:
        """Fill a room."""
        self.each(lambda v, p: self.emitter.body.store(self.emitter.real, v, p, 64) or "", value, pointer)

    def const(self, value: float) -> Over:
        """A constant at every node."""
        return self.splat_of(self.emitter.const(value))

    @abstractmethod
    def splat_of(self, literal: str) -> Over:
        """A literal of the emitter at every node."""

    def add(self, a: Over, b: Over) -> Over:
        return self.each(self.emitter.add, a, b)

    def sub(self, a: Over, b: Over) -> Over:
        return self.each(self.emitter.sub, a, b)

    def mul(self, a: Over, b: Over) -> Over:
        return self.each(self.emitter.mul, a, b)

    def fma(self, a: Over, b: Over, c: Over) -> Over:
        return self.each(self.emitter.fma, a, b, c)

    def abs(self, a: Over) -> Over:
        return self.each(self.emitter.abs, a)

    def max(self, a: Over, b: Over) -> Over:
        return self.each(self.emitter.max, a, b)

    def min(self, a: Over, b: Over) -> Over:
        return self.each(lambda a, b: self.emitter.select(self.emitter.compare("olt", a, b), a, b), a, b)

    def compare(self, predicate: str, a: Over, b: Over) -> Over:
        return self.each(partial(self.emitter.compare, predicate), a, b)

    def both(self, a: Over, b: Over) -> Over:
        return self.each(self.emitter.both, a, b)

    def either(self, a: Over, b: Over) -> Over:
        return self.each(self.emitter.either, a, b)

    def invert(self, a: Over) -> Over:
        return self.each(self.emitter.invert, a)

    def product(self, columns: list[Over], x: Over, start: Over | None = None, of: "OverNodes | None" = None) -> Over:
        """start + matrix·x, for x over the nodes of `of`."""
        ways = 4 if len(columns) >= 8 else 2 if len(columns) >= 4 else 1
        parts: list[Over | None] = [start, *[None] * (ways - 1)]
        for j, column in enumerate(columns):
            entry = (of or self).entry(x, j, self)
            part = parts[j % ways]
            parts[j % ways] = self.mul(column, entry) if part is None else self.fma(column, entry, part)
        sums = [part for part in parts if part is not None]
        while len(sums) > 1:
            sums = [self.add(a, b) for a, b in zip(sums[0::2], sums[1::2], strict=True)]
        return sums[0]


class InLanes(OverNodes):
    """The nodes of one trajectory in the lanes of a vector."""

    def __init__(self, body: Body, count: int):
        self.one, self.count = Emitter(body, 1), count
        self.emitter = Emitter(body, next(n for n in SHAPES if n >= count))

    def each(self, operation, *values):
        return operation(*values)

    def splat(self, number):
        return self.emitter.splat(number)

    def splat_of(self, literal):
        return literal

    def vector(self, values, weights=False):
        last = 0.0 if weights else float(values[-1])
        padded = [*values.tolist(), *[last] * (self.emitter.width - len(values))]
        return f"<{', '.join(f'double {self.one.const(x)}' for x in padded)}>"

    def entry(self, value, node, to):
        real, mask = self.emitter.real, ", ".join([f"i32 {node}"] * to.emitter.width)
        return self.emitter.body.put(f"shufflevector {real} {value}, {real} poison, <{to.emitter.width} x i32> <{mask}>")

    def total(self, value):
        body, width = self.emitter.body, self.emitter.width
        while width > 1:
            half = width // 2
            kind = f"<{width} x double>"
            low, high = (
                body.put(
                    f"shufflevector {kind} {value}, {kind} poison, <{half} x i32> "
                    f"<{', '.join(f'i32 {i}' for i in range(first, first + half))}>"
                )
                for first in (0, half)
            )
            value = body.put(f"fadd <{half} x double> {low}, {high}")
            width = half
        return body.put(f"extractelement <1 x double> {value}, i64 0")

    def largest(self, value):
        entries = (self.emitter.extract(value, lane) for lane in range(self.count))
        return reduce(lambda most, entry: self.one.max(entry, most), entries, self.one.const(0.0))

    def any(self, condition):
        return self.emitter.any(condition)

    def all(self, condition):
        return self.emitter.all(condition)

    def chosen(self, condition, yes, no):
        real = self.emitter.real
        return self.emitter.body.put(f"select i1 {condition}, {real} {yes}, {real} {no}")

    def read(self, places):
        numbers = [self.emitter.body.load("double", place) for place in places]
        return self.emitter.pack(numbers + numbers[-1:] * (self.emitter.width - len(numbers)))

    def write(self, value, places):
        for lane, place in enumerate(places):
            self.emitter.body.store("double", self.emitter.extract(value, lane), place)

    def room(self):
        return self.emitter.body.alloca(self.emitter.real)

    def constants(self, graph, known):
        region = Region(self.emitter, graph)
        for node, value in known.values.items():
            region.bind(node, self.splat(value))
        return region

    def region(self, graph, parent):
        return Region(self.emitter, graph, parent)


class Apart(OverNodes):
    """The nodes one by one, the trajectories in the lanes of a vector."""

    def __init__(self, body: Body, count: int, trajectories: int):
        self.one = self.emitter = Emitter(body, trajectories)
        self.count = count

    def each(self, operation, *values):
        return [operation(*at) for at in zip(*values, strict=True)]

    def splat(self, number):
        return [number] * self.count

    def splat_of(self, literal):
        return [literal] * self.count

    def vector(self, values, weights=False):
        return [self.one.const(x) for x in values.tolist()]

    def entry(self, value, node, to):
        return [value[node]] * to.count

    def total(self, value):
        width = next(n for n in SHAPES if n >= self.count)
        while width > 1:
            width //= 2
            low, high = value[:width], value[width:]
            value = [*(self.one.add(a, b) for a, b in zip(low, high, strict=False)), *low[len(high) :]]
        return value[0]

    def largest(self, value):
        return reduce(lambda most, entry: self.one.max(entry, most), value, self.one.const(0.0))

    def any(self, condition):
        return reduce(self.one.either, condition)

    def all(self, condition):
        return reduce(self.one.both, condition)

    def chosen(self, condition, yes, no):
        return [self.one.select(condition, a, b) for a, b in zip(yes, no, strict=True)]

    def read(self, places):
        return [self.one.body.load(self.one.real, place) for place in places]

    def write(self, value, places):
        for entry, place in zip(value, places, strict=True):
            self.one.body.store(self.one.real, entry, place)

    def room(self):
        return [self.one.body.alloca(self.one.real) for _ in range(self.count)]

    def constants(self, graph, known):
        return known

    def region(self, graph, parent):
        return Regions([Region(self.one, graph, parent) for _ in range(self.count)])


class Regions:
    """What a `Region` is, at several nodes."""

    def __init__(self, parts: list[Region]):
        self.parts = parts

    def bind(self, node: int, value: list[str]) -> None:
        for part, entry in zip(self.parts, value, strict=True):
            part.bind(node, entry)

    def require(self, outputs: Iterable[int]) -> None:
        outputs = list(outputs)
        for part in self.parts:
            part.require(outputs)

    def value(self, node: int) -> list[str]:
        return [part.value(node) for part in self.parts]
