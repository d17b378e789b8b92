"""Courses: which entries of an array, in order: first, first + step, … as along a chain, or any numbers in a list, as in a
lattice of several dimensions or a graph."""

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

MOST = 96
"""Pieces of an array; one of more is not made of sites."""

USUAL_PERIODS, LONGEST_PERIOD = (1, 2, 3, 4, 6), 64
"""Steps of pieces that are looked for in any array; the longest of those that shapes suggest."""

FEW, LONG = (4, 12), 64
"""Progressions, for each expression, into which entries are taken apart rather than listed, and so many where they are as long as
this: the ends of a chain, and the rows of a small matrix."""


class NotBySites(Exception):
    """Raised where an array is not a few pieces, or a function is not known entry by entry; says what was in the way."""


class Listed:
    """Whole numbers (n,), the first of them 0, compared by value."""

    def __init__(self, numbers: np.ndarray):
        self.numbers = numbers

    @cached_property
    def _bytes(self) -> bytes:
        return self.numbers.tobytes()

    @cached_property
    def _hash(self) -> int:
        return hash(self._bytes)

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Listed) and (self is other or (hash(self) == hash(other) and self._bytes == other._bytes))


class Course(NamedTuple):
    """The numbers first + step·k, or first + listed_k, for k = 0, 1, …"""

    first: int
    step: int
    listed: Listed | None = None

    @classmethod
    def of(cls, numbers: np.ndarray) -> "Course":
        """That of these numbers."""
        steps = np.diff(numbers)
        if len(steps) and np.any(steps != steps[0]):
            return cls(int(numbers[0]), 0, Listed(np.ascontiguousarray(numbers - numbers[0])))
        return cls(int(numbers[0]), int(steps[0]) if len(steps) else 0)

    def numbers(self, count: int) -> np.ndarray:
        """The first of them, as many as asked for."""
        return self.first + (self.step * np.arange(count) if self.listed is None else self.listed.numbers[:count])

    def at(self, other: "Course", count: int) -> "Course":
        """Those whose k-th is the number other_k of this, for so many k."""
        if self.listed is not None:
            if other == ALL and len(self.listed.numbers) == count:
                return self
            return Course.of(self.first + self.listed.numbers[other.numbers(count)])
        if other.listed is None or self.step == 0:
            return Course(self.first + self.step * other.first, self.step * other.step)
        if self.step == 1:
            return other._replace(first=self.first + other.first)
        return Course.of(self.first + self.step * other.numbers(count))

    @property
    def fixed(self) -> bool:
        """Whether all are one number."""
        return self.step == 0 and self.listed is None


ALL = Course(0, 1)


def entries_of(entries: np.ndarray) -> Course:
    """The course of entries of an array, in which a single one takes a step of 1."""
    course = Course.of(entries)
    return course._replace(step=1) if course.fixed else course


def few(pieces: list) -> list:
    """The pieces; raises `NotBySites` for more than MOST."""
    if len(pieces) > MOST:
        raise NotBySites(f"an array is more than {MOST} different expressions")
    return pieces


def taken_apart(of: np.ndarray, number: np.ndarray, periods: Sequence[int]) -> list[tuple[Course, int, int, Course]]:
    """(entries, their count, their value of `of`, their values of `number`): a few progressions, or one list for each value of
    `of`."""
    values = np.unique(of).tolist()
    runs = progressions(of, number, periods)
    if runs is not None and len(runs) <= FEW[len(of) >= LONG * len(runs)] * len(values):
        return few([(Course(a, step), count, i, Course(first, along)) for a, step, count, i, first, along in runs])
    found = ((i, np.flatnonzero(of == i)) for i in values)
    return few([(entries_of(entries), len(entries), i, Course.of(number[entries])) for i, entries in found])


def progressions(of: np.ndarray, number: np.ndarray, periods: Sequence[int]) -> list[tuple[int, ...]] | None:
    """(start, step, count, value of `of`, first, along) such that `number` is first + along·k at the k-th; of the steps
    `periods` that with the fewest; None for too many."""
    best: list[tuple[int, ...]] | None = None
    for period in sorted({p for p in periods if 0 < p <= LONGEST_PERIOD} | {*USUAL_PERIODS}):
        if best is not None and len(best) <= period:
            break
        found: list[tuple[int, ...]] = []
        for c in range(min(period, len(of))):
            runs = _runs(of[c::period], number[c::period])
            if runs is None:
                break
            for first, count in runs:
                at = c + period * first
                along = int(number[at + period] - number[at]) if count > 1 else 0
                found.append((at, period if count > 1 else 1, count, int(of[at]), int(number[at]), along))
        else:
            if best is None or len(found) < len(best):
                best = found
    return best


def _runs(of: np.ndarray, number: np.ndarray) -> list[tuple[int, int]] | None:
    """(first, count) of stretches of one value and of numbers in arithmetic progression, the longest from the left."""
    size = len(of)
    if size == 0:
        return []
    along, same = np.diff(number), of[1:] == of[:-1]
    ends = ~same
    ends[1:] |= along[1:] != along[:-1]
    ends = np.flatnonzero(ends)  # the entry after it may not go on with a stretch from further left
    if len(ends) > 4 * MOST:
        return None
    found, at = [], 0
    while at < size:
        if at == size - 1 or not same[at]:
            stop = at + 1
        else:
            place = np.searchsorted(ends, at + 1)
            stop = int(ends[place]) + 1 if place < len(ends) else size
        found.append((at, stop - at))
        at = stop
    return found
