"""Pieces: entries of an array that are one expression, whose inputs are entries of arguments.

Which entries, of the array or of an argument, says a `Course`. They are numbered by rows, whatever the shape of an array.
"""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from dirax.program.graph import Graph
from dirax.program.sites.courses import ALL, Course, Listed, NotBySites, entries_of, few, taken_apart

SHORT = 64
"""Terms of a sum that are written out; longer sums of everything are loops of their own."""

LONGEST = 10_000
"""Nodes of all expressions of a function: a mesh of springs in space has 1 500, those of a few dozen bodies that all attract each
other, which have no sites, would take a second to be found for every 10 000."""


class Place(NamedTuple):
    """Where an input of an expression is: in an argument, by entries of a piece."""

    argument: int
    course: Course


class Piece(NamedTuple):
    """`length` entries of an array, which are `node` of a graph."""

    course: Course
    length: int
    node: int

    @property
    def entries(self) -> np.ndarray:
        """Their numbers."""
        return self.course.numbers(self.length)

    def shifted(self, by: int) -> "Piece":
        """The same in an array that begins earlier."""
        return self._replace(course=self.course._replace(first=self.course.first + by))


class Expressions:
    """A graph whose inputs are places of arguments."""

    def __init__(self) -> None:
        self.graph = Graph(LONGEST)
        self.places: dict[int, Place] = {}
        self._lists: dict[Listed, int] = {}
        self._moved: dict[tuple[int, Course, int], int] = {}
        self._fixed: dict[int, bool] = {}

    def input(self, place: Place) -> int:
        """The node of an input."""
        first, step, listed = place.course
        name = [place.argument, first, step] + ([] if listed is None else [self._lists.setdefault(listed, len(self._lists))])
        node = self.graph.input(":".join(map(str, name)))
        self.places[node] = place
        return node

    def fixed(self, node: int) -> bool:
        """Whether a node is the same for all entries of its piece."""
        if node not in self._fixed:
            for n in self.graph.reachable([node], self._fixed):
                here = n not in self.places or self.places[n].course.fixed
                self._fixed[n] = here and all(self._fixed[a] for a in self.graph.args[n])
        return self._fixed[node]

    def moved(self, node: int, course: Course, count: int) -> int:
        """The node whose k-th entry is that of this one with the number course_k, of so many entries."""
        if self.fixed(node) or (course == ALL and not self._lists):  # of a list fewer entries may be taken
            return node
        g, known = self.graph, self._moved
        key = lambda n: (n, course, count)
        for n in g.reachable([node]):
            if key(n) not in known:
                if n in self.places:
                    argument, own = self.places[n]
                    known[key(n)] = self.input(Place(argument, own.at(course, count)))
                else:
                    known[key(n)] = g.make(g.op[n], *(known[key(a)] for a in g.args[n])) if g.args[n] else n
        return known[key(node)]


def shared(e: Expressions, arrays: Sequence[Sequence[Piece]]) -> list[tuple[Piece, list[int]]]:
    """Pieces on which each of these arrays of one size is one expression: (the piece, of no node, the nodes of the arrays)."""
    found = [(p, [p.node]) for p in arrays[0]]
    for array in arrays[1:]:
        if len(found) == len(array) and all(p[:2] == q[:2] for (p, _), q in zip(found, array, strict=True)):
            found = [(p, [*nodes, q.node]) for (p, nodes), q in zip(found, array, strict=True)]
            continue
        listed = any(p.course.listed is not None for p in (*array, *(p for p, _ in found)))
        found = few([*(_listed_meetings if listed else _meetings)(e, found, array)])
    return found


def _meetings(e: Expressions, found: list, array: Sequence[Piece]) -> list:
    """Of progressions."""
    new = []
    for p, nodes in found:
        for q in array:
            if (both := _meeting(p, q)) is not None:
                (start, step, count), own, other = both
                moved = [e.moved(node, Course(*own), count) for node in nodes]
                new.append((Piece(Course(start, step), count, 0), [*moved, e.moved(q.node, Course(*other), count)]))
    return new


