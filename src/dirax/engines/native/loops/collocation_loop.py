"""The kernel of collocation steps of one trajectory: every node of a step in a lane of its own, as LLVM IR."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dirax.engines.contract import NOT_CONVERGED, NOT_FINITE, OK
from dirax.engines.native.functions.far_reduction import add_far_reduction
from dirax.engines.native.ir.emitter import Body, Emitter, Module
from dirax.engines.native.ir.lower import Region
from dirax.engines.native.loops.collocation_plan import CollocationPlan
from dirax.engines.native.loops.step_loop import NUMBERS
from dirax.engines.stopping import EPSILON, STALLED

SHAPES = (2, 4, 8, 16)
"""Numbers of lanes: nodes that are missing to the next of them are empty, with weights of zero."""


def collocation_module(plan: CollocationPlan, fma: bool) -> str:
    """IR of `run(lanes, params, outs, blocks, …)`: one trajectory a block."""
    module = Module(fma)
    add_far_reduction(module)
    _Kernel(plan, module).define()
    sizes = plan.record.size * 8, len(plan.shared.params) * 8, len(plan.rows) * 8
    body = Body(module)
    with body.loop(0, "%blocks") as i:
        moved = [
            body.at("i8", pointer, body.put(f"mul i64 {i}, {size}"))
            for pointer, size in zip(("%lanes", "%params", "%outs"), sizes, strict=True)
        ]
        body.line(f"call void @block({', '.join(f'ptr {m}' for m in moved)}, {NUMBERS})")
    body.line("ret void")
    module.define(f"define void @run(ptr %lanes, ptr %params, ptr %outs, i64 %blocks, {NUMBERS})", body)
    return module.text()


class _Kernel:
    """Emits `block`: the steps of one trajectory."""

    def __init__(self, plan: CollocationPlan, module: Module):
        self.plan, self.body = plan, Body(module)
        self.stages = plan.tableau.stages
        self.lanes = next(n for n in SHAPES if n >= self.stages)
        self.one, self.all = Emitter(self.body, 1), Emitter(self.body, self.lanes)

    # ------------------------------------------------------------------ vectors over the nodes

    def vector(self, values: np.ndarray) -> str:
        """A constant with one entry a node, zero in the lanes that have none."""
        padded = [*values.tolist(), *[0.0] * (self.lanes - len(values))]
        return f"<{', '.join(f'double {self.one.const(x)}' for x in padded)}>"

    def scaled(self, matrix: np.ndarray, factor: str) -> list[str]:
        """The columns of a matrix times a number."""
        return [self.all.mul(self.vector(column), self.all.splat(factor)) for column in matrix.T]

    def product(self, columns: list[str], x: str, start: str | None = None) -> str:
        """start + matrix·x for a vector over the nodes."""
        e, sums = self.all, [start] if start is not None else []
        ways = 4 if len(columns) >= 8 else 2 if len(columns) >= 4 else 1
        parts: list[str | None] = [start, *[None] * (ways - 1)]
        for j, column in enumerate(columns):
            entry = self.body.put(
                f"shufflevector {e.real} {x}, {e.real} poison, <{self.lanes} x i32> <{', '.join([f'i32 {j}'] * self.lanes)}>"
            )
            part = parts[j % ways]
            parts[j % ways] = e.mul(column, entry) if part is None else e.fma(column, entry, part)
        sums = [part for part in parts if part is not None]
        while len(sums) > 1:
            sums = [e.add(a, b) for a, b in zip(sums[0::2], sums[1::2], strict=True)]
        return sums[0]

    def along(self, rates: str, start: str) -> str:
        """The points at the nodes, start + Σ_j μ_ij (h b_j rate_j)."""
        return self.product(self.shares, self.all.mul(self.weights, rates), start)

    def total(self, value: str) -> str:
        """The sum over the nodes, a number."""
        width = self.lanes
        while width > 1:
            half = width // 2
            kind = f"<{width} x double>"
            low, high = (
                self.body.put(
                    f"shufflevector {kind} {value}, {kind} poison, <{half} x i32> "
                    f"<{', '.join(f'i32 {i}' for i in range(first, first + half))}>"
                )
                for first in (0, half)
            )
            value = self.body.put(f"fadd <{half} x double> {low}, {high}")
            width = half
        return self.body.put(f"extractelement <1 x double> {value}, i64 0")

    # ------------------------------------------------------------------ the function

    def define(self) -> None:
        b, plan, record = self.body, self.plan, self.plan.record
        places = [b.at("double", "%lanes", i) for i in range(record.size)]
        self.state = [b.alloca("double") for _ in range(record.state_size)]
        self.lost = [b.alloca("double") for _ in range(record.state_size)]
        self.iterates = [b.alloca(self.all.real) for _ in plan.relation.first]
        numbers = [b.alloca("double") for _ in range(4)]
        self.completed, self.status, self.iterations, self.worst = numbers
        first_lost = record.size - 4 - record.lost
        scalars = [*self.state, *self.lost, *numbers]
        spots = [*places[: record.state_size], *places[first_lost:]]
        for value, place in zip(scalars, spots, strict=True):
            b.store("double", b.load("double", place), value)
        first = record.state_size if plan.gain is None else record.state_size + record.kept
        before = places[first : first + record.kept]
        self._read_iterates(before)
        self._constants()

        def give_back() -> None:
            for value, place in zip(scalars, spots, strict=True):
                b.store("double", b.load("double", value), place)
            n = len(self.iterates)
            for j, iterate in enumerate(self.iterates):
                vector = b.load(self.all.real, iterate)
                for i in range(self.stages):
                    b.store("double", self.all.extract(vector, i), before[i * n + j])
            if plan.gain is not None:
                self._give_rates(places[record.state_size : record.state_size + record.kept])
            b.line("ret void")

        self._steps(give_back)
        give_back()
        pointers = "ptr noalias %lanes, ptr noalias %params, ptr noalias %outs"
        b.module.define(f"define internal void @block({pointers}, {NUMBERS}) noinline", b)

    def _read_iterates(self, places: list[str]) -> None:
        b, n = self.body, len(self.iterates)
        for j, iterate in enumerate(self.iterates):
            numbers = [b.load("double", places[i * n + j]) for i in range(self.stages)]
            numbers += [numbers[0]] * (self.lanes - self.stages)
            b.store(self.all.real, self.all.pack(numbers), iterate)

    def _give_rates(self, places: list[str]) -> None:
        """The rates where the steps end, for every node: where Newton's method begins if it has to go on."""
        plan = self.plan
        region = Region(self.one, plan.graph, self.scalar)
        for node, pointer in zip([*plan.relation.first, *plan.relation.second], self.state, strict=True):
            region.bind(node, self.body.load("double", pointer))
        region.require(plan.solved)
        rates = [region.value(node) for node in plan.solved]
        for i, place in enumerate(places):
            self.body.store("double", rates[i % len(rates)], place)

    def _constants(self) -> None:
        """What does not change from step to step: the tableau times h, and what depends on the parameters alone."""
        b, e, plan, tableau = self.body, self.all, self.plan, self.plan.tableau
        self.scalar, self.nodes = Region(self.one, plan.graph), Region(e, plan.graph)
        for i, node in enumerate(plan.shared.params):
            value = b.load("double", b.at("double", "%params", i))
            self.scalar.bind(node, value)
            self.nodes.bind(node, e.splat(value))
        self.scalar.bind(plan.shared.h, "%h")
        self.nodes.bind(plan.shared.h, e.splat("%h"))
        self.times = e.mul(self.vector(tableau.nodes), e.splat("%h"))
        self.weights = e.mul(self.vector(tableau.weights), e.splat("%h"))
        self.shares = [self.vector(column) for column in tableau.shares.T]
        self.extrapolation = [self.vector(column) for column in tableau.extrapolation.T]
        if plan.gain is not None:
            square = self.one.mul("%h", "%h")
            self.second = self.scaled(tableau.second, square)
            self.nodes.require([node for row in plan.gain for node in row.values()])

    def _steps(self, give_back: Callable[[], None]) -> None:
        b = self.body
        since = b.alloca("i64")
        b.store("i64", b.put("srem i64 %first, %every"), since)
        with b.loop("%first", "%stop") as step:
            now = b.load("i64", since)
            self._step(step, b.put(f"icmp eq i64 {now}, 0"))
            now = b.put(f"add i64 {now}, 1")
            full = b.put(f"icmp eq i64 {now}, %every")
            b.store("i64", b.put(f"select i1 {full}, i64 0, i64 {now}"), since)
            going, leave = b.fresh(), b.fresh()
            running = self.one.compare("oeq", b.load("double", self.status), self.one.const(float(OK)))
            b.branch_if(running, going, leave)
            b.label(leave)
            give_back()
            b.label(going)

    def _step(self, number: str, saves: str) -> None:
        b, one, plan, r = self.body, self.one, self.plan, self.plan.relation
        done = b.load("double", self.completed)
        count = one.add(b.put("sitofp i64 %offset to double"), done)
        time = one.add("%t0", one.mul(count, "%h"))
        state = [b.load("double", pointer) for pointer in self.state]
        here = Region(one, plan.graph, self.scalar)
        here.bind(plan.shared.t, time)
        for node, value in zip([*r.first, *r.second], state, strict=True):
            here.bind(node, value)
        with b.when(saves):
            self._save(here, number)
        sweep = _SecondOrder(self, here, state, time) if plan.gain is not None else _FirstOrder(self, here, state, time)
        converged, size, count = self._iterate(sweep, one.compare("ogt", done, one.const(0.0)))
        increments = sweep.increments()
        new, lost = [], []
        finite = one.true
        for old, pointer, increment in zip(state, self.lost, increments, strict=True):
            total, error = one.two_sum(old, one.add(increment, b.load("double", pointer)))
            new.append(total)
            lost.append(error)
            finite = one.both(finite, one.compare("olt", one.abs(total), one.const(float("inf"))))
        good = one.both(finite, converged)
        failure = one.select(finite, one.const(float(NOT_CONVERGED)), one.const(float(NOT_FINITE)))
        b.store("double", one.select(good, one.const(float(OK)), failure), self.status)
        b.store("double", one.add(b.load("double", self.iterations), count), self.iterations)
        with b.when(good):
            for value, pointer in zip([*new, *lost], [*self.state, *self.lost], strict=True):
                b.store("double", value, pointer)
            b.store("double", one.add(done, one.const(1.0)), self.completed)
            b.store("double", one.max(size, b.load("double", self.worst)), self.worst)

    def _iterate(self, sweep: "_SecondOrder | _FirstOrder", later: str) -> tuple[str, str, str]:
        """Sweeps until the next change of every entry of an iterate is below its roundoff, or no smaller than a change before:
        (converged, the largest last change, sweeps)."""
        b, e, one = self.body, self.all, self.one
        least = [b.alloca(e.real) for _ in self.iterates]
        change, sweeps = b.alloca(e.real), b.alloca("i64")
        sweep.guess(later)
        for pointer in least:
            b.store(e.real, e.const(float("inf")), pointer, 64)
        b.store("i64", "0", sweeps)
        head, out = b.fresh(), b.fresh()
        b.branch(head)
        b.label(head)
        old = [b.load(e.real, pointer, 64) for pointer in self.iterates]
        new = sweep.sweep(old)
        going, worst, missed = e.false, e.const(0.0), e.const(0.0)
        for pointer, before, a, least_of in zip(self.iterates, old, new, least, strict=True):
            b.store(e.real, a, pointer, 64)
            moved, size, smallest = e.abs(e.sub(a, before)), e.abs(a), b.load(e.real, least_of, 64)
            shrinks = e.both(e.compare("olt", moved, smallest), e.compare("ogt", moved, e.mul(size, e.const(EPSILON))))
            left = e.div(e.mul(moved, moved), smallest)  # what the next change will be; before the second, nothing is known
            known = e.compare("olt", smallest, e.const(float("inf")))
            enough = e.both(known, e.compare("olt", left, e.mul(size, e.const(EPSILON / 2.0))))
            going = e.either(going, e.both(shrinks, e.invert(enough)))
            b.store(e.real, e.select(e.compare("olt", moved, smallest), moved, smallest), least_of, 64)
            worst = e.max(moved, worst)
            missed = e.max(e.sub(moved, e.mul(e.add(size, e.const(1.0)), e.const(STALLED))), missed)
        b.store(e.real, worst, change, 64)
        count = b.put(f"add i64 {b.load('i64', sweeps)}, 1")
        b.store("i64", count, sweeps)
        allowed = b.put(f"icmp slt i64 {count}, %cap")
        b.branch_if(b.put(f"and i1 {e.any(going)}, {allowed}"), head, out)
        b.label(out)
        converged = e.all(e.compare("ole", missed, e.const(0.0)))
        last, largest = b.load(e.real, change, 64), one.const(0.0)
        for lane in range(self.stages):
            largest = one.max(e.extract(last, lane), largest)
        return converged, largest, b.put(f"sitofp i64 {count} to double")

    def _save(self, here: Region, number: str) -> None:
        b, e, plan = self.body, self.one, self.plan
        row, inside = b.put(f"sdiv i64 {number}, %every"), Region(self.one, plan.graph, here)
        inside.require([node for _, nodes in plan.rows for node in nodes])
        for f, (_, nodes) in enumerate(plan.rows):
            if nodes:
                bytes_ = b.put(f"mul i64 {row}, {8 * len(nodes)}")
                target = b.at("i8", b.load("ptr", b.at("ptr", "%outs", f)), bytes_)
                for j, node in enumerate(nodes):
                    value = inside.value(node)
                    if plan.graph.is_boolean(node):
                        value = e.select(value, e.const(1.0), e.const(0.0))
                    b.store("double", value, b.at("double", target, j))


