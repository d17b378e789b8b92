"""The kernel: rows, steps, stages and Newton iterations of `width` trajectories side by side, as LLVM IR.

Every quantity of a lane is a double; counters too. A lane's record is, for each quantity, `width` doubles:
state · for each stage the unknowns of the step before, their first differences, their second · what rounding took from the
state (with compensated summation) · steps done · status · updates of Newton's method · largest residual.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field

from dirax.engines.native.functions.far_reduction import add_far_reduction
from dirax.engines.native.ir.emitter import Body, Emitter, Module
from dirax.engines.native.ir.lower import Region
from dirax.engines.native.loops.dense import add_dense_solve
from dirax.engines.native.loops.newton_loop import NewtonLoop
from dirax.engines.native.loops.newton_step import Correction
from dirax.engines.result import NOT_CONVERGED, NOT_FINITE, OK
from dirax.engines.step_program import Inputs, TracedEquation
from dirax.program.graph import Graph

RUN, STEP, NEWTON = 1, 2, 3
"""When a node's value is known: once a run, once a step, once an iteration."""

NUMBERS = "double %t0, double %h, i64 %offset, i64 %first, i64 %stop, i64 %every, i64 %cap"
"""Steps `first` to `stop` − 1 of the run, whose own first state is step number `offset`; a row every `every` steps."""


@dataclass
class Plan:
    """What a kernel does: the equations, which of them each stage solves and with which fraction of h."""

    graph: Graph
    shared: Inputs
    equations: list[TracedEquation]
    corrections: list[Correction]
    stages: list[tuple[int, float]]
    compensated: bool = False
    every_stage: bool = False  # a row for each stage of a step, of the equation that it solves; `every` is then 1
    increments: list[list[int | None]] = field(default_factory=list)

    @property
    def state_size(self) -> int:
        return len(self.equations[0].state)

    @property
    def history(self) -> int:
        """Unknowns kept per stage: those of the largest equation."""
        return max(len(e.unknowns) for e in self.equations)

    @property
    def record(self) -> int:
        """Quantities of a lane."""
        carried = self.state_size * (2 if self.compensated else 1)
        return carried + 3 * len(self.stages) * self.history + 4

    @property
    def fields(self) -> list[tuple[str, list[int]]]:
        """The saved arrays, each as the nodes of a row; they come from the first stage."""
        return fields_of(self.equations[self.stages[0][0]])


def fields_of(equation: TracedEquation) -> list[tuple[str, list[int]]]:
    """The saved arrays of an equation, each as the nodes of a row."""
    return [(name, equation.rows[name].ravel().tolist()) for name in sorted(equation.rows)]


def kernel_module(plan: Plan, width: int, fma: bool) -> str:
    """IR of `run(lanes, params, outs, blocks, …)`: the kernel for consecutive blocks of `width` lanes."""
    module = Module(fma)
    add_far_reduction(module)
    add_dense_solve(module)
    Kernel(plan, module, width).define()
    sizes = plan.record * width * 8, len(plan.shared.params) * width * 8, len(plan.fields) * width * 8
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


def frontier(g: Graph, level: dict[int, int], outputs: Iterable[int], at: int) -> list[int]:
    """The nodes of level ≤ `at` that the outputs need directly: themselves, or as operands of nodes of a higher level."""
    found, seen, stack = set(), set(), list(outputs)
    while stack:
        node = stack.pop()
        if node in seen or g.is_constant(node):
            continue
        seen.add(node)
        if level[node] <= at:
            found.add(node)
        else:
            stack.extend(g.args[node])
    return sorted(found)


