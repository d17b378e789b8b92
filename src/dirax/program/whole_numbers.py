"""Whole numbers in a graph of floats: how large they can be, and what they are where their type wraps around."""

import math

import numpy as np

from dirax.program.graph import CONSTANT, Graph

EXACT = 2.0**53
"""The size up to which floats are all whole numbers."""

FROM_FLOATS = 2.0**26
"""The size that a float is taken to have at most which is made an int64, an index most often: the product of two is exact."""

Range = tuple[float, float]


def are_floats(numbers: np.ndarray) -> bool:
    """Whether floats have all of these whole numbers; the limits of their type, which bound others, need not be exact."""
    limits, flat = np.iinfo(numbers.dtype), numbers.ravel()
    large = flat[(flat >= EXACT) | (flat <= -EXACT)].tolist()
    return all(int(float(x)) == x or x in (limits.min, limits.max) for x in large)


class Ranges:
    """The least and the largest value of nodes that are whole numbers."""

    def __init__(self, graph: Graph):
        self.graph = graph
        self._known: dict[int, Range] = {}

    def given(self, nodes: np.ndarray, dtype: np.dtype) -> None:
        """Note that nodes are any numbers of a type; those of 64 bits, such as Python's own, are taken for those of floats."""
        if np.iinfo(dtype).bits < 64:
            for node in nodes.ravel().tolist():
                self._within(node, dtype)

    def wrapped(self, node: int, dtype: np.dtype) -> int | None:
        """A whole number in a type: as it is where it cannot leave it, else modulo the size of the type; None where floats do not
        have all the numbers that it may be."""
        limits, (low, high) = np.iinfo(dtype), self.of(node)
        if not -EXACT <= low <= high <= EXACT:
            return None
        if limits.min <= low and high <= limits.max:
            return node
        if limits.bits == 64:
            return None
        g, size = self.graph, 2.0**limits.bits
        least = g.constant(float(limits.min))
        above = g.sub(node, least)
        turns = g.make("floor", g.mul(g.constant(1 / size), above))  # exact: the size is a power of two
        return self._within(g.add(g.sub(above, g.mul(g.constant(size), turns)), least), dtype)

    def saturated(self, node: int, dtype: np.dtype) -> int:
        """A whole number made of a float, in a type: the nearest one that the type has."""
        g, limits = self.graph, np.iinfo(dtype)
        if limits.bits == 64:
            return node
        return self._within(
            g.make("min", g.make("max", node, g.constant(float(limits.min))), g.constant(float(limits.max))), dtype
        )

    def _within(self, node: int, dtype: np.dtype) -> int:
        if not self.graph.is_constant(node):
            self._known[node] = float(np.iinfo(dtype).min), float(np.iinfo(dtype).max)
        return node

    def of(self, node: int) -> Range:
        """The range of a node."""
        args, known, stack = self.graph.args, self._known, [node]
        while stack:
            n = stack[-1]
            missing = [a for a in self._operands(n) if a not in known]
            if missing and n not in known:
                stack += missing
                continue
            stack.pop()
            if n not in known:
                known[n] = self._found(self.graph.op[n], n, [known[a] for a in self._operands(n)] if args[n] else [])
        return known[node]

    def _operands(self, node: int) -> tuple[int, ...]:
        op, args = self.graph.op[node], self.graph.args[node]
        return args[1:] if op == "select" else args[:1] if op == "ruled" else args if op in FOLLOWED else ()

    def _found(self, op: str, node: int, of: list[Range]) -> Range:
        if op in CONSTANT:
            value = float(self.graph.value[node])
            return (value, value) if math.isfinite(value) else (-math.inf, math.inf)
        return FOLLOWED[op](*of) if op in FOLLOWED else (-FROM_FLOATS, FROM_FLOATS)


def _product(x: Range, y: Range) -> Range:
    corners = [a * b if a and b else 0.0 for a in x for b in y]
    return min(corners), max(corners)


def _remainder(x: Range, y: Range) -> Range:
    most = min(max(map(abs, x)), max(map(abs, y)))
    return (-most if x[0] < 0 else 0.0), (most if x[1] > 0 else 0.0)


FOLLOWED = {
    "add": lambda x, y: (x[0] + y[0], x[1] + y[1]),
    "sub": lambda x, y: (x[0] - y[1], x[1] - y[0]),
    "mul": _product,
    "neg": lambda x: (-x[1], -x[0]),
    "abs": lambda x: (0.0, max(map(abs, x))),
    "sign": lambda x: (-1.0, 1.0),
    "max": lambda x, y: (max(x[0], y[0]), max(x[1], y[1])),
    "min": lambda x, y: (min(x[0], y[0]), min(x[1], y[1])),
    "rem": _remainder,
    "select": lambda x, y: (min(x[0], y[0]), max(x[1], y[1])),
    "held": lambda x: x,
    "ruled": lambda x: x,
}
"""The range of an operation from those of its operands; of any other it is that of a number made of a float."""
