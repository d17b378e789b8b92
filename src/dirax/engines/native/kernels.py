"""A step compiled: its kernels by width, in memory and on disk."""

import contextlib
import ctypes
import functools
import hashlib
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from dirax.engines.compensation import increments
from dirax.engines.native import kernel_cache
from dirax.engines.native.gradients.linearized_loop import LinearizedLoop, backward, forward
from dirax.engines.native.loops.plan import Plan
from dirax.engines.native.loops.record import Record
from dirax.engines.native.loops.sizes import sizes_module
from dirax.engines.native.loops.step_loop import kernel_module
from dirax.engines.native.shared import addresses
from dirax.engines.newton_step import newton_corrections
from dirax.engines.step_program import KEPT, StepProgram, step_program
from dirax.program import graph as graph_module
from dirax.program import machine_code as llvm
from dirax.program.graph import Graph, GraphTooLarge
from dirax.program.interpreter import UnsupportedPrimitive
from dirax.program.memo import Memo, Same

SIGNATURE = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 3, ctypes.c_int64, *[ctypes.c_double] * 2, *[ctypes.c_int64] * 5)
LINEARIZED_SIGNATURE = ctypes.CFUNCTYPE(
    None, *[ctypes.c_void_p] * 4, ctypes.c_int64, *[ctypes.c_double] * 2, *[ctypes.c_int64] * 3
)

SOON, QUICK = 0, 2
"""Levels of LLVM's optimization. Code of the first is ready in a quarter of the time, and runs a half to a third as fast as that
of the second, with the same bits."""

FEW = 1000
"""Operations of a step up to which code is QUICK from the beginning: that is ready in less than a tenth of a second."""

MANY = 400_000
"""Steps of a run for which code is QUICK from the beginning."""

LARGE = 20_000
"""Operations of a step from which on its derivatives have code that is ready SOON: a network of 2·40·40·1 in a Lagrangian has
31 000, and the QUICK code of its cotangents takes ten seconds instead of one."""

PRICE = 3e-5
"""Seconds for each operation of a step that runs spend with code that is ready SOON before it is worth while to have it QUICK:
about a third of what compiling for that takes."""

SIZING = 1.5e-5
"""Seconds for each operation of a step that runs spend on sizes without a kernel for them before it is worth while to have one:
about a third of what its compilation takes."""


class Linked(NamedTuple):
    """Linked code, the operations of a step in it, whether it came from the disk, and how far it is optimized."""

    library: Any
    operations: int
    cached: bool
    level: int


class Runs:
    """The compiled `run` of a step by width: at first ready soon, and quick when that pays; `repeated` as in `Kernels`."""

    def __init__(self, linked: Callable[[int, tuple[int, ...]], Linked], repeated: float = 1.0):
        self._linked, self._repeated = linked, repeated
        self._made: dict[int, tuple[Any, Linked]] = {}
        self._spent: defaultdict[int, float] = defaultdict(float)

    def kernel(self, width: int, steps: float) -> tuple[Any, bool]:
        """The `run` for a width, with which so many steps are about to be taken, and whether it came from a cache."""
        quick = steps > MANY or self.quick_pays(width, 0.0)
        run, found = self._made.get(width, (None, None))
        if found is not None and (found.level == QUICK or not quick):
            return run, True
        found = self._linked(width, (QUICK,) if quick else (QUICK, SOON))
        run = llvm.function(found.library, "run", SIGNATURE)
        self._made[width] = run, found
        return run, found.cached

    def spent(self, width: int, seconds: float) -> None:
        """Count seconds of runs with this width."""
        self._spent[width] += seconds

    def is_quick(self, width: int) -> bool:
        """Whether the code for a width, which has been made, is quick."""
        return self._made[width][1].level == QUICK

    def quick_pays(self, width: int, seconds: float) -> bool:
        """Whether quick code is worth its compiling where what there is would run for so long from now on."""
        if width not in self._made or self.is_quick(width):
            return False
        return self._spent[width] + seconds > PRICE * self._made[width][1].operations / self._repeated


