"""Loops over sites: results in pieces, compiled with as many sites at a time as vectors have lanes."""

from collections.abc import Iterable, Sequence
from contextlib import contextmanager
from functools import cache
from typing import Any, NamedTuple

import jax
import numpy as np

from dirax.engines.native.functions import trigonometric
from dirax.engines.native.functions.far_reduction import add_far_reduction
from dirax.engines.native.ir.emitter import Body, Emitter, Module
from dirax.engines.native.ir.lower import Region
from dirax.numerics.loops.kernel import WrittenKernel
from dirax.program.machine_code import has_fma, vector_width
from dirax.program.sites.courses import Course, Listed
from dirax.program.sites.pieces import Piece
from dirax.program.sites.walk import Sites

ENTRY = "sites"


class Loops(NamedTuple):
    """Compiled results of `Sites`, and the arrays that it takes beside its arguments: numbers, and lists of entries."""

    kernel: WrittenKernel
    sizes: tuple[int, ...]
    constants: tuple[Any, ...]

    def __call__(self, *arguments: Any) -> Sequence[Any]:
        """The results (size,) each of arguments of floats, in NumPy or in JAX on a CPU."""
        if self.in_numpy(arguments):
            flat = [np.ascontiguousarray(a, float).ravel() for a in arguments]
            results = [np.empty(size) for size in self.sizes]
            self.kernel(*flat, *self.constants, *results)
            return results
        flat = [jax.numpy.ravel(jax.numpy.asarray(a, float)) for a in arguments]
        shapes = [jax.ShapeDtypeStruct((size,), np.float64) for size in self.sizes]
        return self.kernel.in_jax(shapes, *flat, *self.constants)

    @staticmethod
    def in_numpy(arguments: Sequence[Any]) -> bool:
        """Whether NumPy is to find the results, of arguments of which none is JAX's."""
        return not any(isinstance(a, jax.Array) for a in arguments)


def loops(sites: Sites, arguments: int, results: Sequence[Sequence[Piece]], sizes: Sequence[int]) -> Loops:
    """The loops for results in pieces, of these sizes, of the expressions of `sites`."""
    writer = _Writer(sites, arguments, len(results))
    text = writer.text(results)
    constants = *sites.constants, *(listed.numbers for listed in writer.lists)
    kinds = ["f8"] * (arguments + len(sites.constants)) + ["i8"] * len(writer.lists) + ["f8"] * len(results)
    return Loops(_kernel(text, tuple(kinds), len(results)), tuple(sizes), constants)


@cache
def _kernel(text: str, kinds: tuple[str, ...], results: int) -> WrittenKernel:
    """The kernel of a text, of which XLA takes one."""
    return WrittenKernel(text, ENTRY, kinds, results)


