"""Pieces: entries start, start + step, … of an array that are one expression, whose inputs are entries of arguments.

An input `Place(argument, first, along)` is, for the k-th entry of a piece, entry first + along·k of that argument. Entries of an
array are numbered by rows, whatever its shape.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from dirax.program.graph import Graph

MOST = 64
"""Pieces of an array; one of more is not made of sites."""

USUAL_PERIODS, LONGEST_PERIOD = (1, 2, 3, 4, 6), 64
"""Steps of pieces that are looked for in any array; the longest of those that shapes suggest."""


class NotBySites(Exception):
    """Raised where an array is not a few pieces, or a function is not known entry by entry; says what was in the way."""


class Place(NamedTuple):
    """Where an input of an expression is."""

    argument: int
    first: int
    along: int


class Piece(NamedTuple):
    """Entries start + step·k, k = 0 … length − 1, of an array, which are `node` of a graph."""

    start: int
    step: int
    length: int
    node: int


class Expressions:
    """A graph whose inputs are places of arguments."""

    def __init__(self) -> None:
        self.graph = Graph()
        self.places: dict[int, Place] = {}
        self._moved: dict[tuple[int, int, int], int] = {}
        self._fixed: dict[int, bool] = {}

    def input(self, place: Place) -> int:
        """The node of an input."""
        node = self.graph.input(":".join(map(str, place)))
        self.places[node] = place
        return node

    def fixed(self, node: int) -> bool:
        """Whether a node is the same for all entries of its piece."""
        if node not in self._fixed:
            for n in self.graph.reachable([node], self._fixed):
                along = self.places[n].along if n in self.places else 0
                self._fixed[n] = not along and all(self._fixed[a] for a in self.graph.args[n])
        return self._fixed[node]

    def moved(self, node: int, first: int, along: int) -> int:
        """The node whose k-th entry is entry first + along·k of this one."""
        if (first == 0 and along == 1) or self.fixed(node):
            return node
        g, known = self.graph, self._moved
        key = lambda n: (n, first, along)
        for n in g.reachable([node]):
            if key(n) not in known:
                if n in self.places:
                    argument, at, by = self.places[n]
                    known[key(n)] = self.input(Place(argument, at + by * first, by * along))
                else:
                    known[key(n)] = g.make(g.op[n], *(known[key(a)] for a in g.args[n])) if g.args[n] else n
        return known[key(node)]


def shared(e: Expressions, arrays: Sequence[Sequence[Piece]]) -> list[tuple[Piece, list[int]]]:
    """Pieces on which each of these arrays of one size is one expression: (the piece, of no node, the nodes of the arrays)."""
    found = [(p, [p.node]) for p in arrays[0]]
    for array in arrays[1:]:
        if len(found) == len(array) and all(p[:3] == q[:3] for (p, _), q in zip(found, array, strict=True)):
            found = [(p, [*nodes, q.node]) for (p, nodes), q in zip(found, array, strict=True)]
            continue
        new = []
        for p, nodes in found:
            for q in array:
                if (both := _meeting(p, q)) is not None:
                    (start, step, count), own, other = both
                    moved = [e.moved(node, *own) for node in nodes]
                    new.append((Piece(start, step, count, 0), [*moved, e.moved(q.node, *other)]))
        found = _few(new)
    return found


def _meeting(p: Piece, q: Piece) -> tuple[tuple[int, int, int], tuple[int, int], tuple[int, int]] | None:
    """The entries that two pieces have in common as (start, step, count), and as (first, along) of either."""
    step = math.lcm(p.step, q.step)
    low, high = max(p.start, q.start), min(p.start + p.step * (p.length - 1), q.start + q.step * (q.length - 1))
    if low > high or (p.start - q.start) % math.gcd(p.step, q.step):
        return None
    first = low + (p.start - low) % p.step
    while (first - q.start) % q.step:
        first += p.step
    if first > high:
        return None
    count = (high - first) // step + 1
    along = lambda x: ((first - x.start) // x.step, step // x.step if count > 1 else 0)
    return (first, step if count > 1 else 1, count), along(p), along(q)


def _few(pieces: list) -> list:
    if len(pieces) > MOST:
        raise NotBySites(f"an array is more than {MOST} different expressions")
    return pieces


def gathered(e: Expressions, pieces: Sequence[Piece], size: int, entries: np.ndarray, periods: Sequence[int]) -> list[Piece]:
    """The pieces of the array whose entries are those with these numbers of one of `size` in `pieces`; −1 for zero."""
    of, number = np.full(size + 1, -1), np.zeros(size + 1, np.int64)
    for i, p in enumerate(pieces):
        where = slice(p.start, p.start + p.step * (p.length - 1) + 1, p.step)
        of[where] = i
        number[where] = 0 if e.fixed(p.node) else np.arange(p.length)
    flat = entries.ravel()
    of, number = of[flat], number[flat]
    nodes = [*(p.node for p in pieces), e.graph.zero]
    made = lambda start, step, count, i, first, along: Piece(start, step, count, e.moved(nodes[i], first, along))
    return [made(*run) for run in progressions(of, number, [*periods, *(p.step for p in pieces)])]


def progressions(of: np.ndarray, number: np.ndarray, periods: Sequence[int]) -> list[tuple[int, ...]]:
    """(start, step, count, value of `of`, first, along) such that `number` is first + along·k at the k-th; of the steps
    `periods` that with the fewest."""
    best: list[tuple[int, ...]] | None = None
    for period in sorted({p for p in periods if p <= LONGEST_PERIOD} | {*USUAL_PERIODS}):
        if best is not None and len(best) <= period:
            break
        found: list[tuple[int, ...]] | None = []
        for c in range(min(period, len(of))):
            runs = _runs(of[c::period], number[c::period])
            if runs is None:
                found = None
                break
            for first, count in runs:
                at = c + period * first
                along = int(number[at + period] - number[at]) if count > 1 else 0
                found.append((at, period if count > 1 else 1, count, int(of[at]), int(number[at]), along))
        if found is not None and (best is None or len(found) < len(best)):
            best = found
    if best is None:
        raise NotBySites(f"an array is more than {MOST} different expressions")
    return _few(best)


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
