"""The kernel that finds the sizes of unknowns: it is called once a run, so little is spent on its machine code."""

from dataclasses import replace

from dirax.engines.first_sizes import FirstSizes, Linearized
from dirax.engines.native.ir.emitter import Body, Emitter, Module
from dirax.engines.native.ir.lower import Region
from dirax.engines.native.loops.plan import Plan
from dirax.engines.native.loops.record import DOUBTFUL
from dirax.engines.native.loops.step_loop import NUMBERS, define_run
from dirax.engines.native.shared import declare_shared
from dirax.numerics.equilibration import BETWEEN, LEAST_SIZE

EXPONENT = 0x7FF << 52
"""The bits of a positive double that a power of two has."""


def sizes_module(plan: Plan, width: int, fma: bool) -> str:
    """IR of a `run(lanes, params, outs, blocks, …)` that writes the sizes of every stage, at the state and the unknowns of a
    record, into lanes that have none. A lane in which they are in doubt has the outcome `DOUBTFUL`."""
    plan = replace(plan, graph=plan.graph.copy())  # which has room for them, and the other kernels' graph stays as it is
    module = Module(fma, groups=False)
    declare_shared(module)
    _define_block(plan, module, width)
    define_run(module, [count * width * 8 for count in (plan.record.size, len(plan.shared.params), 0)])
    return module.text()


def _define_block(plan: Plan, module: Module, width: int) -> None:
    """`block`: the stages one after the other, each by the function of its equation."""
    b, record = Body(module), plan.record
    e = Emitter(b, width)
    at = lambda place: b.at(e.real, "%lanes", place)
    first = at(record.sizes(0, 1).start)
    none = e.compare("oeq", b.load(e.real, first), e.const(0.0))
    with b.when(e.any(none)):
        b.store(e.real, e.select(none, e.const(1.0), b.load(e.real, first)), first)
        t = e.add(e.splat("%t0"), e.mul(e.splat(b.put("sitofp i64 %offset to double")), e.splat("%h")))
        for stage, (index, fraction) in enumerate(plan.stages):
            if plan.equations[index].unknowns:
                places = f"ptr {at(record.unknowns(stage, 1).start)}, ptr {at(record.sizes(stage, 1).start)}"
                h = e.mul(e.splat("%h"), e.const(fraction))
                b.line(f"call void @of_{index}(ptr %lanes, ptr %params, {places}, {e.real} {t}, {e.real} {h}, {e.bool} {none})")
    b.line("ret void")
    module.define(f"define internal void @block(ptr %lanes, ptr %params, ptr %outs, {NUMBERS})", b)
    for index in sorted({index for index, _ in plan.stages}):
        if plan.equations[index].unknowns:
            _define_sizes(plan, module, width, index)


def _define_sizes(plan: Plan, module: Module, width: int, index: int) -> None:
    """`of_‹index›`: the sizes of a stage that solves this equation, in the lanes that have none."""
    b, record, equation = Body(module), plan.record, plan.equations[index]
    correction, k = plan.corrections[index], len(equation.unknowns)
    e = Emitter(b, width)
    places = lambda base, count: [b.at(e.real, base, i) for i in range(count)]
    load = lambda pointer: b.load(e.real, pointer)
    given = [*plan.shared.params, *equation.state]
    at = [*places("%params", len(plan.shared.params)), *places("%lanes", record.state_size)]
    known = {plan.shared.t: "%t", plan.shared.h: "%h"} | {node: load(p) for node, p in zip(given, at, strict=True)}

    def where(unknowns: list[str]) -> Region:
        region = Region(e, plan.graph)
        for node, value in (known | dict(zip(equation.unknowns, unknowns, strict=True))).items():
            region.bind(node, value)
        return region

    region = where([load(pointer) for pointer in places("%unknowns", k)])
    found = FirstSizes(plan.graph, Linearized.of(plan.graph, equation, plan.shared.h, correction.jacobian), correction.order)
    region.require(found.outputs)
    status = b.at(e.real, "%lanes", record.status)
    sure, asked = (e.compare("oeq", region.value(node), e.const(1.0)) for node in (found.sure, found.asked))
    verdict, asked = b.alloca(e.bool), e.both(sure, asked)
    b.store(e.bool, sure, verdict, 1)
    with b.when(e.any(asked)):
        there = where([region.value(node) for node in found.solution])
        there.require(equation.residual)
        holds = e.true
        for r, most in zip(equation.residual, found.most, strict=True):
            holds = e.both(holds, e.compare("ole", e.abs(there.value(r)), region.value(most)))
        b.store(e.bool, e.both(sure, e.either(e.invert(asked), holds)), verdict, 1)
    sure = b.load(e.bool, verdict, 1)
    new = [_power_of_two(e, region.value(node)) for node in found.unknowns]
    new.append(e.select(sure, load(status), e.const(float(DOUBTFUL))))
    for value, pointer in zip(new, [*places("%sizes", k), status], strict=True):
        b.store(e.real, e.select("%none", value, load(pointer)), pointer)
    b.line("ret void")
    head = f"ptr %lanes, ptr %params, ptr %unknowns, ptr %sizes, {e.real} %t, {e.real} %h, {e.bool} %none"
    module.define(f"define internal void @of_{index}({head}) noinline", b)


def _power_of_two(e: Emitter, size: str) -> str:
    """As `numerics/equilibration.py` has it, for sizes from LEAST_SIZE."""
    least = e.select(e.compare("olt", size, e.const(1.0 / LEAST_SIZE)), size, e.const(1.0 / LEAST_SIZE))
    return e.from_bits(e.ints("and", e.bits(e.div(least, e.const(BETWEEN))), e.integer(EXPONENT)))
