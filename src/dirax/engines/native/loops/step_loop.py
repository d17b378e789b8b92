"""The kernel: rows, steps and stages of `width` trajectories side by side, as LLVM IR."""

from collections.abc import Callable, Sequence

from dirax.engines.contract import OK
from dirax.engines.native.ir.emitter import Body, Emitter, Module
from dirax.engines.native.ir.lower import Region
from dirax.engines.native.loops.plan import RUN, Plan, frontier
from dirax.engines.native.loops.record import Frame, Record
from dirax.engines.native.loops.stage import Block, bind_sizes, emit_stage
from dirax.engines.native.shared import declare_shared

WRITTEN_OUT = 64
"""Unknowns of all stages up to which there is no loop over them."""

NUMBERS = "double %t0, double %h, i64 %offset, i64 %first, i64 %stop, i64 %every, i64 %cap"
"""Steps `first` to `stop` − 1 of the run, whose own first state is step number `offset`; a row every `every` steps."""


def kernel_module(plan: Plan, width: int, fma: bool, groups: bool = True) -> str:
    """IR of `run(lanes, params, outs, blocks, …)`: the kernel for blocks of `width` lanes; `groups` as of `Module`."""
    module = Module(fma, groups)
    declare_shared(module)
    _define_block(plan, module, width)
    define_run(module, [count * width * 8 for count in (plan.record.size, len(plan.shared.params), len(plan.fields))])
    return module.text()


def define_run(module: Module, sizes: Sequence[int]) -> None:
    """`run(lanes, params, outs, blocks, …)`: `block` for one block after the other, whose records, parameters and addresses
    take so many bytes."""
    body = Body(module)
    with body.loop(0, "%blocks") as i:
        moved = [
            body.at("i8", pointer, body.put(f"mul i64 {i}, {size}"))
            for pointer, size in zip(("%lanes", "%params", "%outs"), sizes, strict=True)
        ]
        body.line(f"call void @block({', '.join(f'ptr {m}' for m in moved)}, {NUMBERS})")
    body.line("ret void")
    module.define(f"define void @run(ptr %lanes, ptr %params, ptr %outs, i64 %blocks, {NUMBERS})", body)


def _define_block(plan: Plan, module: Module, width: int) -> None:
    """`block`: the record into the frame, what depends on the parameters alone, the steps, the frame into the record."""
    level, b = plan.levels(), Body(module)
    e, record = Emitter(b, width), plan.record
    frame = Frame.of(e, record)
    load, give = _transfers(frame, record)
    load()
    known = Region(e, plan.graph)
    for i, node in enumerate(plan.shared.params):
        known.bind(node, b.load(e.real, b.at(e.real, "%params", i)))
    if len(plan.stages) == 1:
        known.bind(plan.shared.h, e.mul(e.splat("%h"), e.const(plan.stages[0][1])))
    if len(plan.stages) == 1:
        bind_sizes(known, frame, plan.corrections[0])
    known.require(frontier(plan.graph, level, plan.outputs, RUN))

    def give_back() -> None:
        give()
        b.line("ret void")

    _emit_steps(Block(plan, level, frame, known), give_back)
    give_back()
    pointers = "ptr noalias %lanes, ptr noalias %params, ptr noalias %outs"
    module.define(f"define internal void @block({pointers}, {NUMBERS}) noinline", b)


def _transfers(frame: Frame, record: Record) -> tuple[Callable[[], None], Callable[[], None]]:
    """What writes the record into the frame, and the frame into the record: unknowns one by one, or in loops where they are
    many."""
    e, first, kept = frame.emitter, record.state_size, record.kept
    if kept <= WRITTEN_OUT:
        places, memory = frame.slots("%lanes", record.size), frame.in_order(record)
        return lambda: frame.stores(frame.loads(places), memory), lambda: frame.stores(frame.loads(memory), places)
    after = first + 4 * kept
    singles = [*frame.state, *frame.lost, frame.completed, frame.status, frame.iterations, frame.max_residual]
    places = [e.body.at(e.real, "%lanes", i) for i in (*range(first), *range(after, record.size))]
    arrays = [(base, first + number * kept) for number, base in enumerate(frame.of_stages)]

    def transfer(into_frame: bool) -> None:
        b = e.body
        sources, targets = (places, singles) if into_frame else (singles, places)
        frame.stores(frame.loads(sources), targets)
        for base, begin in arrays:
            with b.loop(0, kept) as i:
                place, own = b.at(e.real, "%lanes", b.put(f"add i64 {i}, {begin}")), b.at(e.real, base, i)
                source, target = (place, own) if into_frame else (own, place)
                b.store(e.real, b.load(e.real, source), target)

    return lambda: transfer(True), lambda: transfer(False)


def _emit_steps(block: Block, give_back: Callable[[], None]) -> None:
    """The steps, saving a row at every `every`-th; nothing more is done once every lane has failed."""
    b = block.emitter.body
    since = b.alloca("i64")
    b.store("i64", b.put("srem i64 %first, %every"), since)
    with b.loop("%first", "%stop") as step:
        now = b.load("i64", since)
        _emit_step(block, step, b.put(f"icmp eq i64 {now}, 0"))
        now = b.put(f"add i64 {now}, 1")
        full = b.put(f"icmp eq i64 {now}, %every")
        b.store("i64", b.put(f"select i1 {full}, i64 0, i64 {now}"), since)
        going, leave = b.fresh(), b.fresh()
        b.branch_if(block.emitter.any(block.running()), going, leave)
        b.label(leave)
        give_back()
        b.label(going)