class Kernels:
    """The machine code of a step: kernels by width, made when they are asked for; with the `whole` Jacobians in Newton's
    method, or without the entries that the step says are weak."""

    def __init__(self, step: StepProgram, compensated: bool, rules: dict[str, str], whole: bool):
        self.step, self.compensated, self.rules, self.whole = step, compensated, rules, whole
        self.plan: Plan | None = None
        self.operations = 0
        self.sizing = 0.0
        """Seconds that runs have spent on sizes without a kernel for them."""
        self.rows_need_step: bool | None = None
        """Whether the rows of nodes are made of the step that leaves them, once it is known."""
        self.saved: Any = None
        """The arrays that kernels save, once they are known."""
        self.idle: list[Any] = []
        """The memory of the last short run, for the next one."""
        self.digest = _digest(self, step)
        self.repeated = len(step.stages) / len(step.equations)
        """How often, in the mean, an equation is solved in a step, which is compiled once."""
        self.runs = Runs(self._run, self.repeated)
        self._of_sizes: dict[int, Any] = {}
        self._linearizations: dict[tuple[bool, int], Any] = {}

    @property
    def bare(self) -> Plan:
        """The plan without corrections: sizes and names only."""
        return self.plan or self._plan(self.step.graph)

    @functools.cached_property
    def record(self) -> Record:
        """What is kept of a lane."""
        return self.bare.record

    def _run(self, width: int, levels: tuple[int, ...]) -> Linked:
        """The code of `run` for a width."""
        return self._library("run", width, lambda: kernel_module(self._planned(), width, llvm.has_fma()), levels=levels)

    def of_sizes(self, width: int, often: bool = False) -> tuple[Any, bool]:
        """The compiled `run` that finds the sizes, and whether it came from a cache; None where they are not written as nodes,
        and as long as runs have spent less than a part of what its compilation takes, unless they are said to be found `often`.
        """
        if width in self._of_sizes:
            return self._of_sizes[width], True
        if not (often or self.sizing > SIZING * self.operations / self.repeated) or not self.step.sizes_are_written:
            return None, True
        text = lambda: sizes_module(self._planned(), width, llvm.has_fma())
        found = self._library("run", width, text, "sizes", levels=(SOON,))
        self._of_sizes[width] = llvm.function(found.library, "run", SIGNATURE)
        return self._of_sizes[width], found.cached

    def linearized(self, reverse: bool, width: int) -> Any:
        """The compiled `linearized` for a width: tangents forward or cotangents backward."""
        if (reverse, width) not in self._linearizations:
            text = lambda: self._linearized(reverse).module(width, llvm.has_fma())
            levels = (QUICK,) if self.operations <= LARGE else (QUICK, SOON)
            way = "backward" if reverse else "forward"
            found = self._library("linearized", width, text, way, _digest(self, self.step.differentiable), levels=levels)
            self._linearizations[reverse, width] = llvm.function(found.library, "linearized", LINEARIZED_SIGNATURE)
        return self._linearizations[reverse, width]

    def check(self) -> None:
        """Raise `UnsupportedPrimitive` for a step with too many operations."""
        self._planned()

    @property
    def without_corrections(self) -> int:
        """The same without those of Newton's corrections, which are known before the step is differentiated."""
        return sum(_operations(self.step.graph, [*e.guess, *e.residual, *e.advance]) for e in self.step.equations)

    @functools.cached_property
    def written(self) -> int:
        """The scalar operations that are written out. Raises `UnsupportedPrimitive` where they are too many."""
        return count_operations(self._planned(), once=True)

    def _library(self, name: str, width: int, text: Callable[[], str], *more: str, levels: tuple[int, ...] = (QUICK,)) -> Linked:
        """The linked code that exports `name`."""
        found = linked(name, (self.digest, width, *more), text, lambda: self.operations, levels)
        self.operations = found.operations
        return found

    def _linearized(self, reverse: bool) -> LinearizedLoop:
        """Of a step that has been planned, so that there is room for as many nodes as its derivatives need."""
        step, one = self.step.differentiable, backward if reverse else forward
        jacobians, g = step.jacobians, step.graph.copy()
        linear = [one(g, e, step.shared, rows) for e, rows in zip(step.equations, jacobians, strict=True)]
        return LinearizedLoop(g, step.shared, step.equations, linear, step.stages, reverse)

    def _planned(self) -> Plan:
        if self.plan is None:
            step = self.step
            try:
                _ = step.jacobians
                g = step.graph.copy(step.graph.limit)  # with its Jacobians
                plan = self._plan(g)
                plan.corrections = [newton_corrections(g, step, i, self.whole) for i in range(len(step.equations))]
                if self.compensated:
                    plan.increments = [increments(g, e) for e in step.equations]
            except GraphTooLarge as error:
                raise too_large(error) from None
            self.plan, self.operations = plan, count_operations(plan)
        return self.plan

    def _plan(self, graph: Graph) -> Plan:
        step = self.step
        return Plan(graph, step.shared, step.equations, [], step.stages, self.rules, self.compensated)