class Kernel:
    """Emits `block`: the run of one block of lanes."""

    def __init__(self, plan: Plan, module: Module, width: int):
        self.plan, self.g, self.width = plan, plan.graph, width
        self.body = Body(module)
        self.e = Emitter(self.body, width)
        self.level = self._levels()

    def _levels(self) -> dict[int, int]:
        g, plan = self.g, self.plan
        of_input = {node: STEP for e in plan.equations for node in (*e.state, *e.previous)}
        of_input |= {node: NEWTON for e in plan.equations for node in e.unknowns}
        of_input |= {node: NEWTON for c in plan.corrections for node in c.right}
        of_input |= dict.fromkeys(plan.shared.params, RUN)
        of_input |= {plan.shared.t: STEP, plan.shared.h: STEP if len(plan.stages) > 1 else RUN}
        level = {}
        for node in range(len(g)):
            inside = max((level[a] for a in g.args[node]), default=0)
            level[node] = of_input.get(node, inside)
        return level

    # ------------------------------------------------------------------ memory of a lane

    def _variables(self, count: int) -> list[str]:
        return [self.body.alloca(self.e.real) for _ in range(count)]

    def _loads(self, pointers: Iterable[str]) -> list[str]:
        return [self.body.load(self.e.real, p) for p in pointers]

    def _stores(self, values: Iterable[str], pointers: Iterable[str]) -> None:
        for value, pointer in zip(values, pointers, strict=True):
            self.body.store(self.e.real, value, pointer)

    def _slots(self, base: str, count: int, first: int | str = 0) -> list[str]:
        start = self.body.at(self.e.real, base, first) if first != 0 else base
        return [self.body.at(self.e.real, start, i) for i in range(count)]

    def define(self) -> None:
        b, e, plan, g = self.body, self.e, self.plan, self.g
        s, k, stages = plan.state_size, plan.history, len(plan.stages)
        self.state = self._variables(s)
        self.lost = self._variables(s if plan.compensated else 0)
        self.kept = self._variables(s + len(self.lost))
        self.unknowns = b.alloca(e.real, max(1, stages * k))
        self.slopes = b.alloca(e.real, max(1, stages * k))
        self.bends = b.alloca(e.real, max(1, stages * k))
        self.fresh = b.alloca(e.real, max(1, stages * k))
        self.done, self.status, self.iterations, self.worst = (b.alloca(e.real) for _ in range(4))
        record = self._slots("%lanes", plan.record)
        memory = [
            *self.state,
            *self._slots(self.unknowns, stages * k),
            *self._slots(self.slopes, stages * k),
            *self._slots(self.bends, stages * k),
            *self.lost,
            *(self.done, self.status, self.iterations, self.worst),
        ]
        self._stores(self._loads(record), memory)
        self.run = Region(e, g)
        for i, node in enumerate(plan.shared.params):
            self.run.bind(node, b.load(e.real, b.at(e.real, "%params", i)))
        if stages == 1:
            self.run.bind(plan.shared.h, e.mul(e.splat("%h"), e.const(plan.stages[0][1])))
        self.run.require(frontier(g, self.level, self._all_outputs(), RUN))
        self._steps(memory, record)
        self._stores(self._loads(memory), record)
        b.line("ret void")
        pointers = "ptr noalias %lanes, ptr noalias %params, ptr noalias %outs"
        b.module.define(f"define internal void @block({pointers}, {NUMBERS}) noinline", b)

    def _all_outputs(self) -> list[int]:
        out = []
        for equation, correction in zip(self.plan.equations, self.plan.corrections, strict=True):
            out += [*equation.guess, *equation.residual, *equation.advance]
            out += [*correction.change, *correction.factors, correction.stable]
        out += [node for nodes in self.plan.increments for node in nodes if node is not None]
        saving = self.plan.equations if self.plan.every_stage else [self.plan.equations[self.plan.stages[0][0]]]
        return out + [node for equation in saving for _, nodes in fields_of(equation) for node in nodes]

    def _steps(self, memory: list[str], record: list[str]) -> None:
        """The steps, saving a row at every `every`-th; nothing more is done once every lane has failed."""
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
            b.branch_if(self.e.any(self._running()), going, leave)
            b.label(leave)
            self._stores(self._loads(memory), record)
            b.line("ret void")
            b.label(going)

    def _running(self) -> str:
        return self.e.compare("oeq", self.body.load(self.e.real, self.status), self.e.const(float(OK)))

    # ------------------------------------------------------------------ one step

    def _step(self, number: str, saves: str) -> None:
        b, e, plan = self.body, self.e, self.plan
        running = self._running()
        self._stores(self._loads([*self.state, *self.lost]), self.kept)
        count = e.add(e.splat(b.put("sitofp i64 %offset to double")), b.load(e.real, self.done))
        time = e.add(e.splat("%t0"), e.mul(count, e.splat("%h")))
        if len(plan.stages) == 1:
            self._stage(0, plan.equations[0], plan.corrections[0], self.run, time, running, number, saves)
        else:
            clock = b.alloca(e.real)
            b.store(e.real, time, clock)
            with b.loop(0, len(plan.stages)) as stage:
                self._one_of_stages(stage, clock, running, number, saves)
        self._commit(running)

    def _one_of_stages(self, stage: str, clock: str, running: str, number: str, saves: str) -> None:
        """The equation that the stage solves, chosen from those that there are."""
        b, e, plan = self.body, self.e, self.plan
        table = lambda kind, values: f"[{len(values)} x {kind}] [{', '.join(f'{kind} {v}' for v in values)}]"
        scalar = Emitter(b, 1)
        numbers = [str(i) for i, _ in plan.stages]
        fractions = [scalar.const(f) for _, f in plan.stages]
        b.module.globals.append(f"@stage_equation = internal constant {table('i64', numbers)}")
        b.module.globals.append(f"@stage_fraction = internal constant {table('double', fractions)}")
        fraction = b.load("double", b.at("double", "@stage_fraction", stage))
        h = e.splat(scalar.mul(fraction, "%h"))
        time = b.load(e.real, clock)
        which = b.load("i64", b.at("i64", "@stage_equation", stage))
        is_first = b.put(f"icmp eq i64 {stage}, 0")
        if plan.every_stage:
            number = b.put(f"add i64 {b.put(f'mul i64 {number}, {len(plan.stages)}')}, {stage}")
        else:
            saves = b.put(f"and i1 {is_first}, {saves}")
        for i, (equation, correction) in enumerate(zip(plan.equations, plan.corrections, strict=True)):
            with b.when(b.put(f"icmp eq i64 {which}, {i}")):
                region = Region(e, self.g, self.run)
                region.bind(plan.shared.h, h)
                first = i == plan.stages[0][0] or plan.every_stage
                self._stage(stage, equation, correction, region, time, running, number, saves if first else None)
        b.store(e.real, e.add(time, h), clock)

    def _stage(self, stage, equation, correction, around: Region, time, running, number, saves: str | None) -> None:
        b, e, g, plan = self.body, self.e, self.g, self.plan
        k, offset = len(equation.unknowns), 0
        if stage != 0:
            offset = b.put(f"mul i64 {stage}, {plan.history}")
        active = e.both(running, self._running())
        region = Region(e, g, around)
        region.bind(plan.shared.t, time)
        for node, value in zip(equation.state, self._loads(self.state), strict=True):
            region.bind(node, value)
        last = self._loads(self._slots(self.unknowns, k, offset))
        slopes = self._loads(self._slots(self.slopes, k, offset))
        bends = self._loads(self._slots(self.bends, k, offset))
        for node, value, slope, bend in zip(equation.previous, last, slopes, bends, strict=True):
            region.bind(node, e.add(e.add(value, slope), bend))
        hoisted = frontier(g, self.level, [*correction.change, *correction.factors, correction.stable], STEP)
        region.require([*equation.guess, *hoisted])
        unknowns = self._variables(k)
        self._stores([region.value(n) for n in equation.guess], unknowns)
        converged = e.true
        if k:
            newton = NewtonLoop(equation, correction, region, unknowns)
            newton.emit(active)
            converged = newton.converged
            b.store(e.real, e.add(b.load(e.real, self.iterations), newton.count), self.iterations)
        solution = self._loads(unknowns)
        after = Region(e, g, region)
        for node, value in zip(equation.unknowns, solution, strict=True):
            after.bind(node, value)
        if saves is not None:
            with b.when(saves):
                self._save(equation, region, solution, last, number)
        after.require([*equation.advance, *equation.residual])
        new = [after.value(n) for n in equation.advance]
        residual = e.const(0.0)
        for node in equation.residual:
            residual = e.max(e.abs(after.value(node)), residual)
        lost: list[str] = []
        if plan.compensated:
            new, lost = self._compensated(plan.increments[plan.equations.index(equation)], after, new)
        self._judge(active, converged, residual, solution, new)
        good, carried = self._running(), [*self.state, *self.lost]
        state = self._loads(carried)
        self._stores([e.select(good, a, c) for a, c in zip([*new, *lost], state, strict=True)], carried)
        self._stores(solution, self._slots(self.fresh, k, offset))

    def _compensated(self, increments: list[int | None], after: Region, new: list[str]) -> tuple[list[str], list[str]]:
        """The new state and what rounding took from it: what was taken before is given back to the increment (Kahan)."""
        e, sums, errors = self.e, [], []
        after.require([node for node in increments if node is not None])
        for i, node in enumerate(increments):
            old, lost = self._loads((self.state[i], self.lost[i]))
            if node is None:
                sums.append(new[i])
                errors.append(e.const(0.0))
                continue
            s, error = e.two_sum(old, e.add(after.value(node), lost))
            sums.append(s)
            errors.append(error)
        return sums, errors

    def _judge(self, active: str, converged: str, residual: str, solution: list[str], new: list[str]) -> None:
        """The status of lanes that were active, and the largest residual of those that are good."""
        b, e = self.body, self.e
        finite = e.true
        for value in (*solution, *new):
            finite = e.both(finite, e.compare("olt", e.abs(value), e.const(float("inf"))))
        failure = e.select(converged, e.const(float(OK)), e.const(float(NOT_CONVERGED)))
        failure = e.select(finite, failure, e.const(float(NOT_FINITE)))
        b.store(e.real, e.select(active, failure, b.load(e.real, self.status)), self.status)
        better = e.both(active, e.both(finite, converged))
        worst = b.load(e.real, self.worst)
        b.store(e.real, e.select(better, e.max(residual, worst), worst), self.worst)

    def _commit(self, running: str) -> None:
        """Lanes whose every stage was good take the new state and unknowns; the others keep what they had."""
        b, e, plan = self.body, self.e, self.plan
        good = e.both(running, self._running())
        carried = [*self.state, *self.lost]
        kept, state = self._loads(self.kept), self._loads(carried)
        self._stores([e.select(good, a, c) for a, c in zip(state, kept, strict=True)], carried)
        count = len(plan.stages) * plan.history
        move = lambda i: self._commit_unknown(good, i)
        if count <= 64:
            for i in range(count):
                move(i)
        else:
            with b.loop(0, count) as i:
                move(i)
        done = b.load(e.real, self.done)
        b.store(e.real, e.select(good, e.add(done, e.const(1.0)), done), self.done)

    def _commit_unknown(self, good: str, i: int | str) -> None:
        b, e = self.body, self.e
        places = [b.at(e.real, base, i) for base in (self.unknowns, self.slopes, self.bends)]
        old = self._loads(places)
        new = b.load(e.real, b.at(e.real, self.fresh, i))
        done, zero = b.load(e.real, self.done), e.const(0.0)
        slope = e.select(e.compare("oge", done, e.const(1.0)), e.sub(new, old[0]), zero)
        bend = e.select(e.compare("oge", done, e.const(2.0)), e.sub(slope, old[1]), zero)
        self._stores([e.select(good, a, c) for a, c in zip((new, slope, bend), old, strict=True)], places)

    def _save(self, equation, region: Region, solution: list[str], last: list[str], number: str) -> None:
        """Write the saved arrays of a row; unknowns that are not finite are replaced by those of the step before."""
        b, e = self.body, self.e
        inside = Region(e, self.g, region)
        for node, new, old in zip(equation.unknowns, solution, last, strict=True):
            finite = e.compare("olt", e.abs(new), e.const(float("inf")))
            inside.bind(node, e.select(finite, new, old))
        fields, row = fields_of(equation), b.put(f"sdiv i64 {number}, %every")
        inside.require([node for _, nodes in fields for node in nodes])
        for f, (_, nodes) in enumerate(fields):
            if not nodes:
                continue
            bytes_ = b.put(f"mul i64 {row}, {8 * len(nodes)}")
            for lane in range(self.width):
                address = b.load("ptr", b.at("ptr", "%outs", f * self.width + lane))
                target = b.at("i8", address, bytes_)
                for j, node in enumerate(nodes):
                    value = inside.value(node)
                    if self.g.is_boolean(node):
                        value = e.select(value, e.const(1.0), e.const(0.0))
                    b.store("double", e.extract(value, lane), b.at("double", target, j))