def _listed_meetings(e: Expressions, found: list, array: Sequence[Piece]) -> list:
    """Of pieces of any kind: entry by entry."""
    size = sum(p.length for p, _ in found)
    (of, number), (of_other, other) = numbered([p for p, _ in found], size), numbered(array, size)
    new = []
    for both in np.unique(of * len(array) + of_other).tolist():
        i, j = divmod(both, len(array))
        entries = np.flatnonzero((of == i) & (of_other == j))
        courses = [Course.of(numbers[entries]) for numbers in (number, other)]
        moved = [e.moved(node, courses[0], len(entries)) for node in found[i][1]]
        new.append((Piece(entries_of(entries), len(entries), 0), [*moved, e.moved(array[j].node, courses[1], len(entries))]))
    return new


def numbered(pieces: Sequence[Piece], size: int) -> tuple[np.ndarray, np.ndarray]:
    """Of each entry of an array its piece, −1 for none, and its number in it."""
    of, number = np.full(size, -1), np.zeros(size, np.int64)
    for i, p in enumerate(pieces):
        first, step, listed = p.course
        where = p.entries if listed is not None else slice(first, first + step * (p.length - 1) + 1, max(step, 1))
        of[where], number[where] = i, np.arange(p.length)
    return of, number


def combined(e: Expressions, op: str, *arrays: Sequence[Piece]) -> list[Piece]:
    """An operation on arrays of one size, entry by entry."""
    return [piece._replace(node=e.graph.make(op, *nodes)) for piece, nodes in shared(e, arrays)]


def one_at_a_time(targets: np.ndarray, size: int) -> Iterator[np.ndarray]:
    """Which of the terms that are to be added to their `targets`, entries of an array of this size, comes next at each of them,
    −1 for none. Raises `NotBySites` for too many at one entry."""
    order = np.argsort(targets, kind="stable")
    order = order[targets[order] >= 0]
    at = targets[order]
    rank = np.arange(len(at)) - np.searchsorted(at, at)
    if len(at) and rank.max() >= SHORT:
        raise NotBySites("too many terms are added to one entry")
    for r in range(int(rank.max(initial=-1)) + 1):
        entries = np.full(size, -1)
        entries[at[rank == r]] = order[rank == r]
        yield entries


def _meeting(p: Piece, q: Piece) -> tuple[tuple[int, int, int], tuple[int, int], tuple[int, int]] | None:
    """The entries that two pieces have in common as (start, step, count), and as (first, along) of either."""
    (start, by, _), (other, beside, _) = p.course, q.course
    step = math.lcm(by, beside)
    low, high = max(start, other), min(start + by * (p.length - 1), other + beside * (q.length - 1))
    if low > high or (start - other) % math.gcd(by, beside):
        return None
    first = low + (start - low) % by
    while (first - other) % beside:
        first += by
    if first > high:
        return None
    count = (high - first) // step + 1
    along = lambda own, by: ((first - own) // by, step // by if count > 1 else 0)
    return (first, step if count > 1 else 1, count), along(start, by), along(other, beside)


def gathered(e: Expressions, pieces: Sequence[Piece], size: int, entries: np.ndarray, periods: Sequence[int]) -> list[Piece]:
    """The pieces of the array whose entries are those with these numbers of one of `size` in `pieces`; −1 for zero."""
    of, number = numbered(pieces, size + 1)
    for i, p in enumerate(pieces):
        if e.fixed(p.node):
            number[of == i] = 0
    flat = entries.ravel()
    of, number = of[flat], number[flat]
    nodes = [*(p.node for p in pieces), e.graph.zero]
    courses = taken_apart(of, number, [*periods, *(p.course.step for p in pieces)])
    return [Piece(course, count, e.moved(nodes[i], among, count)) for course, count, i, among in courses]