def linked(
    name: str, key: tuple, text: Callable[[], str], operations: Callable[[], int], levels: tuple[int, ...] = (QUICK,)
) -> Linked:
    """The linked code of the IR `text()` that exports `name`: of the first of the `levels` that is on the disk, or else compiled
    for the last one, where there are FEW operations for the first. `operations`: those of a step, known when it is compiled."""
    entries = {level: kernel_cache.name_of(*key, level, *llvm.version()) for level in levels}
    for level, entry in entries.items():
        stored = kernel_cache.read(entry)
        if stored is not None:
            with contextlib.suppress(RuntimeError):  # the linker does not take it: it is compiled anew
                return Linked(llvm.load(stored.code, (name,), addresses()), stored.operations, True, level)
    ir = text()
    level = levels[0] if operations() <= FEW else levels[-1]
    code = llvm.object_code(ir, level=level)
    kernel_cache.write(entries[level], kernel_cache.Kernel(operations(), code))
    return Linked(llvm.load(code, (name,), addresses()), operations(), False, level)


def too_large(error: GraphTooLarge) -> UnsupportedPrimitive:
    return UnsupportedPrimitive("the step as a whole", f"has {error}", "a larger system than the native engine is for")


def count_operations(plan: Plan, once: bool = False) -> int:
    """Scalar operations of a step with two Newton updates a stage, one of either kind; `once`: of each equation once, which is
    what is compiled."""
    total = 0
    for index in range(len(plan.equations)) if once else (index for index, _ in plan.stages):
        e, c = plan.equations[index], plan.corrections[index]
        solved = [node for parts in c.blocks for one in parts for node in (*one.change, *one.again, one.stable)]
        total += _operations(plan.graph, [*e.guess, *e.residual, *e.advance, *solved])
    return total


def _operations(graph: Graph, outputs: list[int]) -> int:
    return sum(1 for node in graph.reachable(outputs) if graph.args[node])


@functools.cache
def source_digest() -> str:
    """A digest of the engine's own source: kernels made by another version of it are not reused."""
    digest = hashlib.sha256()
    rooms = Path(__file__).parents[1], Path(graph_module.__file__).parent
    for path in sorted(path for room in rooms for path in room.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


_kernels: Memo[Kernels] = Memo(KEPT)


def kernels(equation: Any, params: Any, batch_params: bool, compensated: bool = False, whole: bool = False) -> Kernels:
    """The kernels of a step. Raises `UnsupportedPrimitive`."""
    step = step_program(equation, params, batch_params)
    rules = {name: field.rule for name, field in equation.stages[0][0].fields.items()} if len(equation.stages) > 1 else {}
    key = Same(step), compensated, tuple(rules.items()), whole
    return _kernels.get(key, lambda: Kernels(step, compensated, rules, whole))


def _digest(made: Kernels, step: StepProgram) -> str:
    g = step.graph
    rows = lambda e: [(name, nodes.shape, nodes.ravel().tolist()) for name, nodes in sorted(e.rows.items())]
    outputs = [(e.state, e.unknowns, e.previous, e.guess, e.residual, e.advance, rows(e), e.weak) for e in step.equations]
    constants = sorted((node, value) for node, value in g.value.items() if node < step.size)
    nodes = g.op[: step.size], g.args[: step.size], constants
    digest = hashlib.sha256(source_digest().encode())
    for part in (*nodes, outputs, step.stages, step.shared, made.compensated, made.whole, sorted(made.rules.items())):
        digest.update(repr(part).encode() + b"\0")
    return digest.hexdigest()
