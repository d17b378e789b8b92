"""The kernel of collocation steps as LLVM IR: one trajectory with the nodes of a step in lanes, or trajectories in lanes."""

from collections.abc import Callable

from dirax.engines.contract import NOT_CONVERGED, NOT_FINITE, OK
from dirax.engines.native.ir.emitter import Body, Module
from dirax.engines.native.ir.lower import Region
from dirax.engines.native.loops.collocation_iteration import Iteration
from dirax.engines.native.loops.collocation_means import Means
from dirax.engines.native.loops.collocation_nodes import Nodes
from dirax.engines.native.loops.collocation_plan import CollocationPlan, MeanPlan
from dirax.engines.native.loops.collocation_sweeps import FirstOrder, SecondOrder, Sweep
from dirax.engines.native.loops.complex_inverse import add_complex_inverse
from dirax.engines.native.loops.simplified_newton import Eigenbasis, InEigenbasis, SimplifiedNewton, SimplifiedNewtonOfMeans
from dirax.engines.native.loops.step_loop import NUMBERS, define_run
from dirax.engines.native.shared import declare_shared


def collocation_module(plan: CollocationPlan | MeanPlan, trajectories: int, fma: bool, newton: bool = False) -> str:
    """IR of `run(lanes, params, outs, blocks, …)`: so many trajectories a block. With `newton`, of one trajectory, Newton's
    method in the eigenbasis of A takes the place of the fixed-point iteration."""
    module = Module(fma)
    declare_shared(module)
    if newton:
        add_complex_inverse(module, len(plan.relation.first))
        _Kernel(plan, module, 1, SimplifiedNewtonOfMeans if isinstance(plan, MeanPlan) else SimplifiedNewton).define()
    else:
        kind = Means if isinstance(plan, MeanPlan) else FirstOrder if plan.gain is None else SecondOrder
        _Kernel(plan, module, trajectories, kind).define()
    counts = plan.record.size, len(plan.shared.params), len(plan.rows)
    define_run(module, [8 * count * trajectories for count in counts])
    return module.text()


