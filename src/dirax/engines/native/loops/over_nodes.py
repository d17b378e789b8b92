"""What is written over the nodes of a step in IR: in `in_lanes.py` nodes in the lanes of one vector, in `apart.py` one after the
other, trajectories in the lanes.

Both round alike: what is added to what, and in what order, does not depend on where it stands.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import Any

import numpy as np

from dirax.engines.native.ir.emitter import Emitter
from dirax.engines.native.ir.lower import Region

SHAPES = (2, 4, 8, 16)
"""Numbers of lanes: those that are missing to the next of them repeat the last node, with weights of zero."""

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

    def flag(self) -> str:
        """Memory for conditions at the nodes, which hold nowhere."""
        flag = self.emitter.body.alloca(self.emitter.bool)
        self.clear(flag)
        return flag

    def clear(self, flag: str) -> None:
        """They hold nowhere again."""
        self.emitter.body.store(self.emitter.bool, self.emitter.false, flag)

    def mark(self, flag: str, condition: str) -> None:
        """Note that one holds at the node that is being written."""
        e = self.emitter
        e.body.store(e.bool, e.either(e.body.load(e.bool, flag), condition), flag)

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