@dataclass
class _Sweep:
    """What both kinds of iteration share: the state of a step as numbers and over the nodes."""

    kernel: _Kernel
    here: Region
    state: list[str]
    time: str

    def __post_init__(self):
        k = self.kernel
        e, n = k.all, len(k.plan.relation.first)
        self.first = [e.splat(value) for value in self.state[:n]]
        self.second = [e.splat(value) for value in self.state[n:]]
        self.clock = e.add(e.splat(self.time), k.times)

    def region(self, points: list[str], rates: list[str] | None) -> Region:
        """The relation's inputs a and y at the nodes."""
        k, r = self.kernel, self.kernel.plan.relation
        region = Region(k.all, k.plan.graph, k.nodes)
        region.bind(k.plan.shared.t, self.clock)
        for node, value in zip(r.first, points, strict=True):
            region.bind(node, value)
        for node, value in zip(r.unknowns, rates or [], strict=False):
            region.bind(node, value)
        return region

    def _extrapolated(self, later: str, first: list[str]) -> None:
        """The iterates at the nodes of this step from those of the step before, or `first`."""
        k = self.kernel
        b, e = k.body, k.all
        for pointer, value in zip(k.iterates, first, strict=True):
            ahead = k.product(k.extrapolation, b.load(e.real, pointer, 64))
            b.store(e.real, b.put(f"select i1 {later}, {e.real} {ahead}, {e.real} {value}"), pointer, 64)

    def _ends(self, region: Region) -> list[str]:
        """h Σ b_i ḃ_i."""
        k, r = self.kernel, self.kernel.plan.relation
        region.require(r.rates)
        return [k.total(k.all.mul(k.weights, region.value(node))) for node in r.rates]