class _Kernel:
    """Emits `block`: the steps of a block of trajectories."""

    def __init__(self, plan: CollocationPlan | MeanPlan, module: Module, trajectories: int, kind: type[Sweep]):
        self.plan, self.body, self.kind = plan, Body(module), kind
        self.nodes = Nodes(plan, self.body, trajectories)
        self.one, self.all = self.nodes.one, self.nodes.all

    def define(self) -> None:
        b, plan, record, one = self.body, self.plan, self.plan.record, self.one
        places = [b.at(one.real, "%lanes", i) for i in range(record.size)]
        room = lambda: b.alloca(one.real)
        self.state = [room() for _ in range(record.state_size)]
        self.lost = [room() for _ in range(record.state_size)]
        n = len(plan.relation.first)
        self.pair, self.before, self.moved = self.all.pair(n), self.all.rooms(n), self.all.rooms(n)
        self.completed, self.status, self.iterations, self.worst = numbers = [room() for _ in range(4)]
        first_lost = record.size - 4 - record.lost
        scalars = [*self.state, *self.lost, *numbers]
        spots = [*places[: record.state_size], *places[first_lost:]]
        for value, place in zip(scalars, spots, strict=True):
            b.store(one.real, b.load(one.real, place), value)
        first = record.state_size + record.kept * self.kind.of_accelerations
        kept = [places[first + j : first + record.kept : n] for j in range(n)]
        for iterate, of_nodes in zip(self.pair.now(), kept, strict=True):
            self.all.read(of_nodes, iterate)
        self._take_sizes(places)
        if issubclass(self.kind, InEigenbasis):
            self.nodes.eigenbasis = Eigenbasis(self.nodes, plan)

        def give_back() -> None:
            for value, place in zip(scalars, spots, strict=True):
                b.store(one.real, b.load(one.real, value), place)
            for iterate, of_nodes in zip(self.pair.now(), kept, strict=True):
                self.all.write(iterate, of_nodes)
            if self.kind.of_accelerations:
                self._give_rates(places[record.state_size : record.state_size + record.kept])
            self._give_sizes()
            b.line("ret void")

        self._steps(give_back)
        give_back()
        pointers = "ptr noalias %lanes, ptr noalias %params, ptr noalias %outs"
        b.module.define(f"define internal void @block({pointers}, {NUMBERS}) noinline", b)

    def _take_sizes(self, places: list[str]) -> None:
        """How large iterates are, those of all nodes of a kind alike: as the unknowns, rates; accelerations as rates by h."""
        b, one, n = self.body, self.one, self.pair.count
        first = self.plan.record.sizes(0, n).start
        self.of_sizes, self.sizes = places[first : first + n], [b.alloca(one.real) for _ in range(n)]
        self.scale = one.abs(self.nodes.h) if self.kind.of_accelerations else None
        for place, size in zip(self.of_sizes, self.sizes, strict=True):
            value = b.load(one.real, place)
            b.store(one.real, one.div(value, self.scale) if self.scale else value, size)

    def _give_sizes(self) -> None:
        b, one = self.body, self.one
        for place, size in zip(self.of_sizes, self.sizes, strict=True):
            value = b.load(one.real, size)
            b.store(one.real, one.mul(value, self.scale) if self.scale else value, place)

    def _give_rates(self, places: list[str]) -> None:
        """The rates where the steps end, for every node: where Newton's method begins if it has to go on."""
        plan, one = self.plan, self.one
        assert isinstance(plan, CollocationPlan)
        region = Region(one, plan.graph, self.nodes.scalar)
        for node, pointer in zip([*plan.relation.first, *plan.relation.second], self.state, strict=True):
            region.bind(node, self.body.load(one.real, pointer))
        region.require(plan.solved)
        rates = [region.value(node) for node in plan.solved]
        for i, place in enumerate(places):
            self.body.store(one.real, rates[i % len(rates)], place)

    def _running(self) -> str:
        """Whether nothing has failed so far."""
        return self.one.compare("oeq", self.body.load(self.one.real, self.status), self.one.const(float(OK)))

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
            b.branch_if(self.one.any(self._running()), going, leave)
            b.label(leave)
            give_back()
            b.label(going)

    def _step(self, number: str, saves: str) -> None:
        b, one, plan, r, over = self.body, self.one, self.plan, self.plan.relation, self.all
        done, running = b.load(one.real, self.completed), self._running()
        time = one.add(one.splat("%t0"), one.mul(one.add(one.splat(b.put("sitofp i64 %offset to double")), done), self.nodes.h))
        state = [b.load(one.real, pointer) for pointer in self.state]
        here = Region(one, plan.graph, self.nodes.scalar)
        here.bind(plan.shared.t, time)
        for node, value in zip([*r.first, *r.second], state, strict=True):
            here.bind(node, value)
        with b.when(saves):
            self._save(here, number)
        sweep = self.kind(self.nodes, here, state, time, self.pair)
        iterates = self.pair.now()
        with over.at() as node:
            over.filled(self.before, [over.load(room, node) for room in iterates], node)
        iteration = Iteration(self.nodes, self.pair, self.before, self.moved, self.sizes)
        converged, change, count = iteration.emit(sweep, one.compare("ogt", done, one.const(0.0)), running)
        increments, change = self._increments(sweep, change)
        new, lost = [], []
        finite = one.true
        for old, pointer, increment in zip(state, self.lost, increments, strict=True):
            total, error = one.two_sum(old, one.add(increment, b.load(one.real, pointer)))
            new.append(total)
            lost.append(error)
        for i, more in enumerate(sweep.settled(self.pair.others(), new)):
            new[i], error = one.two_sum(new[i], more)
            lost[i] = one.add(lost[i], error)
        for total in new:
            finite = one.both(finite, one.compare("olt", one.abs(total), one.const(float("inf"))))
        good = one.both(running, one.both(finite, converged))
        failure = one.select(converged, one.const(float(NOT_FINITE)), one.const(float(NOT_CONVERGED)))
        keep = lambda new, pointer: b.store(one.real, one.select(good, new, b.load(one.real, pointer)), pointer)
        for value, pointer in zip([*new, *lost], [*self.state, *self.lost], strict=True):
            keep(value, pointer)
        self.pair.swap()
        iterates = self.pair.now()
        with over.at() as node:
            found = zip(iterates, self.before, strict=True)
            over.filled(iterates, [over.chosen(good, over.load(a, node), over.load(b, node)) for a, b in found], node)
        keep(one.add(done, one.const(1.0)), self.completed)
        of_rates = one.mul(change, self.scale) if self.scale else change
        keep(one.max(of_rates, b.load(one.real, self.worst)), self.worst)
        outcome = one.select(good, one.const(float(OK)), failure)
        b.store(one.real, one.select(running, outcome, b.load(one.real, self.status)), self.status)
        more = one.select(running, one.add(count, one.const(float(sweep.later))), one.const(0.0))
        b.store(one.real, one.add(b.load(one.real, self.iterations), more), self.iterations)

    def _increments(self, sweep: Sweep, change: str) -> tuple[list[str], str]:
        """What is added to the state, and the largest last change; the iterates after all sweeps are in the other rooms then."""
        over, peak, iterates, others = self.all, self.all.peak(), self.pair.now(), self.pair.others()
        if not sweep.later:
            with over.at() as node:
                over.filled(others, [over.load(room, node) for room in iterates], node)

        def last(node: str, new: list[str], stable: str) -> None:
            for value, room, fresh in zip(new, iterates, others, strict=True):
                over.raised(peak, over.emitter.abs(over.emitter.sub(value, over.load(room, node))))
                over.store(value, fresh, node)

        increments = sweep.increments(last)
        return increments, over.highest(peak) if sweep.later else change

    def _save(self, here: Region, number: str) -> None:
        b, e, plan = self.body, self.one, self.plan
        row, inside = b.put(f"sdiv i64 {number}, %every"), Region(e, plan.graph, here)
        inside.require([node for _, nodes in plan.rows for node in nodes])
        for f, (_, nodes) in enumerate(plan.rows):
            bytes_ = b.put(f"mul i64 {row}, {8 * len(nodes)}")
            for lane in range(e.width if nodes else 0):
                target = b.at("i8", b.load("ptr", b.at("ptr", "%outs", f * e.width + lane)), bytes_)
                for j, node in enumerate(nodes):
                    value = inside.value(node)
                    if plan.graph.is_boolean(node):
                        value = e.select(value, e.const(1.0), e.const(0.0))
                    b.store("double", e.extract(value, lane), b.at("double", target, j))
