"""Labels: the names of many equations, of which few are ever asked for."""

from collections.abc import Iterable, Sequence
from typing import overload

GIVEN = -1
"""The number of a name that is taken as it is."""


class Labels(Sequence[str]):
    """Names in order, those that are numbered made when they are asked for: `Labels.numbered("constraint {}", 5)`.

    Added to each other and to tuples of names like tuples; equal where they have the same parts.
    """

    def __init__(self, parts: Iterable[tuple[str, int, int]] = ()):
        self._parts = tuple(part for part in parts if part[2] > part[1])  # (name with {}, first number, one past the last)

    @classmethod
    def numbered(cls, name: str, count: int) -> "Labels":
        """`name` with {} in it, for the numbers from 0 on."""
        return cls([(name, 0, count)])

    def __len__(self) -> int:
        return sum(stop - start for _, start, stop in self._parts)

    @overload
    def __getitem__(self, index: int) -> str: ...
    @overload
    def __getitem__(self, index: slice) -> "Labels": ...

    def __getitem__(self, index):
        if isinstance(index, slice):
            start, stop, step = index.indices(len(self))
            if step != 1:
                raise IndexError("labels are taken in order, without steps.")
            return Labels(self._between(start, stop))
        index = index + len(self) if index < 0 else index
        for name, start, stop in self._parts:
            if 0 <= index < stop - start:
                return name if start == GIVEN else name.replace("{}", str(start + index))
            index -= stop - start
        raise IndexError("there are not so many labels.")

    def _between(self, first: int, last: int):
        for name, start, stop in self._parts:
            yield name, start + max(first, 0), start + min(last, stop - start)
            first, last = first - (stop - start), last - (stop - start)

    def __add__(self, other: "Labels | tuple[str, ...]") -> "Labels":
        return Labels(self._parts + _parts(other))

    def __radd__(self, other: tuple[str, ...]) -> "Labels":
        return Labels(_parts(other) + self._parts)

    def __eq__(self, other: object) -> bool:
        if isinstance(other, tuple):
            return tuple(self) == other
        return isinstance(other, Labels) and self._parts == other._parts

    def __hash__(self) -> int:
        return hash(self._parts)

    def __repr__(self) -> str:
        return f"Labels({', '.join(self[:3])}, …)" if len(self) > 4 else f"Labels({', '.join(self)})"


def _parts(labels: "Labels | tuple[str, ...]") -> tuple[tuple[str, int, int], ...]:
    return labels._parts if isinstance(labels, Labels) else tuple((name, GIVEN, GIVEN + 1) for name in labels)
