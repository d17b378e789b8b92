"""One stage of a step in IR: guess, Newton's iteration, the row that is saved, the new state, and the verdict on it."""

from dataclasses import dataclass

from dirax.engines.contract import NOT_CONVERGED, NOT_FINITE, OK
from dirax.engines.native.ir.emitter import Emitter
from dirax.engines.native.ir.lower import Region
from dirax.engines.native.loops.newton_loop import NewtonLoop
from dirax.engines.native.loops.plan import NEWTON, STEP, Plan, frontier
from dirax.engines.native.loops.record import Frame
from dirax.engines.newton_step import Corrections


@dataclass(frozen=True)
class Block:
    """The run of one block of lanes while it is written: when each node is known, where a lane's quantities stand, and what is
    known of all steps."""

    plan: Plan
    level: dict[int, int]
    frame: Frame
    known: Region

    @property
    def emitter(self) -> Emitter:
        return self.frame.emitter

    def running(self) -> str:
        """The lanes in which nothing has failed so far."""
        e = self.emitter
        return e.compare("oeq", e.body.load(e.real, self.frame.status), e.const(float(OK)))


def emit_stage(
    block: Block,
    stage: int | str,
    index: int,
    around: Region,
    time: str,
    running: str,
    number: str,
    saves: str,
    fraction: str = "",
) -> None:
    """Stage number `stage`, which solves equation `index` at `time` in the lanes `running`; its part of the row of step `number`
    where `saves` holds. `fraction` is that of the step, of one of several stages."""
    plan, frame, e = block.plan, block.frame, block.emitter
    b, equation, correction = e.body, plan.equations[index], plan.corrections[index]
    k, offset = len(equation.unknowns), 0
    if stage != 0:
        offset = b.put(f"mul i64 {stage}, {plan.record.history}")
    active = e.both(running, block.running())
    region = Region(e, plan.graph, around)
    region.bind(plan.shared.t, time)
    if len(plan.stages) > 1:
        bind_sizes(region, frame, correction, offset)
    for node, value in zip(equation.state, frame.loads(frame.state), strict=True):
        region.bind(node, value)
    last, slopes, bends = (frame.loads(frame.slots(base, k, offset)) for base in (frame.unknowns, frame.slopes, frame.bends))
    for node, value, slope, bend in zip(equation.previous, last, slopes, bends, strict=True):
        region.bind(node, e.add(e.add(value, slope), bend))
    hoisted = frontier(plan.graph, block.level, [n for parts in correction.blocks for one in parts for n in one.outputs], STEP)
    region.require([*equation.guess, *hoisted])
    unknowns, sizes = [b.alloca(e.real) for _ in range(k)], frame.slots(frame.sizes, k, offset)
    frame.stores([region.value(n) for n in equation.guess], unknowns)
    converged, count, after = e.true, e.const(0.0), region
    for solved, parts in enumerate(correction.blocks):
        after.require(frontier(plan.graph, block.level, [n for one in parts for n in one.outputs], NEWTON + solved - 1))
        newton = NewtonLoop(parts, after, unknowns, sizes)
        newton.emit(e.both(active, converged))
        converged, count = e.both(converged, newton.converged), e.max(count, newton.count)
        after = Region(e, plan.graph, after)
        for node, value in newton.values():
            after.bind(node, value)
    b.store(e.real, e.add(b.load(e.real, frame.iterations), count), frame.iterations)
    solution = [after.value(node) for node in equation.unknowns]
    saving = plan.saving(index)
    if saving:
        with b.when(saves):
            _save(block, stage, index, region, solution, last, number, fraction)
    after.require([*equation.advance, *equation.residual])
    new = [after.value(n) for n in equation.advance]
    residual = e.const(0.0)
    for node in equation.residual:
        residual = e.max(e.abs(after.value(node)), residual)
    lost: list[str] = []
    if plan.compensated:
        new, lost = _compensated(block, plan.increments[index], after, new)
    _judge(block, active, converged, residual, solution, new)
    good = block.running()
    state = frame.loads(frame.carried)
    frame.stores([e.select(good, a, c) for a, c in zip([*new, *lost], state, strict=True)], frame.carried)
    frame.stores(solution, frame.slots(frame.fresh, k, offset))


def bind_sizes(region: Region, frame: Frame, correction: Corrections, offset: int | str = 0) -> None:
    """The sizes of the unknowns of a stage, known in a region."""
    pointers = frame.slots(frame.sizes, len(correction.sizes), offset)
    for node, value in zip(correction.sizes, frame.loads(pointers), strict=True):
        region.bind(node, value)


