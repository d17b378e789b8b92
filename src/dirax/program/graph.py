"""Scalar expressions, each built once: constants folded, zeros and ones simplified away, equal expressions shared."""

import functools
import itertools
import math
import operator
import struct
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, ClassVar, cast

import numpy as np

from dirax.program.operations import BOOLEAN, COMMUTATIVE, NUMPY, evaluate_one

CONSTANT = frozenset({"const", "bool"})

NODE_LIMIT = 60_000
"""Most scalar operations of one step; beyond it an array program is faster to compile, and to run."""

MAX_POWER = 64
"""Largest whole exponent written out as multiplications."""


_bits = struct.Struct("d").pack


class GraphTooLarge(Exception):
    """More nodes than the limit of the graph."""


class Graph:
    """A hash-consed expression graph over float64 and bool scalars.

    A node is a number; `op[i]` names its operation, `args[i]` its operands (smaller numbers), `value[i]` holds the value
    of a constant or the name of an input. Division a/b is a·recip(b), so that reciprocals are shared.
    Raises `GraphTooLarge` when `limit` nodes are not enough.
    """

    def __init__(self, limit: int = 1_000_000):
        self.op: list[str] = []
        self.args: list[tuple[int, ...]] = []
        self.value: dict[int, float | bool | str] = {}
        self.limit = limit
        self.slopes: dict[int, list[int | None]] = {}
        self.at_rest: dict[int, int] = {}
        self._known: dict[tuple, int] = {}
        self.zero, self.one = self.constant(0.0), self.constant(1.0)
        self.false, self.true = self.constant(False), self.constant(True)

    def __len__(self) -> int:
        return len(self.op)

    def copy(self, limit: int = 1_000_000) -> "Graph":
        """A graph of the same nodes, to which others can be added."""
        other = Graph(limit)
        other.op, other.args, other.value = self.op.copy(), self.args.copy(), self.value.copy()
        other.slopes, other.at_rest, other._known = self.slopes.copy(), self.at_rest.copy(), self._known.copy()
        return other

    @contextmanager
    def with_limit(self, limit: int) -> Iterator[None]:
        """Another limit, within."""
        before, self.limit = self.limit, limit
        try:
            yield
        finally:
            self.limit = before

    # ------------------------------------------------------------------ leaves

    def constant(self, value) -> int:
        """The node of a float64 or a bool."""
        if isinstance(value, bool | np.bool_):
            return self._intern("bool", (), bool(value), ("bool", bool(value)))
        number = float(value)
        return self._intern("const", (), number, ("const", _bits(number)))

    def input(self, name: str) -> int:
        """The node of a named scalar that is known at run time."""
        return self._intern("input", (), name, ("input", name))

    def opaque(self, operands: list[int], slopes: list[int | None]) -> int:
        """The node of a function of these operands of which only its derivatives by them, `slopes`, are known here."""
        node = self._intern("opaque", tuple(operands), None, ("opaque", len(self.slopes)))
        self.slopes[node] = slopes
        return node

    def is_constant(self, node: int) -> bool:
        return self.op[node] in CONSTANT

    def is_boolean(self, node: int) -> bool:
        return self.op[node] in BOOLEAN

    def number(self, node: int) -> float | None:
        """The value of a float64 constant, None for any other node."""
        return self.value[node] if self.op[node] == "const" else None  # type: ignore[return-value]

    def _intern(self, op: str, args: tuple[int, ...], value, key: tuple) -> int:
        node = self._known.get(key)
        if node is None:
            node = len(self.op)
            if node >= self.limit:
                raise GraphTooLarge(f"more than {self.limit} scalar operations")
            self.op.append(op)
            self.args.append(args)
            if value is not None:
                self.value[node] = value
            self._known[key] = node
        return node

    def make(self, op: str, *args: int) -> int:
        """The node op(args), simplified."""
        if op == "select":
            return self._select(*args)
        ops = self.op
        for a in args:
            if ops[a] not in CONSTANT:
                break
        else:
            return self.constant(evaluate_one(op, *(self.value[a] for a in args)))
        simplified = self._simplified.get(op)
        return simplified(self, *args) if simplified else self._plain(op, *args)

    def _plain(self, op: str, *args: int) -> int:
        if op in COMMUTATIVE and args[1] < args[0]:
            args = args[::-1]
        key = (op, *args)
        node = self._known.get(key)
        return self._intern(op, args, None, key) if node is None else node

    # ------------------------------------------------------------------ arithmetic

    # the first three go the way of `make`, a little faster: a graph is mostly made of them

    def add(self, a: int, b: int) -> int:
        known = self.op[a] in CONSTANT and self.op[b] in CONSTANT
        return self.make("add", a, b) if known else self._add(a, b)

    def sub(self, a: int, b: int) -> int:
        known = self.op[a] in CONSTANT and self.op[b] in CONSTANT
        return self.make("sub", a, b) if known else self._sub(a, b)

    def mul(self, a: int, b: int) -> int:
        known = self.op[a] in CONSTANT and self.op[b] in CONSTANT
        return self.make("mul", a, b) if known else self._mul(a, b)

    def neg(self, a: int) -> int:
        return self.make("neg", a)

    def recip(self, a: int) -> int:
        return self.make("recip", a)

    def div(self, a: int, b: int) -> int:
        return self.one if a == b else self.mul(a, self.recip(b))

    def select(self, condition: int, yes: int, no: int) -> int:
        return self.make("select", condition, yes, no)

    def negated(self, a: int) -> int | None:
        """x where a is −x."""
        return self.args[a][0] if self.op[a] == "neg" else None

    def _add(self, a: int, b: int) -> int:
        if a == self.zero or b == self.zero:
            return b if a == self.zero else a
        if (x := self.negated(b)) is not None:
            return self.sub(a, x)
        if (x := self.negated(a)) is not None:
            return self.sub(b, x)
        return self.mul(self.constant(2.0), a) if a == b else self._plain("add", a, b)

    def _sub(self, a: int, b: int) -> int:
        if b == self.zero:
            return a
        if a == self.zero:
            return self.neg(b)
        if a == b:
            return self.zero
        if (x := self.negated(b)) is not None:
            return self.add(a, x)
        if (x := self.negated(a)) is not None:
            return self.neg(self.add(x, b))
        return self._plain("sub", a, b)

    def _neg(self, a: int) -> int:
        if (x := self.negated(a)) is not None:
            return x
        if self.op[a] == "sub":
            return self.sub(*self.args[a][::-1])
        if self.op[a] == "mul" and (c := self.number(self.args[a][0])) is not None:
            return self.mul(self.constant(-c), self.args[a][1])
        return self._plain("neg", a)

    def _mul(self, a: int, b: int) -> int:
        ops, args = self.op, self.args
        if ops[b] in CONSTANT:
            a, b = b, a
        of_a, of_b = ops[a], ops[b]
        if of_a == "const":
            c = cast(float, self.value[a])
            if c in (0.0, 1.0, -1.0):
                return self.zero if c == 0 else b if c == 1 else self.neg(b)
            if of_b == "neg":
                return self.mul(self.constant(-c), args[b][0])
            if of_b == "mul" and (d := self.number(args[b][0])) is not None and _plain_number(c * d):
                return self.mul(self.constant(c * d), args[b][1])
            return self._intern("mul", (a, b), None, ("mul", a, b))
        if of_a == "neg":
            return self.neg(self.mul(args[a][0], b))
        if of_b == "neg":
            return self.neg(self.mul(a, args[b][0]))
        for x, of_x, y in ((a, of_a, b), (b, of_b, a)):
            if of_x == "mul" and ops[args[x][0]] in CONSTANT:  # constants come out in front
                return self.mul(args[x][0], self.mul(args[x][1], y))
            if of_x == "select" and args[x][1:] == (self.one, self.zero):
                return self.select(args[x][0], y, self.zero)
        return self._plain("mul", a, b)

    def _recip(self, a: int) -> int:
        if self.op[a] == "recip":
            return self.args[a][0]
        if (x := self.negated(a)) is not None:
            return self.neg(self.recip(x))
        if self.op[a] == "mul" and (c := self.number(self.args[a][0])) is not None and _plain_number(1 / c):
            return self.mul(self.constant(1 / c), self.recip(self.args[a][1]))
        return self._plain("recip", a)

    def power(self, x: int, n: int) -> int:
        """x to a whole power, by squaring."""
        if n < 0:
            return self.recip(self.power(x, -n))
        result = None
        while n:
            if n & 1:
                result = x if result is None else self.mul(result, x)
            n >>= 1
            x = self.mul(x, x) if n else x
        return self.one if result is None else result

    def _pow(self, x: int, y: int) -> int:
        c = self.number(y)
        if c is not None and abs(c) <= MAX_POWER and float(c).is_integer():
            return self.power(x, int(c))
        if c is not None and abs(c) <= MAX_POWER and float(2 * c).is_integer():
            whole = math.floor(c)
            return self.mul(self.power(x, whole), self.make("sqrt", x))
        return self._plain("pow", x, y)

    def half_power(self, node: int) -> tuple[int, int, int] | None:
        """(√(c·x), x, n ≥ 1) where a node is xⁿ·√(c·x), None for any other."""
        if self.op[node] != "mul":
            return None
        for root, factor in (self.args[node], self.args[node][::-1]):
            if self.op[root] == "sqrt":
                x = self._without_factor(self.args[root][0])
                if n := self._degree(factor, x):
                    return root, x, n
        return None

    def _without_factor(self, a: int) -> int:
        """x where a is −x or c·x."""
        if self.op[a] == "neg" or (self.op[a] == "mul" and self.is_constant(self.args[a][0])):
            return self.args[a][-1]
        return a

    def _degree(self, a: int, x: int) -> int:
        """n where a is xⁿ, a product; zero for any other."""
        if a == x or self.op[a] != "mul":
            return int(a == x)
        first, second = self.args[a]
        n = self._degree(first, x)
        m = self._degree(second, x) if n else 0
        return n + m if m else 0

    # ------------------------------------------------------------------ logic

    def _select(self, condition: int, yes: int, no: int) -> int:
        if self.is_constant(condition):
            return yes if self.value[condition] else no
        if yes == no:
            return yes
        if self.op[condition] == "not":
            return self.select(self.args[condition][0], no, yes)
        if self.is_boolean(yes) or self.is_boolean(no):
            opposite = self.make("not", condition)
            return self.make("or", self.make("and", condition, yes), self.make("and", opposite, no))
        return self._plain("select", condition, yes, no)

    def _and(self, a: int, b: int) -> int:
        if self.false in (a, b):
            return self.false
        if self.true in (a, b):
            return b if a == self.true else a
        return a if a == b else self._plain("and", a, b)

    def _or(self, a: int, b: int) -> int:
        if self.true in (a, b):
            return self.true
        if self.false in (a, b):
            return b if a == self.false else a
        return a if a == b else self._plain("or", a, b)

    def _not(self, a: int) -> int:
        return self.args[a][0] if self.op[a] == "not" else self._plain("not", a)

    def _held(self, a: int) -> int:
        return a if self.op[a] == "held" or self.is_boolean(a) else self._plain("held", a)

    def _ruled(self, a: int, along: int) -> int:
        return self.make("held", a) if self.is_constant(along) else self._plain("ruled", a, along)

    def _max(self, a: int, b: int) -> int:
        return a if a == b else self._compared("max", a, b)

    def _min(self, a: int, b: int) -> int:
        return a if a == b else self._compared("min", a, b)

    def _compared(self, op: str, a: int, b: int) -> int:
        """A comparison, which is logic where it is one of truth values."""
        if not self.is_boolean(a):
            return self._plain(op, a, b)
        make = self.make
        if op in ("max", "min"):
            return make("or" if op == "max" else "and", a, b)
        if op in ("lt", "le"):
            return make("and" if op == "lt" else "or", make("not", a), b)
        differ = make("or", make("and", a, make("not", b)), make("and", b, make("not", a)))
        return make("not", differ) if op == "eq" else differ

    _lt, _le, _eq, _ne = (lambda self, a, b, op=op: self._compared(op, a, b) for op in ("lt", "le", "eq", "ne"))

    _simplified: ClassVar[dict[str, Callable[..., int]]] = {
        **{"add": _add, "sub": _sub, "neg": _neg, "mul": _mul, "recip": _recip, "pow": _pow},
        **{"select": _select, "and": _and, "or": _or, "not": _not, "max": _max, "min": _min},
        **{"lt": _lt, "le": _le, "eq": _eq, "ne": _ne},
        **{"held": _held, "ruled": _ruled},
    }

    # ------------------------------------------------------------------ the whole

    def reachable(self, outputs: Iterable[int], known: Container[int] = ()) -> list[int]:
        """Every node that the outputs need and that is not known, operands first."""
        seen, stack = set(), list(outputs)
        while stack:
            node = stack.pop()
            if node not in seen and node not in known:
                seen.add(node)
                stack.extend(self.args[node])
        return sorted(seen)

    def dependence(self, outputs: Sequence[int], inputs: Sequence[int]) -> np.ndarray:
        """Which of the outputs need which of the inputs, (outputs, inputs)."""
        needs, size = self._needs(outputs, inputs), -(-len(inputs) // 8)
        table = b"".join(needs[node].to_bytes(size, "little") for node in outputs)
        bits = np.unpackbits(np.frombuffer(table, np.uint8), bitorder="little").reshape(len(outputs), 8 * size)
        return bits[:, : len(inputs)].astype(bool)

    def products(self, outputs: Sequence[int], inputs: Sequence[int]) -> int:
        """How many products the derivatives of the outputs by the inputs are sums of, node by node."""
        needs = self._needs(outputs, inputs)
        return sum([needs[a].bit_count() for node in needs for a in self.args[node] if a in needs])

    def _needs(self, outputs: Sequence[int], inputs: Sequence[int]) -> dict[int, int]:
        """The inputs that each node on the way to the outputs needs, one bit each."""
        needs = {node: 1 << j for j, node in enumerate(inputs)}
        for node in self.reachable(outputs, set(needs)):
            needs[node] = functools.reduce(operator.or_, [needs[a] for a in self.args[node]], 0)
        return needs

    def replaced(self, outputs: Sequence[int], others: dict[int, int]) -> list[int]:
        """The outputs with other nodes in place of some."""
        found = dict(others)
        for node in self.reachable(outputs, others):
            args = tuple([found[a] for a in self.args[node]])
            found[node] = node if args == self.args[node] else self.make(self.op[node], *args)
        return [found[node] for node in outputs]

    def evaluate(
        self,
        outputs: Sequence[int],
        inputs: dict[str, Any],
        table: dict | None = None,
        values: dict | None = None,
        order: "Order | None" = None,
    ):
        """The list of the outputs for given inputs; NumPy by default, any array library whose functions are in `table`.

        `values` holds nodes that are known from before, and then those that were needed; `order` is how to compute the outputs,
        where that has been found before.
        """
        functions = table or NUMPY
        values = {} if values is None else values
        if order is None:
            order = Order(self.reachable(outputs, values))
        for node, ended in zip(order.nodes, order.ended or itertools.repeat(()), strict=False):
            if node in values:
                continue
            op, args = self.op[node], self.args[node]
            if len(args) == 2:
                values[node] = functions[op](values[args[0]], values[args[1]])
            elif args:
                values[node] = functions[op](*[values[a] for a in args])
            else:
                values[node] = inputs[str(self.value[node])] if op == "input" else self.value[node]
            for a in ended:
                values.pop(a, None)
        found = [values[node] for node in outputs]
        for node in order.last:
            values.pop(node, None)
        return found


@dataclass
class Order:
    """Nodes in an order in which they can be computed; after each of them those that nothing needs any more, whose values
    give their memory to the next ones; and those that nothing needs after the whole."""

    nodes: list[int]
    ended: list[list[int]] | None = None
    last: tuple[int, ...] = ()


def with_ends(graph: Graph, parts: Sequence[tuple[list[int], list[int]]], kept: Container[int] = ()) -> list[Order]:
    """The orders of parts (nodes to compute, nodes to read) that are computed one after the other; `kept` stay known, and what
    has no operands."""
    args, needed, found = graph.args, set(), []
    for nodes, read in reversed(parts):
        last = tuple([node for node in read if args[node] and node not in needed and node not in kept])
        needed.update(read)
        ended = []
        for node in reversed(nodes):
            over = [a for a in args[node] if a not in needed]
            needed.update(over)
            ended.append([a for a in over if args[a] and a not in kept])
        found.append(Order(nodes, ended[::-1], last))
    return found[::-1]


def _plain_number(x: float) -> bool:
    return math.isfinite(x) and abs(x) > 1e-290
