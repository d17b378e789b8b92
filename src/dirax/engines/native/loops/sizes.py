"""The kernel that finds the sizes of unknowns: it is called once a run, so little is spent on its machine code."""

from dirax.engines.first_sizes import FirstSizes, Linearized
from dirax.engines.native.functions.far_reduction import add_far_reduction
from dirax.engines.native.ir.emitter import Body, Emitter, Module
from dirax.engines.native.ir.lower import Region
from dirax.engines.native.loops.plan import Plan
from dirax.engines.native.loops.record import DOUBTFUL
from dirax.engines.native.loops.step_loop import NUMBERS, define_run
from dirax.numerics.equilibration import BETWEEN, LEAST_SIZE

EXPONENT = 0x7FF << 52
"""The bits of a positive double that a power of two has."""


def sizes_module(plan: Plan, width: int, fma: bool) -> str:
    """IR of a `run(lanes, params, outs, blocks, …)` that writes the sizes of every stage, at the state and the unknowns of a
    record, into lanes that have none. A lane in which they are in doubt has the outcome `DOUBTFUL`."""
    module = Module(fma, groups=False)
    add_far_reduction(module)
    _define_block(plan, module, width)
    define_run(module, [count * width * 8 for count in (plan.record.size, len(plan.shared.params), 0)])
    return module.text()


def _define_block(plan: Plan, module: Module, width: int) -> None:
    b, record = Body(module), plan.record
    equations = zip(plan.equations, plan.corrections, strict=True)
    of = lambda e, c: FirstSizes(plan.graph, Linearized.of(plan.graph, e, plan.shared.h, c.jacobian), c.order)
    sizes = [of(e, c) if e.unknowns else None for e, c in equations]
    e = Emitter(b, width)
    at = lambda place: b.at(e.real, "%lanes", place)
    places = lambda part: [at(i) for i in range(part.start or 0, part.stop)]
    load = lambda pointer: b.load(e.real, pointer)
    first = at(record.sizes(0, 1).start)
    none = e.compare("oeq", load(first), e.const(0.0))
    with b.when(e.any(none)):
        b.store(e.real, e.select(none, e.const(1.0), load(first)), first)
        known = Region(e, plan.graph)
        for i, node in enumerate(plan.shared.params):
            known.bind(node, load(b.at(e.real, "%params", i)))
        known.bind(plan.shared.t, e.add(e.splat("%t0"), e.mul(e.splat(b.put("sitofp i64 %offset to double")), e.splat("%h"))))
        for stage, (index, fraction) in enumerate(plan.stages):
            found, equation = sizes[index], plan.equations[index]
            if found is None:
                continue
            region, k = Region(e, plan.graph, known), len(equation.unknowns)
            region.bind(plan.shared.h, e.mul(e.splat("%h"), e.const(fraction)))
            given = [*places(record.state), *places(record.unknowns(stage, k))]
            for node, pointer in zip([*equation.state, *equation.unknowns], given, strict=True):
                region.bind(node, load(pointer))
            region.require(found.outputs)
            status = at(record.status)
            sure = e.compare("oeq", region.value(found.sure), e.const(1.0))
            new = [_power_of_two(e, region.value(node)) for node in found.unknowns]
            new.append(e.select(sure, load(status), e.const(float(DOUBTFUL))))
            for value, pointer in zip(new, [*places(record.sizes(stage, k)), status], strict=True):
                b.store(e.real, e.select(none, value, load(pointer)), pointer)
    b.line("ret void")
    module.define(f"define internal void @block(ptr %lanes, ptr %params, ptr %outs, {NUMBERS})", b)


def _power_of_two(e: Emitter, size: str) -> str:
    """As `numerics/equilibration.py` has it, for sizes from LEAST_SIZE."""
    least = e.select(e.compare("olt", size, e.const(1.0 / LEAST_SIZE)), size, e.const(1.0 / LEAST_SIZE))
    return e.from_bits(e.ints("and", e.bits(e.div(least, e.const(BETWEEN))), e.integer(EXPONENT)))