class _FirstOrder(_Sweep):
    """The iterates are the rates y at the nodes."""

    def guess(self, later: str) -> None:
        k = self.kernel
        self._extrapolated(later, [k.body.load(k.all.real, pointer, 64) for pointer in k.iterates])

    def sweep(self, old: list[str]) -> list[str]:
        k, plan = self.kernel, self.kernel.plan
        region = self.region([k.along(y, a) for y, a in zip(old, self.first, strict=True)], old)
        region.require([plan.relation.rates[i] for i in plan.carried])
        for i in plan.carried:
            rate = region.value(plan.relation.rates[i])
            region.bind(plan.relation.second[i], k.along(rate, self.second[i]))
        region.require(plan.solved)
        self.region_of_last = region
        return [region.value(node) for node in plan.solved]

    def increments(self) -> list[str]:
        k = self.kernel
        rates = [k.body.load(k.all.real, pointer, 64) for pointer in k.iterates]
        first = [k.total(k.all.mul(k.weights, y)) for y in rates]
        if not self.second:
            return first
        return first + self._ends(self.region([k.along(y, a) for y, a in zip(rates, self.first, strict=True)], rates))


class _SecondOrder(_Sweep):
    """The iterates are ä at the nodes, the gain times ḃ."""

    def __post_init__(self):
        super().__post_init__()
        k, plan = self.kernel, self.kernel.plan
        start = Region(k.one, plan.graph, self.here)
        start.require(plan.solved)
        self.rates = [start.value(node) for node in plan.solved]
        self.lines = [k.all.fma(k.times, k.all.splat(v), a) for v, a in zip(self.rates, self.first, strict=True)]

    def guess(self, later: str) -> None:
        self._extrapolated(later, [self.kernel.all.const(0.0) for _ in self.kernel.iterates])

    def sweep(self, old: list[str]) -> list[str]:
        k, plan = self.kernel, self.kernel.plan
        region = self.region([k.product(k.second, f, line) for f, line in zip(old, self.lines, strict=True)], None)
        region.require([plan.relation.rates[i] for i in plan.carried])
        return [self._gained(region, row) for row in plan.gain or []]

    def _gained(self, region: Region, row: dict[int, int]) -> str:
        k, total = self.kernel, None
        for i, node in sorted(row.items()):
            rate, slope = region.value(k.plan.relation.rates[i]), region.value(node)
            if total is None:
                total = rate if node == k.plan.graph.one else k.all.mul(slope, rate)
            else:
                total = k.all.fma(slope, rate, total)
        return k.all.const(0.0) if total is None else total

    def increments(self) -> list[str]:
        """Those of two more sweeps, in halves whose coefficients are symplectic to the last bit: with those of A² alone the
        energy drifts by some 10⁻¹⁹ a step."""
        k, e = self.kernel, self.kernel.all
        forces = [k.body.load(e.real, pointer, 64) for pointer in k.iterates]
        rates, region = self._half_steps(forces)
        region.require([k.plan.relation.rates[i] for i in k.plan.carried])
        rates, region = self._half_steps([self._gained(region, row) for row in k.plan.gain or []])
        return [k.total(e.mul(k.weights, v)) for v in rates] + self._ends(region)

    def _half_steps(self, forces: list[str]) -> tuple[list[str], Region]:
        """The rates and the points at the nodes that belong to these ä."""
        k = self.kernel
        rates = [k.along(f, k.all.splat(v)) for f, v in zip(forces, self.rates, strict=True)]
        return rates, self.region([k.along(v, a) for v, a in zip(rates, self.first, strict=True)], rates)