class _Writer:
    def __init__(self, sites: Sites, arguments: int, results: int):
        self.sites, self.expressions, self.graph = sites, sites.expressions, sites.expressions.graph
        self.inputs, self.results = arguments + len(sites.constants), results
        self.module = Module(has_fma())
        self.body = Body(self.module)
        self.lists: dict[Listed, str] = {}
        self.entries: dict[tuple[str, str], str] = {}
        self.totals = self.body.alloca("double", max(1, len(sites.totals)))

    def text(self, results: Sequence[Sequence[Piece]]) -> str:
        for i in self._totals_in([p.node for pieces in results for p in pieces]):
            self._total(i, self.sites.totals[i])
        groups: dict[int, list[tuple[Piece, int]]] = {}
        for i, pieces in enumerate(results):
            for piece in pieces:
                groups.setdefault(piece.length, []).append((piece, i))
        for count, group in sorted(groups.items(), reverse=True):
            self._group(count, group)
        self.body.line("ret void")
        given = *(f"%a{i}" for i in range(self.inputs)), *self.lists.values(), *(f"%r{i}" for i in range(self.results))
        names = [f"ptr noalias {name}" for name in given]
        self.module.define(f"define void @{ENTRY}({', '.join(names)})", self.body)
        if any(self.graph.op[n] in trigonometric.MACHINE_CODE for n in range(len(self.graph))):
            add_far_reduction(self.module)
        return self.module.text()

    def _totals_in(self, nodes: Iterable[int]) -> list[int]:
        """The totals that these nodes depend on, each after those that it depends on itself."""
        found: list[int] = []
        for node in self.graph.reachable(nodes):
            place = self.expressions.places.get(node)
            if place is not None and place.argument < 0 and (number := place.course.first) not in found:
                inner = self._totals_in(p.node for p in self.sites.totals[number])
                found += [i for i in [*inner, number] if i not in found]
        return found

    def _group(self, count: int, group: list[tuple[Piece, int]]) -> None:
        """Pieces of as many entries each, in one loop."""
        nodes = [piece.node for piece, _ in group]
        for k, region, e in self._regions(count, nodes):
            for (piece, i), node in zip(group, nodes, strict=True):
                self._store(e, region.value(node), i, piece, k)

    def _regions(self, count: int, nodes: list[int]) -> Iterable[tuple[str, Region, Emitter]]:
        """The values of nodes in a loop over as many entries as vectors have, and in one over those that are left."""
        width = vector_width() if count >= vector_width() else 1
        whole = count // width * width
        for e, first, stop in ((Emitter(self.body, width), 0, whole), (Emitter(self.body, 1), whole, count)):
            if first == stop:
                continue
            reached = self.graph.reachable(nodes)
            fixed = [n for n in reached if self.expressions.fixed(n)]
            outer = Region(e, self.graph)
            for node in fixed:
                if node in self.expressions.places:
                    outer.bind(node, self._load(e, node, "0"))
            outer.require(fixed)
            with self._blocks(first, stop, e.width) as k:
                inner = Region(e, self.graph, outer)
                for node in reached:
                    if node in self.expressions.places and not self.expressions.fixed(node):
                        inner.bind(node, self._load(e, node, k))
                inner.require(nodes)
                yield k, inner, e

    @contextmanager
    def _blocks(self, first: int, stop: int, width: int) -> Any:
        if stop - first == width:
            yield str(first)
            return
        with self.body.loop(first // width, stop // width) as block:
            yield self.body.put(f"mul i64 {block}, {width}")

    def _entry(self, course: Course, k: str, lane: int) -> str:
        """The number of the entry that a lane of a block from the k-th on has."""
        b = self.body
        if course.listed is None:
            return b.put(f"add i64 {course.first + lane * course.step}, {b.put(f'mul i64 {course.step}, {k}')}")
        name = self.lists.setdefault(course.listed, f"%l{len(self.lists)}")
        key = name, f"{k}+{lane}"
        if key not in self.entries:  # in this block: k is named once
            self.entries[key] = b.load("i64", b.at("i64", name, b.put(f"add i64 {lane}, {k}")))
        return b.put(f"add i64 {course.first}, {self.entries[key]}")

    def _load(self, e: Emitter, node: int, k: str) -> str:
        b, (argument, course) = self.body, self.expressions.places[node]
        array = self.totals if argument < 0 else f"%a{argument}"
        at = lambda lane: b.at("double", array, self._entry(course, k, lane))
        if course.fixed:
            return e.splat(b.load("double", at(0)))
        if course.step == 1 or e.width == 1:
            return b.load(e.real, at(0))
        return e.pack([b.load("double", at(lane)) for lane in range(e.width)])

    def _store(self, e: Emitter, value: str, result: int, piece: Piece, k: str) -> None:
        b = self.body
        at = lambda lane: b.at("double", f"%r{result}", self._entry(piece.course, k, lane))
        if piece.course.step == 1 or e.width == 1:
            b.store(e.real, value, at(0))
            return
        for lane in range(e.width):
            b.store("double", e.extract(value, lane), at(lane))

    def _total(self, number: int, pieces: Sequence[Piece]) -> None:
        """The sum of an array, of every lane by itself and then of the lanes."""
        place = self.body.at("double", self.totals, number)
        self.body.store("double", Emitter(self.body, 1).const(0.0), place)
        for piece in pieces:
            sums: dict[int, str] = {}
            for width in {1, vector_width()}:
                e = Emitter(self.body, width)
                sums[width] = self.body.alloca(e.real)
                self.body.store(e.real, e.const(0.0), sums[width])
            for _, region, e in self._regions(piece.length, [piece.node]):
                before = self.body.load(e.real, sums[e.width])
                self.body.store(e.real, e.add(before, region.value(piece.node)), sums[e.width])
            for width, where in sums.items():
                e = Emitter(self.body, width)
                vector = self.body.load(e.real, where)
                for lane in range(width):
                    total = self.body.load("double", place)
                    one = Emitter(self.body, 1)
                    self.body.store("double", one.add(total, e.extract(vector, lane)), place)
