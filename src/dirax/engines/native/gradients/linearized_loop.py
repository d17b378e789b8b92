"""Derivatives of a run as loops over its steps in IR: tangents forward, cotangents backward, by the implicit function theorem.

A stage solves r(u, x, t, h, c) = 0 and gives a(u, x, t, h, c), c the parameters. Forward, with dots for tangents,
u̇ = −r_u⁻¹ (r_x ẋ + r_t ṫ + r_h ḣ + r_c ċ) and the next ẋ is that of a. Backward, with λ the cotangent of a and ū that of u,
r_uᵀ μ = a_uᵀ λ + ū, and the derivatives of λ·a − μ·r are those of everything else.

A lane's carry is, for each quantity, `width` doubles: ẋ or λ · of the parameters · of t0 · of h · the step before which the
trajectory ended. Its numbers are the parameters and for each stage the sizes of the unknowns, by which the rows of r_u have
units. Rows hold the state and the unknowns of a stage, then what flows in or out there, in the same order.
"""

from collections.abc import Iterable
from dataclasses import dataclass

from dirax.engines.native.ir.emitter import Body, Emitter, Module
from dirax.engines.native.ir.lower import Region
from dirax.engines.native.loops.newton_loop import by_partial_pivoting
from dirax.engines.native.shared import declare_shared
from dirax.engines.newton_step import Factors, terms_of_rows
from dirax.engines.pivot_order import pivot_order
from dirax.engines.step_program import Inputs, TracedEquation
from dirax.program.graph import Graph
from dirax.program.graph_derivatives import directional, gradient

NUMBERS = "double %t0, double %h, i64 %offset, i64 %first, i64 %count"
"""`count` steps from number `first` on of a run, whose own first state is step number `offset`."""


@dataclass
class Linearized:
    """The derivatives of one stage as nodes.

    `flow` are the inputs: (ẋ, ċ, ṫ, ḣ) forward, (λ, ū) backward. `right` is to be solved with `matrix`, the solution is
    bound to `solved`, and `out` are the next ẋ forward, the cotangents of (x, c, t, h) backward. `sizes` are inputs, those of
    the unknowns, and `rows` what they make the units of the rows of the matrix: pivots are chosen whatever the units.
    """

    flow: list[int]
    sizes: list[int]
    rows: list[int]
    matrix: list[list[int]]
    right: list[int]
    change: list[int]
    stable: int
    solved: list[int]
    out: list[int]


def _solution(g: Graph, matrix: list[list[int]], right: list[int], rows: list[int]) -> tuple[list[int], int]:
    if not right:
        return [], g.true
    factors = Factors(g, matrix, pivot_order(g, matrix), rows)
    return factors.solve(g, right), factors.stable


def forward(g: Graph, e: TracedEquation, shared: Inputs, rows: list[dict[int, int]]) -> Linearized:
    """The tangents of a stage, whose Jacobian r_u has these rows."""
    k, known = len(e.unknowns), [*e.state, *shared.params, shared.t, shared.h]
    flow = [g.input(f"tangent{i}") for i in range(len(known))]
    solved = [g.input(f"solved{i}") for i in range(k)]
    tangents = dict(zip(known, flow, strict=True))
    right = [g.neg(node) for node in directional(g, e.residual, tangents)]
    matrix = [[row.get(j, g.zero) for j in range(k)] for row in rows]
    sizes, present = _present(g, e)
    units = terms_of_rows(g, matrix, present)
    change, stable = _solution(g, matrix, right, units)
    out = directional(g, e.advance, tangents | dict(zip(e.unknowns, solved, strict=True)))
    return Linearized(flow, sizes, units, matrix, right, change, stable, solved, out)


def backward(g: Graph, e: TracedEquation, shared: Inputs, rows: list[dict[int, int]]) -> Linearized:
    """The cotangents of a stage, whose Jacobian r_u has these rows."""
    k = len(e.unknowns)
    weights = [g.input(f"cotangent{i}") for i in range(len(e.state))]
    of_unknowns = [g.input(f"of_unknown{i}") for i in range(k)]
    solved = [g.input(f"solved{i}") for i in range(k)]
    from_state = gradient(g, _seeds(g, e.advance, weights), e.unknowns)
    right = [g.add(a, b) for a, b in zip(from_state, of_unknowns, strict=True)]
    matrix = [[rows[i].get(j, g.zero) for i in range(k)] for j in range(k)]
    sizes, present = _present(g, e)
    units = [g.recip(p) for p in present]
    change, stable = _solution(g, matrix, right, units)
    seeds = _seeds(g, [*e.advance, *e.residual], [*weights, *map(g.neg, solved)])
    out = gradient(g, seeds, [*e.state, *shared.params, shared.t, shared.h])
    return Linearized([*weights, *of_unknowns], sizes, units, matrix, right, change, stable, solved, out)


