"""The kernel: rows, steps, stages and Newton iterations of `width` trajectories side by side, as LLVM IR.

Every quantity of a lane is a double; counters too. A lane's record is, for each quantity, `width` doubles:
state · unknowns of each stage · those of the step before · steps done · status · iterations · largest residual.
"""

from collections.abc import Iterable
from dataclasses import dataclass

from dirax.engines.native.dense import add_dense_solve
from dirax.engines.native.emitter import Body, Emitter, Module
from dirax.engines.native.graph import Graph
from dirax.engines.native.lower import Region
from dirax.engines.native.newton_step import Correction
from dirax.engines.native.trace import Inputs, TracedEquation
from dirax.engines.native.trigonometric import add_far_reduction
from dirax.engines.result import NOT_CONVERGED, NOT_FINITE, OK

EPSILON = 2.220446049250313e-16
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
        return self.state_size + 2 * len(self.stages) * self.history + 4

    @property
    def fields(self) -> list[tuple[str, list[int]]]:
        """The saved arrays, each as the nodes of a row; they come from the first stage."""
        first = self.equations[self.stages[0][0]]
        return [(name, first.rows[name].ravel().tolist()) for name in sorted(first.rows)]


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
        self.kept = self._variables(s)
        self.unknowns = b.alloca(e.real, max(1, stages * k))
        self.older = b.alloca(e.real, max(1, stages * k))
        self.fresh = b.alloca(e.real, max(1, stages * k))
        self.done, self.status, self.iterations, self.worst = (b.alloca(e.real) for _ in range(4))
        record = self._slots("%lanes", plan.record)
        memory = [
            *self.state,
            *self._slots(self.unknowns, stages * k),
            *self._slots(self.older, stages * k),
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
            out += [*equation.guess, *equation.residual, *equation.advance, *correction.change, correction.stable]
        return out + [node for _, nodes in self.plan.fields for node in nodes]

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
        self._stores(self._loads(self.state), self.kept)
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
        saves = b.put(f"and i1 {is_first}, {saves}")
        for i, (equation, correction) in enumerate(zip(plan.equations, plan.corrections, strict=True)):
            with b.when(b.put(f"icmp eq i64 {which}, {i}")):
                region = Region(e, self.g, self.run)
                region.bind(plan.shared.h, h)
                first = i == plan.stages[0][0]
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
        older = self._loads(self._slots(self.older, k, offset))
        for node, new, old in zip(equation.previous, last, older, strict=True):
            region.bind(node, e.add(new, e.sub(new, old)))
        hoisted = frontier(g, self.level, [*equation.residual, *correction.change, correction.stable], STEP)
        region.require([*equation.guess, *hoisted])
        unknowns = self._variables(k)
        self._stores([region.value(n) for n in equation.guess], unknowns)
        converged, residual = e.true, e.const(0.0)
        if k:
            converged, residual = self._newton(equation, correction, region, unknowns, active)
        solution = self._loads(unknowns)
        after = Region(e, g, region)
        for node, value in zip(equation.unknowns, solution, strict=True):
            after.bind(node, value)
        if saves is not None:
            with b.when(saves):
                self._save(equation, region, solution, last, number)
        after.require(equation.advance)
        new = [after.value(n) for n in equation.advance]
        self._judge(active, converged, residual, solution, new)
        good = self._running()
        state = self._loads(self.state)
        self._stores([e.select(good, a, c) for a, c in zip(new, state, strict=True)], self.state)
        self._stores(solution, self._slots(self.fresh, k, offset))

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
        kept, state = self._loads(self.kept), self._loads(self.state)
        self._stores([e.select(good, a, c) for a, c in zip(state, kept, strict=True)], self.state)
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
        fresh, last, older = (b.at(e.real, base, i) for base in (self.fresh, self.unknowns, self.older))
        new, current, before = self._loads((fresh, last, older))
        b.store(e.real, e.select(good, current, before), older)
        b.store(e.real, e.select(good, new, current), last)

    def _save(self, equation, region: Region, solution: list[str], last: list[str], number: str) -> None:
        """Write the saved arrays of a row; unknowns that are not finite are replaced by those of the step before."""
        b, e = self.body, self.e
        inside = Region(e, self.g, region)
        for node, new, old in zip(equation.unknowns, solution, last, strict=True):
            finite = e.compare("olt", e.abs(new), e.const(float("inf")))
            inside.bind(node, e.select(finite, new, old))
        fields, row = self.plan.fields, b.put(f"sdiv i64 {number}, %every")
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

    # ------------------------------------------------------------------ Newton's method

    def _newton(self, equation, correction, region: Region, unknowns: list[str], active: str) -> tuple[str, str]:
        """Iterate to the roundoff floor: the lanes that got there (or broke down), and their largest residuals."""
        b, e = self.body, self.e
        going, previous, count, worst = (b.alloca(kind) for kind in (e.bool, e.real, e.real, e.real))
        turn = b.alloca("i64")
        b.store(e.bool, active, going, 1)
        b.store(e.real, e.const(float("inf")), previous)
        b.store(e.real, e.const(0.0), count)
        b.store(e.real, e.const(0.0), worst)
        b.store("i64", "0", turn)
        head, inside, out = b.fresh(), b.fresh(), b.fresh()
        b.branch(head)
        b.label(head)
        now = b.load(e.bool, going, 1)
        number = b.load("i64", turn)
        below = b.put(f"icmp slt i64 {number}, %cap")
        b.branch_if(b.put(f"and i1 {e.any(now)}, {below}"), inside, out)
        b.label(inside)
        self._iteration(equation, correction, region, unknowns, now, going, previous, worst)
        counted = b.load(e.real, count)
        b.store(e.real, e.select(now, e.add(counted, e.const(1.0)), counted), count)
        b.store("i64", b.put(f"add i64 {number}, 1"), turn)
        b.branch(head)
        b.label(out)
        total = b.load(e.real, self.iterations)
        b.store(e.real, e.add(total, b.load(e.real, count)), self.iterations)
        return e.invert(b.load(e.bool, going, 1)), b.load(e.real, worst)

    def _iteration(self, equation, correction, region, unknowns, now, going, previous, worst) -> None:
        b, e, g = self.body, self.e, self.g
        inner = Region(e, g, region)
        old = self._loads(unknowns)
        for node, value in zip(equation.unknowns, old, strict=True):
            inner.bind(node, value)
        inner.require([*equation.residual, *correction.change, correction.stable])
        change = [inner.value(n) for n in correction.change]
        if correction.stable != g.true:
            change = self._guarded(equation, correction, inner, change, now)
        new = [e.sub(a, d) for a, d in zip(old, change, strict=True)]
        update, total = None, None
        for a, d, scale in zip(new, change, equation.scale, strict=True):
            share = e.div(e.abs(d), e.add(e.abs(a), e.const(scale)))
            update = share if update is None else e.max(share, update)
            total = d if total is None else e.add(total, d)
        assert update is not None and total is not None
        update = e.select(e.compare("uno", total, total), e.const(float("nan")), update)
        size = None
        for node in equation.residual:
            here = e.abs(inner.value(node))
            size = here if size is None else e.max(here, size)
        assert size is not None
        self._stores([e.select(now, a, c) for a, c in zip(new, old, strict=True)], unknowns)
        b.store(e.real, e.select(now, size, b.load(e.real, worst)), worst)
        before = b.load(e.real, previous)
        b.store(e.real, update, previous)
        more = e.both(e.invert(self._at_floor(update, before)), e.compare("ord", update, update))
        b.store(e.bool, e.both(now, more), going, 1)

    def _at_floor(self, update: str, previous: str) -> str:
        """`dirax.engines.newton.at_floor`: updates stopped shrinking, or the next one is far below roundoff."""
        e = self.e
        shrinks = e.compare("olt", update, e.mul(previous, e.const(0.5)))
        stalled = e.both(e.invert(shrinks), e.compare("olt", update, e.const(1e-9)))
        zero = e.compare("oeq", update, e.const(0.0))
        ratio = e.div(update, previous)
        next_one = e.mul(update, e.mul(ratio, ratio))
        negligible = e.both(
            e.compare("olt", next_one, e.const(1e-6 * EPSILON)), e.compare("olt", previous, e.const(float("inf")))
        )
        negligible = e.both(negligible, e.compare("olt", update, e.const(1e-5)))
        return e.either(e.either(stalled, zero), negligible)

    def _guarded(self, equation, correction, inner: Region, change: list[str], now: str) -> list[str]:
        """Where a pivot was too small, the correction by partial pivoting, lane by lane."""
        b, e, k, w = self.body, self.e, len(change), self.width
        memory = b.alloca(e.real, k)
        slots = self._slots(memory, k)
        self._stores(change, slots)
        weak = e.both(e.invert(inner.value(correction.stable)), now)
        with b.when(e.any(weak)):
            entries = [node for row in correction.jacobian for node in row]
            cold = Region(e, self.g, inner)
            cold.require(entries)
            matrix, right = b.alloca(e.real, k * k), b.alloca(e.real, k)
            self._stores([cold.value(n) for n in entries], self._slots(matrix, k * k))
            self._stores([cold.value(n) for n in equation.residual], self._slots(right, k))
            scratch = b.alloca("double", k * (k + 1))
            for lane in range(w):
                flag = e.extract(weak, lane, e.bool)
                with b.when(flag):
                    here = [b.at("double", m, lane) for m in (matrix, right, memory)]
                    pointers = ", ".join(f"ptr {p}" for p in (*here, scratch))
                    b.line(f"call void @dense_solve({pointers}, i64 {k}, i64 {w})")
        return self._loads(slots)
