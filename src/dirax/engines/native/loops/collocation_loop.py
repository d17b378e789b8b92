"""The kernel of collocation steps of one trajectory: every node of a step in a lane of its own, as LLVM IR."""

from collections.abc import Callable

from dirax.engines.contract import NOT_CONVERGED, NOT_FINITE, OK
from dirax.engines.native.functions.far_reduction import add_far_reduction
from dirax.engines.native.ir.emitter import Body, Module
from dirax.engines.native.ir.lower import Region
from dirax.engines.native.loops.collocation_nodes import Nodes
from dirax.engines.native.loops.collocation_plan import CollocationPlan, MeanPlan
from dirax.engines.native.loops.collocation_sweeps import FirstOrder, Means, SecondOrder, Sweep
from dirax.engines.native.loops.step_loop import NUMBERS, define_run
from dirax.engines.stopping import EPSILON, STALLED


def collocation_module(plan: CollocationPlan | MeanPlan, fma: bool) -> str:
    """IR of `run(lanes, params, outs, blocks, …)`: one trajectory a block."""
    module = Module(fma)
    add_far_reduction(module)
    _Kernel(plan, module).define()
    define_run(module, [8 * count for count in (plan.record.size, len(plan.shared.params), len(plan.rows))])
    return module.text()


class _Kernel:
    """Emits `block`: the steps of one trajectory."""

    def __init__(self, plan: CollocationPlan | MeanPlan, module: Module):
        self.plan, self.body = plan, Body(module)
        self.nodes = Nodes(plan, self.body)
        self.one, self.all = self.nodes.one, self.nodes.all

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
        self.sizes = self._sizes(places)

        def give_back() -> None:
            for value, place in zip(scalars, spots, strict=True):
                b.store("double", b.load("double", value), place)
            n = len(self.iterates)
            for j, iterate in enumerate(self.iterates):
                vector = b.load(self.all.real, iterate)
                for i in range(self.nodes.stages):
                    b.store("double", self.all.extract(vector, i), before[i * n + j])
            if plan.gain is not None:
                self._give_rates(places[record.state_size : record.state_size + record.kept])
            b.line("ret void")

        self._steps(give_back)
        give_back()
        pointers = "ptr noalias %lanes, ptr noalias %params, ptr noalias %outs"
        b.module.define(f"define internal void @block({pointers}, {NUMBERS}) noinline", b)

    def _sizes(self, places: list[str]) -> list[str]:
        """How large iterates are, those of all nodes of a kind alike: as the unknowns, rates; accelerations as rates by h."""
        b, one, found = self.body, self.one, []
        first = self.plan.record.sizes(0, len(self.iterates)).start
        for place in places[first : first + len(self.iterates)]:
            size = b.load("double", place)
            found.append(self.all.splat(size if self.plan.gain is None else one.div(size, one.abs("%h"))))
        return found

    def _read_iterates(self, places: list[str]) -> None:
        b, n = self.body, len(self.iterates)
        for j, iterate in enumerate(self.iterates):
            numbers = [b.load("double", places[i * n + j]) for i in range(self.nodes.stages)]
            numbers += [numbers[0]] * (self.nodes.lanes - self.nodes.stages)
            b.store(self.all.real, self.all.pack(numbers), iterate)

    def _give_rates(self, places: list[str]) -> None:
        """The rates where the steps end, for every node: where Newton's method begins if it has to go on."""
        plan = self.plan
        assert isinstance(plan, CollocationPlan)
        region = Region(self.one, plan.graph, self.nodes.scalar)
        for node, pointer in zip([*plan.relation.first, *plan.relation.second], self.state, strict=True):
            region.bind(node, self.body.load("double", pointer))
        region.require(plan.solved)
        rates = [region.value(node) for node in plan.solved]
        for i, place in enumerate(places):
            self.body.store("double", rates[i % len(rates)], place)

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
        here = Region(one, plan.graph, self.nodes.scalar)
        here.bind(plan.shared.t, time)
        for node, value in zip([*r.first, *r.second], state, strict=True):
            here.bind(node, value)
        with b.when(saves):
            self._save(here, number)
        kind = Means if isinstance(plan, MeanPlan) else FirstOrder if plan.gain is None else SecondOrder
        sweep = kind(self.nodes, here, state, time)
        converged, size, count = self._attempts(sweep, one.compare("ogt", done, one.const(0.0)))
        iterates = [b.load(self.all.real, pointer, 64) for pointer in self.iterates]
        increments = sweep.increments(iterates)
        new, lost = [], []
        finite = one.true
        for old, pointer, increment in zip(state, self.lost, increments, strict=True):
            total, error = one.two_sum(old, one.add(increment, b.load("double", pointer)))
            new.append(total)
            lost.append(error)
        for i, more in enumerate(sweep.settled(iterates, new)):
            new[i], error = one.two_sum(new[i], more)
            lost[i] = one.add(lost[i], error)
        for total in new:
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

    def _attempts(self, sweep: Sweep, later: str) -> tuple[str, str, str]:
        """The iteration from the polynomial of the step before, where that fails from constants: (converged, the largest last
        change, sweeps)."""
        b, e = self.body, self.all
        before = [b.load(e.real, pointer, 64) for pointer in self.iterates]
        converged, change, sweeps = b.alloca("i1"), b.alloca(e.real), b.alloca("i64")
        b.store("i1", "false", converged, 1)
        b.store("i64", "0", sweeps)
        with b.loop(0, 2) as attempt, b.when(b.put(f"xor i1 {b.load('i1', converged, 1)}, true")):
            first = b.put(f"icmp eq i64 {attempt}, 0")
            for pointer, value in zip(self.iterates, sweep.guess(before, later, first), strict=True):
                b.store(e.real, value, pointer, 64)
            b.store("i1", self._iterate(sweep, change, sweeps), converged, 1)
        last, largest = b.load(e.real, change, 64), self.one.const(0.0)
        for lane in range(self.nodes.stages):
            largest = self.one.max(e.extract(last, lane), largest)
        count = b.put(f"sitofp i64 {b.load('i64', sweeps)} to double")
        return b.load("i1", converged, 1), largest, count

    def _iterate(self, sweep: Sweep, change: str, sweeps: str) -> str:
        """Sweeps until the next change of every entry of an iterate is below its roundoff, or no smaller than a change before;
        whether that is a root."""
        b, e = self.body, self.all
        least, count_here = [b.alloca(e.real) for _ in self.iterates], b.alloca("i64")
        for pointer in least:
            b.store(e.real, e.const(float("inf")), pointer, 64)
        b.store("i64", "0", count_here)
        head, out = b.fresh(), b.fresh()
        b.branch(head)
        b.label(head)
        old = [b.load(e.real, pointer, 64) for pointer in self.iterates]
        new, stable = sweep.sweep(old)
        going, worst, missed = e.false, e.const(0.0), e.const(0.0)
        for pointer, before, a, least_of, unit in zip(self.iterates, old, new, least, self.sizes, strict=True):
            b.store(e.real, a, pointer, 64)
            moved, size, smallest = e.abs(e.sub(a, before)), e.abs(a), b.load(e.real, least_of, 64)
            shrinks = e.both(e.compare("olt", moved, smallest), e.compare("ogt", moved, e.mul(size, e.const(EPSILON))))
            # the next change will be moved²/smallest; before the second, nothing is known
            known = e.compare("olt", smallest, e.const(float("inf")))
            floor = e.mul(e.mul(size, e.const(EPSILON / 2.0)), smallest)
            enough = e.both(known, e.compare("olt", e.mul(moved, moved), floor))
            going = e.either(going, e.both(shrinks, e.invert(enough)))
            b.store(e.real, e.select(e.compare("olt", moved, smallest), moved, smallest), least_of, 64)
            worst = e.max(moved, worst)
            missed = e.max(e.sub(moved, e.mul(e.add(size, unit), e.const(STALLED))), missed)
        b.store(e.real, worst, change, 64)
        b.store("i64", b.put(f"add i64 {b.load('i64', sweeps)}, 1"), sweeps)
        count = b.put(f"add i64 {b.load('i64', count_here)}, 1")
        b.store("i64", count, count_here)
        allowed = b.put(f"icmp slt i64 {count}, %cap")
        b.branch_if(b.put(f"and i1 {e.any(going)}, {allowed}"), head, out)
        b.label(out)
        return e.all(e.both(e.compare("ole", missed, e.const(0.0)), stable))

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