def _emit_step(block: Block, number: str, saves: str) -> None:
    """Every stage of step `number`, whose row is saved where `saves` holds: in lanes in which that fails once more, from the
    unknowns of the step before as they are, which are nearer where these jump to and fro."""
    frame, e = block.frame, block.emitter
    b, running = e.body, block.running()
    frame.stores(frame.loads(frame.carried), frame.kept)
    count = e.add(e.splat(b.put("sitofp i64 %offset to double")), b.load(e.real, frame.completed))
    time = e.add(e.splat("%t0"), e.mul(count, e.splat("%h")))
    counted = frame.iterations, frame.max_residual
    before = frame.loads(counted)
    begin, again, done = b.fresh(), b.fresh(), b.fresh()
    b.branch(begin)
    b.label(begin)
    _emit_stages(block, time, running, number, saves)
    failed = e.both(running, e.invert(block.running()))
    with b.when(e.any(failed)):
        failed = e.both(failed, _zero_differences(block, failed))
        b.branch_if(e.any(failed), again, done)
        b.label(again)
        frame.stores(frame.loads(frame.kept), frame.carried)
        frame.stores(before, counted)
        b.store(e.real, e.select(running, e.const(float(OK)), b.load(e.real, frame.status)), frame.status)
        b.branch(begin)
        b.label(done)
    _commit(block, running)


def _zero_differences(block: Block, lanes: str) -> str:
    """Have no differences in these lanes any more; in which there were some."""
    frame, e = block.frame, block.emitter
    b = e.body
    there = b.alloca(e.bool)
    b.store(e.bool, e.false, there, 1)
    with b.loop(0, block.plan.record.kept) as i:
        for base in (frame.slopes, frame.bends):
            place = b.at(e.real, base, i)
            value = b.load(e.real, place)
            own = e.both(lanes, e.compare("une", value, e.const(0.0)))
            b.store(e.bool, e.either(b.load(e.bool, there, 1), own), there, 1)
            b.store(e.real, e.select(own, e.const(0.0), value), place)
    return b.load(e.bool, there, 1)


def _emit_stages(block: Block, time: str, running: str, number: str, saves: str) -> None:
    """The stages of a step one after the other."""
    plan, e, b = block.plan, block.emitter, block.emitter.body
    if len(plan.stages) == 1:
        emit_stage(block, 0, 0, block.known, time, running, number, saves)
        return
    clock = b.alloca(e.real)
    b.store(e.real, time, clock)
    with b.loop(0, len(plan.stages)) as stage:
        _emit_one_of_stages(block, stage, clock, running, number, saves)


def _emit_one_of_stages(block: Block, stage: str, clock: str, running: str, number: str, saves: str) -> None:
    """The equation that the stage solves, chosen from those that there are."""
    plan, e = block.plan, block.emitter
    b = e.body
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
    if not plan.every_stage:
        saves = b.put(f"and i1 {is_first}, {saves}")
    for i in range(len(plan.equations)):
        with b.when(b.put(f"icmp eq i64 {which}, {i}")):
            region = Region(e, plan.graph, block.known)
            region.bind(plan.shared.h, h)
            emit_stage(block, stage, i, region, time, running, number, saves, fraction)
    b.store(e.real, e.add(time, h), clock)


def _commit(block: Block, running: str) -> None:
    """Lanes whose every stage was good take the new state and unknowns; the others keep what they had."""
    frame, e = block.frame, block.emitter
    b, good = e.body, e.both(running, block.running())
    kept, state = frame.loads(frame.kept), frame.loads(frame.carried)
    frame.stores([e.select(good, a, c) for a, c in zip(state, kept, strict=True)], frame.carried)
    count = block.plan.record.kept
    if count <= WRITTEN_OUT:
        for i in range(count):
            _commit_unknown(block, good, i)
    else:
        with b.loop(0, count) as i:
            _commit_unknown(block, good, i)
    done = b.load(e.real, frame.completed)
    b.store(e.real, e.select(good, e.add(done, e.const(1.0)), done), frame.completed)


def _commit_unknown(block: Block, good: str, i: int | str) -> None:
    """An unknown with its differences, which are zero until there are enough steps: the first guess is none of them."""
    frame, e = block.frame, block.emitter
    b = e.body
    places = [b.at(e.real, base, i) for base in (frame.unknowns, frame.slopes, frame.bends)]
    old = frame.loads(places)
    new = b.load(e.real, b.at(e.real, frame.fresh, i))
    done, zero = b.load(e.real, frame.completed), e.const(0.0)
    slope = e.select(e.compare("oge", done, e.const(1.0)), e.sub(new, old[0]), zero)
    bend = e.select(e.compare("oge", done, e.const(2.0)), e.sub(slope, old[1]), zero)
    frame.stores([e.select(good, a, c) for a, c in zip((new, slope, bend), old, strict=True)], places)
