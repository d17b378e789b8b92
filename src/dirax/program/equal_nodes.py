"""Nodes that are equal as functions, found by their values modulo a prime, where arithmetic is exact.

Second derivatives come out of a graph in either order, and mass matrices several times over: equal, but of other nodes. At a
random point modulo a prime p of 61 bits two rational functions that differ have the same value with a probability of their
degree over p (Schwartz 1980, Zippel 1979), whatever their units are. A sine and the cosine of the same argument are a random
point of the circle; of other functions it is known alone that they are equal where their arguments are.
"""

import math
import random
from collections.abc import Hashable, Iterable
from functools import reduce
from operator import or_

from dirax.program.graph import Graph

PRIME = 1514679813233062019
"""The next after a number drawn at random of which 2 is a primitive root. Floats are whole numbers times powers of 2, and 2⁶¹ = 1
modulo 2⁶¹ − 1: there the roundoff in 1 + 2⁻⁶² has the value of a number as large as 1."""

TOTAL = frozenset(("add", "sub", "mul", "neg", "sin", "cos", "held", "ruled"))
"""Operations whose values are finite wherever their operands are: they bring no nan into what holds them."""


def without_equals(target: Graph, source: Graph, outputs: list[int]) -> list[int]:
    """The nodes of `target` that are equal to the `outputs` of `source`, a copy of it with more nodes: of nodes that are equal,
    or opposite, one alone is taken over, but none in place of another that is finite where it is not, or that does without an
    input of it. Raises `GraphTooLarge`."""
    first, nodes = len(target), source.reachable(outputs)
    values, risks = values_modulo_prime(source, nodes), _risks(source, nodes)
    found: dict[int, int] = {}
    known: dict[int, tuple[int, int]] = {}
    for node in nodes:
        value, risk = values[node], risks[node]
        same, opposite = known.get(value), known.get(PRIME - value)
        if source.is_constant(node):
            found[node] = target.constant(source.value[node])
        elif value == 0:
            found[node] = target.zero
        elif same is not None and not same[1] & ~risk:
            found[node] = same[0]
        elif node < first:
            found[node] = node
        elif opposite is not None and not opposite[1] & ~risk:
            found[node] = target.neg(opposite[0])
        else:
            found[node] = target.make(source.op[node], *(found[a] for a in source.args[node]))
        if not source.is_boolean(node) and (same is None or (risk != same[1] and not risk & ~same[1])):
            known[value] = found[node], risk
    return [found[node] for node in outputs]


def _risks(g: Graph, nodes: Iterable[int]) -> dict[int, int]:
    """For each of these nodes, of which operands come first, a bit for every node below it, and itself, that is an input, or that
    may be infinite or nan where its own operands are finite."""
    found: dict[int, int] = {}
    own = 1
    for node in nodes:
        found[node] = reduce(or_, (found[a] for a in g.args[node]), 0)
        if g.op[node] not in TOTAL and not g.is_constant(node):
            found[node] |= own
            own <<= 1
    return found


def values_modulo_prime(g: Graph, nodes: Iterable[int]) -> dict[int, int]:
    """The value of each of these nodes, of which operands come first, at one point, the same for the same graph."""
    numbers, points = random.Random(20230331), {}
    values: dict[int, int] = {}

    def at_random(*key: Hashable) -> int:
        if key not in points:
            points[key] = numbers.randrange(1, PRIME)
        return points[key]

    def function(op: str, *a: int) -> int:
        if op in ("sin", "cos"):
            angle = min(a[0], PRIME - a[0])
            t = at_random("circle", angle)
            share = _inverse(1 + t * t)
            return (1 - t * t) * share if op == "cos" else (2 if a[0] == angle else -2) * t * share
        return _inverse(a[0]) if op == "recip" and a[0] else at_random(op, *a)

    for node in nodes:
        op, a = g.op[node], [values[operand] for operand in g.args[node]]
        if op == "add":
            value = a[0] + a[1]
        elif op == "sub":
            value = a[0] - a[1]
        elif op == "mul":
            value = a[0] * a[1]
        elif op == "neg":
            value = -a[0]
        elif op in ("held", "ruled"):
            value = a[0]
        elif (number := g.number(node)) is not None and math.isfinite(number):
            numerator, denominator = number.as_integer_ratio()
            value = numerator * _inverse(denominator)
        elif op == "opaque":
            value = at_random(op, node)
        else:
            value = function(op, *a) if a else at_random(op, repr(g.value[node]))
        values[node] = value % PRIME
    return values


def _inverse(x: int) -> int:
    return pow(x, -1, PRIME)
