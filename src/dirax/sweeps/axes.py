"""The points of a sweep: named axes and their outer product, or their rows side by side."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

POINT = "point"
"""The dimension of a sweep whose axes are taken side by side."""

TAKEN = ("time", "interval", "coordinate", "constraint", "trajectory", "status", "message", "key", "rng", POINT)
"""Names that an axis cannot have."""


class PointError(ValueError):
    """What is wrong with a user's function at a point, in words that name the point."""


@dataclass(frozen=True, eq=False)
class Axes:
    """`values` (n,) by name. Points are numbered in C order: the last axis runs fastest."""

    values: dict[str, np.ndarray]
    zipped: bool

    @classmethod
    def of(cls, over: Any, zipped: bool) -> "Axes":
        """The axes that a user gave. Raises `TypeError` and `ValueError`, naming the axis."""
        if not isinstance(over, Mapping) or not over:
            raise TypeError(
                f'over must be a dict of axes such as {{"mass": np.linspace(0.5, 2, 20)}}, but {over!r:.80} was given.'
            )
        values = {name: _axis(name, given) for name, given in over.items()}
        if zipped and len({len(axis) for axis in values.values()}) > 1:
            sizes = ", ".join(f"{name} has {len(axis)}" for name, axis in values.items())
            raise ValueError(f"with zip=True all axes need the same number of values, but {sizes}.")
        axes = cls(values, bool(zipped))
        twice = axes.first_repeated()
        if twice:
            raise ValueError(f"over holds {twice} twice: give every point once.")
        return axes

    @property
    def dims(self) -> tuple[str, ...]:
        """The names of the dimensions."""
        return (POINT,) if self.zipped else tuple(self.values)

    @property
    def shape(self) -> tuple[int, ...]:
        """The number of values along each dimension."""
        lengths = tuple(len(axis) for axis in self.values.values())
        return lengths[:1] if self.zipped else lengths

    @property
    def size(self) -> int:
        """The number of points."""
        return int(np.prod(self.shape))

    def at(self, numbers: np.ndarray) -> dict[str, np.ndarray]:
        """The values (B,) of every axis at the points of these numbers (B,)."""
        if self.zipped:
            return {name: axis[numbers] for name, axis in self.values.items()}
        places = np.unravel_index(numbers, self.shape)
        return {name: axis[place] for (name, axis), place in zip(self.values.items(), places, strict=True)}

    def first_repeated(self) -> str:
        """The first value of an axis, or point of axes side by side, that occurs twice, in words; "" if none does."""
        if self.zipped:
            seen: set[tuple] = set()
            for number, point in enumerate(zip(*(axis.tolist() for axis in self.values.values()), strict=True)):
                if point in seen:
                    return f"the point {described(self.at(np.array([number])))}"
                seen.add(point)
            return ""
        for name, axis in self.values.items():
            kept, counts = np.unique(axis, return_counts=True)
            if len(kept) < len(axis):
                return f"the value {kept[np.argmax(counts > 1)]!s} of {name}"
        return ""

    def positions_in(self, other: "Axes") -> tuple[np.ndarray, ...] | None:
        """Where the values of each dimension stand among those of `other`; None where one of them does not."""
        if self.zipped:
            rows = lambda axes: list(zip(*(axis.tolist() for axis in axes.values.values()), strict=True))
            return _places([(rows(self), rows(other))])
        return _places([(axis.tolist(), other.values[name].tolist()) for name, axis in self.values.items()])


def described(values: Mapping[str, np.ndarray], which: int = 0) -> str:
    """A point in words: `mass = 0.5, angle = 3.0`."""
    return ", ".join(f"{name} = {axis[which]!s}" for name, axis in values.items())


def identities(values: Mapping[str, np.ndarray], seed: int) -> np.ndarray:
    """A number (B,) of 64 bits for every point that depends on its values and on the seed alone, for its random numbers."""
    size = len(next(iter(values.values())))
    mixed = np.full(size, np.uint64(seed & (2**64 - 1)))
    for name, axis in values.items():
        word = int.from_bytes(name.encode()[:8].ljust(8, b"\0"), "little")
        mixed = _mix(_mix(mixed ^ np.uint64(word)) ^ _words(axis))
    return mixed


def _mix(words: np.ndarray) -> np.ndarray:
    """The output function of SplitMix64 (Steele, Lea, Flood 2014), a permutation of the numbers of 64 bits."""
    with np.errstate(over="ignore"):
        words = words + np.uint64(0x9E3779B97F4A7C15)
        words = (words ^ (words >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        words = (words ^ (words >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return words ^ (words >> np.uint64(31))


def _words(axis: np.ndarray) -> np.ndarray:
    if axis.dtype.kind == "U":
        import hashlib

        first = lambda text: int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "little")
        return np.array([first(text) for text in axis.tolist()], np.uint64)
    return (axis + 0.0 if axis.dtype.kind == "f" else axis.astype(np.int64)).view(np.uint64)


def _axis(name: Any, given: Any) -> np.ndarray:
    if not isinstance(name, str) or not name.isidentifier() or name in TAKEN:
        raise ValueError(
            f"over names an axis {name!r:.60}, but the name of an axis must be that of an argument of case, and none of "
            f"{', '.join(TAKEN)}."
        )
    axis = np.atleast_1d(np.asarray(list(given) if isinstance(given, range) else given))
    if axis.ndim != 1 or not axis.size or axis.dtype.kind not in "fiubU":
        came = f"an array of shape {axis.shape} and dtype {axis.dtype}"
        raise ValueError(f"over[{name!r}] must be a row of numbers or of texts, but {came} was given.")
    if axis.dtype.kind == "f" and not np.all(np.isfinite(axis)):
        raise ValueError(f"over[{name!r}] must be finite, but its entry {int(np.argmin(np.isfinite(axis)))} is not.")
    return axis.astype({"f": np.float64, "i": np.int64, "u": np.int64}.get(axis.dtype.kind, axis.dtype))


def _places(pairs: list[tuple[list, list]]) -> tuple[np.ndarray, ...] | None:
    found = []
    for mine, others in pairs:
        place = {value: number for number, value in enumerate(others)}
        if any(value not in place for value in mine):
            return None
        found.append(np.array([place[value] for value in mine]))
    return tuple(found)