def _compensated(block: Block, increments: list[int | None], after: Region, new: list[str]) -> tuple[list[str], list[str]]:
    """The new state and what rounding took from it: what was taken before is given back to the increment (Kahan)."""
    frame, e, sums, errors = block.frame, block.emitter, [], []
    after.require([node for node in increments if node is not None])
    for i, node in enumerate(increments):
        old, lost = frame.loads((frame.state[i], frame.lost[i]))
        if node is None:
            sums.append(new[i])
            errors.append(e.const(0.0))
            continue
        s, error = e.two_sum(old, e.add(after.value(node), lost))
        sums.append(s)
        errors.append(error)
    return sums, errors


def _judge(block: Block, active: str, converged: str, residual: str, solution: list[str], new: list[str]) -> None:
    """The status of lanes that were active, and the largest residual of those that are good."""
    frame, e = block.frame, block.emitter
    b, finite = e.body, e.true
    for value in (*solution, *new):
        finite = e.both(finite, e.compare("olt", e.abs(value), e.const(float("inf"))))
    failure = e.select(converged, e.const(float(OK)), e.const(float(NOT_CONVERGED)))
    failure = e.select(finite, failure, e.const(float(NOT_FINITE)))
    b.store(e.real, e.select(active, failure, b.load(e.real, frame.status)), frame.status)
    better = e.both(active, e.both(finite, converged))
    worst = b.load(e.real, frame.max_residual)
    b.store(e.real, e.select(better, e.max(residual, worst), worst), frame.max_residual)


def _save(
    block: Block, stage: int | str, index: int, region: Region, solution: list[str], last: list[str], number: str, fraction: str
) -> None:
    """Write a stage's part of a row; unknowns that are not finite are replaced by those of the step before."""
    e, graph, plan = block.emitter, block.plan.graph, block.plan
    b, inside, saving = e.body, Region(e, graph, region), plan.saving(index)
    for node, new, old in zip(plan.equations[index].unknowns, solution, last, strict=True):
        finite = e.compare("olt", e.abs(new), e.const(float("inf")))
        inside.bind(node, e.select(finite, new, old))
    row = b.put(f"sdiv i64 {number}, %every")
    inside.require([node for *_, nodes in saving for node in nodes])
    if stage == 0 or not plan.every_stage:
        _write(block, inside, [(f, "first", nodes) for f, _, nodes in saving], row)
        return
    is_first = b.put(f"icmp eq i64 {stage}, 0")
    here = [one for one in saving if one[1] == "first"]
    if here:
        with b.when(is_first):
            _write(block, inside, here, row)
    for f, rule, nodes in saving:
        if rule == "each":
            place = b.put(f"add i64 {b.put(f'mul i64 {row}, {len(plan.stages)}')}, {stage}")
            _write(block, inside, [(f, rule, nodes)], place)
        elif rule != "first":
            _write(block, inside, [(f, rule, nodes)], row, is_first, fraction if rule == "mean" else "")


def _write(
    block: Block, inside: Region, saving: list[tuple[int, str, list[int]]], row: str, is_first: str = "", weight: str = ""
) -> None:
    """Write fields into a row, of the array of which this is the number. With `is_first` what stands there is added to where that
    does not hold, after multiplying by the number `weight` if there is one: what stands there is read for all lanes before any is
    written, since lanes that fill up a block write where another one does."""
    e, graph = block.emitter, block.plan.graph
    b = e.body
    for f, _, nodes in saving:
        bytes_ = b.put(f"mul i64 {row}, {8 * len(nodes)}")
        addresses = [b.load("ptr", b.at("ptr", "%outs", f * e.width + lane)) for lane in range(e.width)]
        targets = [b.at("i8", address, bytes_) for address in addresses]
        for j, node in enumerate(nodes):
            value, places = inside.value(node), [b.at("double", target, j) for target in targets]
            if graph.is_boolean(node):
                value = e.select(value, e.const(1.0), e.const(0.0))
            if is_first:
                value = e.mul(e.splat(weight), value) if weight else value
                before = e.pack([b.load("double", place) for place in places])
                total = e.add(before, value)
                value = b.put(f"select i1 {is_first}, {e.real} {value}, {e.real} {total}")
            for lane, place in enumerate(places):
                b.store("double", e.extract(value, lane), place)
