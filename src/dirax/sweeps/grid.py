"""How the points of a sweep are cut into tasks: equal blocks of its grid, each one chunk of every array of the store."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np

Index = tuple[int, ...]
"""The number of a block along every axis."""


@dataclass(frozen=True)
class Grid:
    """A grid of `shape` in blocks of `chunk`; those at the upper ends may be smaller."""

    shape: tuple[int, ...]
    chunk: tuple[int, ...]

    @property
    def blocks(self) -> tuple[int, ...]:
        """The number of blocks along every axis."""
        return tuple(-(-size // part) for size, part in zip(self.shape, self.chunk, strict=True))

    @property
    def points(self) -> int:
        """The number of points of a whole block."""
        return math.prod(self.chunk)

    def __iter__(self) -> Iterator[Index]:
        return product(*map(range, self.blocks))

    def region(self, index: Index) -> tuple[slice, ...]:
        """The points of a block."""
        ends = zip(index, self.chunk, self.shape, strict=True)
        return tuple(slice(k * part, min((k + 1) * part, size)) for k, part, size in ends)

    def numbers(self, index: Index) -> np.ndarray:
        """The numbers of the points of a block, an array with its axes."""
        return np.ravel_multi_index(np.ix_(*(range(s.start, s.stop) for s in self.region(index))), self.shape)


def cut(shape: tuple[int, ...], points: int) -> Grid:
    """Blocks of about so many points: whole in the last axes, a part of one axis, one value of those before it. The parts are
    as equal as can be."""
    chunk, left = [1] * len(shape), max(1, points)
    for axis in reversed(range(len(shape))):
        size = shape[axis]
        parts = -(-size // min(left, size))
        chunk[axis] = -(-size // parts)
        left //= chunk[axis]
        if parts > 1 or left < 1:
            break
        left = max(left, 1)
    return Grid(tuple(shape), tuple(chunk))