def _present(g: Graph, e: TracedEquation) -> tuple[list[int], list[int]]:
    """The sizes of the unknowns, inputs, and the two of size and value together."""
    sizes = [g.input(f"size{i}") for i in range(len(e.unknowns))]
    return sizes, [g.add(g.make("abs", u), size) for u, size in zip(e.unknowns, sizes, strict=True)]


def _seeds(g: Graph, nodes: Iterable[int], weights: Iterable[int]) -> dict[int, int]:
    seeds: dict[int, int] = {}
    for node, weight in zip(nodes, weights, strict=True):
        seeds[node] = g.add(seeds[node], weight) if node in seeds else weight
    return seeds


@dataclass
class LinearizedLoop:
    """A loop over the stages of a run, forward or backward, as IR."""

    graph: Graph
    shared: Inputs
    equations: list[TracedEquation]
    linearized: list[Linearized]
    stages: list[tuple[int, float]]
    reverse: bool

    @property
    def state_size(self) -> int:
        return len(self.equations[0].state)

    @property
    def carry(self) -> int:
        """Quantities of a lane."""
        return self.state_size + len(self.shared.params) + 3

    @property
    def row(self) -> int:
        """Quantities of a row, which belongs to a stage: the state and the unknowns of the largest equation."""
        return self.state_size + max(1, self.sizes)

    @property
    def sizes(self) -> int:
        """Sizes of a stage: those of the unknowns of the largest equation."""
        return max(len(e.unknowns) for e in self.equations)

    @property
    def numbers(self) -> int:
        """Parameters, and sizes of all stages."""
        return len(self.shared.params) + len(self.stages) * self.sizes

    def module(self, width: int, fma: bool) -> str:
        """IR of `linearized(carry, numbers, rows, flow, blocks, …)` for consecutive blocks of `width` lanes."""
        module = Module(fma)
        declare_shared(module)
        _Block(self, module, width).define()
        body = Body(module)
        rows = body.put(f"mul i64 %count, {len(self.stages) * self.row * width * 8}")
        sizes = self.carry * width * 8, self.numbers * width * 8, rows, rows
        with body.loop(0, "%blocks") as i:
            moved = [
                body.at("i8", pointer, body.put(f"mul i64 {i}, {size}"))
                for pointer, size in zip(("%carry", "%numbers", "%rows", "%flow"), sizes, strict=True)
            ]
            body.line(f"call void @block({', '.join(f'ptr {m}' for m in moved)}, {NUMBERS})")
        body.line("ret void")
        module.define(f"define void @linearized(ptr %carry, ptr %numbers, ptr %rows, ptr %flow, i64 %blocks, {NUMBERS})", body)
        return module.text()


