"""One stage of a step in IR: guess, Newton's iteration, the row that is saved, the new state, and the verdict on it."""

from dataclasses import dataclass

from dirax.engines.contract import NOT_CONVERGED, NOT_FINITE, OK
from dirax.engines.native.ir.emitter import Emitter
from dirax.engines.native.ir.lower import Region
from dirax.engines.native.loops.newton_loop import NewtonLoop
from dirax.engines.native.loops.plan import STEP, Plan, fields_of, frontier
from dirax.engines.native.loops.record import Frame


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
    block: Block, stage: int | str, index: int, around: Region, time: str, running: str, number: str, saves: str | None
) -> None:
    """Stage number `stage`, which solves equation `index` at `time` in the lanes `running`; row `number` where `saves` holds."""
    plan, frame, e = block.plan, block.frame, block.emitter
    b, equation, correction = e.body, plan.equations[index], plan.corrections[index]
    k, offset = len(equation.unknowns), 0
    if stage != 0:
        offset = b.put(f"mul i64 {stage}, {plan.record.history}")
    active = e.both(running, block.running())
    region = Region(e, plan.graph, around)
    region.bind(plan.shared.t, time)
    for node, value in zip(equation.state, frame.loads(frame.state), strict=True):
        region.bind(node, value)
    last, slopes, bends = (frame.loads(frame.slots(base, k, offset)) for base in (frame.unknowns, frame.slopes, frame.bends))
    for node, value, slope, bend in zip(equation.previous, last, slopes, bends, strict=True):
        region.bind(node, e.add(e.add(value, slope), bend))
    hoisted = frontier(plan.graph, block.level, [*correction.change, *correction.factors, correction.stable], STEP)
    region.require([*equation.guess, *hoisted])
    unknowns = [b.alloca(e.real) for _ in range(k)]
    frame.stores([region.value(n) for n in equation.guess], unknowns)
    converged = e.true
    if k:
        newton = NewtonLoop(equation, correction, region, unknowns)
        newton.emit(active)
        converged = newton.converged
        b.store(e.real, e.add(b.load(e.real, frame.iterations), newton.count), frame.iterations)
    solution = frame.loads(unknowns)
    after = Region(e, plan.graph, region)
    for node, value in zip(equation.unknowns, solution, strict=True):
        after.bind(node, value)
    if saves is not None:
        with b.when(saves):
            _save(block, index, region, solution, last, number)
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


def _save(block: Block, index: int, region: Region, solution: list[str], last: list[str], number: str) -> None:
    """Write the saved arrays of a row; unknowns that are not finite are replaced by those of the step before."""
    e, graph, equation = block.emitter, block.plan.graph, block.plan.equations[index]
    b, inside = e.body, Region(e, graph, region)
    for node, new, old in zip(equation.unknowns, solution, last, strict=True):
        finite = e.compare("olt", e.abs(new), e.const(float("inf")))
        inside.bind(node, e.select(finite, new, old))
    fields, row = fields_of(equation), b.put(f"sdiv i64 {number}, %every")
    inside.require([node for _, nodes in fields for node in nodes])
    for f, (_, nodes) in enumerate(fields):
        if not nodes:
            continue
        bytes_ = b.put(f"mul i64 {row}, {8 * len(nodes)}")
        for lane in range(e.width):
            address = b.load("ptr", b.at("ptr", "%outs", f * e.width + lane))
            target = b.at("i8", address, bytes_)
            for j, node in enumerate(nodes):
                value = inside.value(node)
                if graph.is_boolean(node):
                    value = e.select(value, e.const(1.0), e.const(0.0))
                b.store("double", e.extract(value, lane), b.at("double", target, j))