class _Block:
    """Emits the loop for one block of lanes."""

    def __init__(self, loop: LinearizedLoop, module: Module, width: int):
        self.loop, self.body = loop, Body(module)
        self.e = Emitter(self.body, width)

    def define(self) -> None:
        b, e, loop = self.body, self.e, self.loop
        size, count = loop.carry, len(loop.stages)
        self.run = Region(e, loop.graph)
        for i, node in enumerate(loop.shared.params):
            self.run.bind(node, b.load(e.real, b.at(e.real, "%numbers", i)))
        self.carry = [b.at(e.real, "%carry", i) for i in range(size)]
        scalar = Emitter(b, 1)
        before, total = [], 0.0
        for _, fraction in loop.stages:
            before.append(total)
            total += fraction
        self._table("equation", "i64", [str(i) for i, _ in loop.stages])
        self._table("fraction", "double", [scalar.const(f) for _, f in loop.stages])
        self._table("before", "double", [scalar.const(x) for x in before])
        stages = b.put(f"mul i64 %count, {count}")
        with b.loop(0, stages) as n:
            i = b.put(f"sub i64 {b.put(f'sub i64 {stages}, 1')}, {n}") if loop.reverse else n
            stage, step = b.put(f"srem i64 {i}, {count}"), b.put(f"add i64 %first, {b.put(f'sdiv i64 {i}, {count}')}")
            number = b.put(f"sitofp i64 {b.put(f'add i64 %offset, {step}')} to double")
            steps = scalar.add(number, b.load("double", b.at("double", "@before", stage)))
            fraction = b.load("double", b.at("double", "@fraction", stage))
            time = e.splat(scalar.add("%t0", scalar.mul(steps, "%h")))
            limit = b.load(e.real, self.carry[-1])
            active = e.compare("ogt", limit, e.splat(b.put(f"sitofp i64 {step} to double")))
            place = b.put(f"mul i64 {i}, {loop.row}")
            row, flow = b.at(e.real, "%rows", place), b.at(e.real, "%flow", place)
            which = b.load("i64", b.at("i64", "@equation", stage))
            own = b.put(f"add i64 {b.put(f'mul i64 {stage}, {loop.sizes}')}, {len(loop.shared.params)}")
            sizes = b.at(e.real, "%numbers", own)
            for index, (equation, linear) in enumerate(zip(loop.equations, loop.linearized, strict=True)):
                with b.when(b.put(f"icmp eq i64 {which}, {index}")):
                    region = Region(e, loop.graph, self.run)
                    region.bind(loop.shared.t, time)
                    region.bind(loop.shared.h, e.splat(scalar.mul(fraction, "%h")))
                    for j, node in enumerate([*equation.state, *equation.unknowns]):
                        region.bind(node, b.load(e.real, b.at(e.real, row, j)))
                    for j, node in enumerate(linear.sizes):
                        region.bind(node, b.load(e.real, b.at(e.real, sizes, j)))
                    stage_of = self._backward if loop.reverse else self._forward
                    stage_of(region, equation, linear, flow, e.splat(steps), e.splat(fraction), active)
        b.line("ret void")
        pointers = "ptr noalias %carry, ptr noalias %numbers, ptr noalias %rows, ptr noalias %flow"
        b.module.define(f"define internal void @block({pointers}, {NUMBERS}) noinline", b)

    def _table(self, name: str, kind: str, values: list[str]) -> None:
        entries = ", ".join(f"{kind} {v}" for v in values)
        self.body.module.globals.append(f"@{name} = internal constant [{len(values)} x {kind}] [{entries}]")

    def _solved(self, region: Region, linear: Linearized, active: str) -> list[str]:
        region.require([*linear.change, linear.stable])
        change = [region.value(n) for n in linear.change]
        if linear.stable != region.graph.true:
            stable = region.value(linear.stable)
            change = by_partial_pivoting(region, linear.matrix, linear.right, change, stable, active, linear.rows)
        return change

    def _forward(self, region: Region, equation: TracedEquation, linear: Linearized, flow, steps, fraction, active) -> None:
        b, e, s = self.body, self.e, self.loop.state_size
        *known, of_t0, of_h, _ = [b.load(e.real, p) for p in self.carry]
        tangents = [*known, e.add(of_t0, e.mul(steps, of_h)), e.mul(fraction, of_h)]
        for node, value in zip(linear.flow, tangents, strict=True):
            region.bind(node, value)
        change = [e.select(active, value, e.const(0.0)) for value in self._solved(region, linear, active)]
        for j, value in enumerate([*known[:s], *change]):
            b.store(e.real, value, b.at(e.real, flow, j))
        for node, value in zip(linear.solved, change, strict=True):
            region.bind(node, value)
        region.require(linear.out)
        for node, old, pointer in zip(linear.out, known[:s], self.carry[:s], strict=True):
            b.store(e.real, e.select(active, region.value(node), old), pointer)

    def _backward(self, region: Region, equation: TracedEquation, linear: Linearized, flow, steps, fraction, active) -> None:
        b, e, s = self.body, self.e, self.loop.state_size
        carry = [b.load(e.real, p) for p in self.carry[:-1]]
        incoming = [b.load(e.real, b.at(e.real, flow, j)) for j in range(s + len(equation.unknowns))]
        for node, value in zip(linear.flow, [*carry[:s], *incoming[s:]], strict=True):
            region.bind(node, value)
        for node, value in zip(linear.solved, self._solved(region, linear, active), strict=True):
            region.bind(node, value)
        region.require(linear.out)
        *out, of_t, of_h = [region.value(n) for n in linear.out]
        out = [*out, of_t, e.add(e.mul(of_t, steps), e.mul(of_h, fraction))]
        for j, (new, old) in enumerate(zip(out, carry, strict=True)):
            base = incoming[j] if j < s else old
            step = e.select(active, new, old if j < s else e.const(0.0))
            b.store(e.real, e.add(base, step), self.carry[j])
