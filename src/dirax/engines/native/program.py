"""A step compiled: traced once per equation, kernels by width, in memory and on disk."""

import contextlib
import ctypes
import functools
import hashlib
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dirax.engines.compensation import increments
from dirax.engines.native import compile as llvm
from dirax.engines.native import kernel_cache
from dirax.engines.native.gradients.linearized_loop import Sweep, backward, forward
from dirax.engines.native.loops.newton_step import newton_correction
from dirax.engines.native.loops.step_loop import Plan, kernel_module
from dirax.engines.step_program import Inputs, Parameters, TracedEquation, inputs, parameters, trace
from dirax.program import graph as graph_module
from dirax.program.derivatives import jacobian
from dirax.program.graph import NODE_LIMIT, Graph, GraphTooLarge
from dirax.program.interpreter import UnsupportedPrimitive

KEPT = 128
"""Programs kept in memory."""

SIGNATURE = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 3, ctypes.c_int64, *[ctypes.c_double] * 2, *[ctypes.c_int64] * 5)
SWEEP_SIGNATURE = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 4, ctypes.c_int64, *[ctypes.c_double] * 2, *[ctypes.c_int64] * 3)


NESTED = 4
"""Derivatives of derivatives from which on a step is `nested`: each more takes the array program times 2.6, and the graph
hardly any."""


@dataclass
class Program:
    """A step as nodes, and the kernels compiled from it so far, by width."""

    graph: Graph
    shared: Inputs
    equations: list[TracedEquation]
    stages: list[tuple[int, float]]
    parameters: Parameters
    compensated: bool
    every_stage: bool
    digest: str
    plan: Plan | None = None
    operations: int = 0
    kernels: dict[int, tuple[Any, Any]] = field(default_factory=dict)
    jacobians: dict[int, list[dict[int, int]]] = field(default_factory=dict)
    increments: tuple[Callable, ...] | None = None
    as_scalars: tuple | None = None
    sweeps: dict[tuple[bool, int], tuple[Any, Any]] = field(default_factory=dict)

    @property
    def nested(self) -> bool:
        """Whether derivatives lie in one another so deep that an array program is far larger than the graph."""
        return any(e.nesting >= NESTED for e in self.equations)

    def jacobian(self, index: int) -> list[dict[int, int]]:
        """Rows {column: node} of the Jacobian of the equation of this index. Raises `GraphTooLarge`."""
        if index not in self.jacobians:
            e = self.equations[index]
            self.jacobians[index] = jacobian(self.graph, e.residual, e.unknowns)
        return self.jacobians[index]

    @property
    def bare(self) -> Plan:
        """The plan without corrections: sizes and names only."""
        return self.plan or Plan(self.graph, self.shared, self.equations, [], self.stages, self.compensated, self.every_stage)

    def kernel(self, width: int) -> tuple[Any, bool]:
        """The compiled `run` for a width, and whether it came from a cache."""
        if width in self.kernels:
            return self.kernels[width][1], True
        library, cached = self._library("run", width, lambda: kernel_module(self._planned(), width, llvm.has_fma()))
        self.kernels[width] = library, SIGNATURE(library["run"])
        return self.kernels[width][1], cached

    def sweep(self, reverse: bool, width: int) -> Any:
        """The compiled `sweep` for a width: of tangents forward or of cotangents backward. Raises `UnsupportedPrimitive`."""
        if (reverse, width) not in self.sweeps:
            text = lambda: self._linearized(reverse).module(width, llvm.has_fma())
            library, _ = self._library("sweep", width, text, "backward" if reverse else "forward")
            self.sweeps[reverse, width] = library, SWEEP_SIGNATURE(library["sweep"])
        return self.sweeps[reverse, width][1]

    def check(self) -> None:
        """Raise `UnsupportedPrimitive` for a step with too many operations."""
        self._planned()

    def _library(self, name: str, width: int, text: Callable[[], str], *more: str) -> tuple[Any, bool]:
        """The linked code that exports `name`, and whether it came from the disk."""
        entry = kernel_cache.name_of(self.digest, width, *more, *llvm.version())
        stored = kernel_cache.read(entry)
        if stored is not None:
            with contextlib.suppress(RuntimeError):  # the linker does not take it: it is compiled anew
                library = llvm.load(stored.code, (name,))
                self.operations = stored.operations
                return library, True
        code = llvm.object_code(text())
        kernel_cache.write(entry, kernel_cache.Kernel(self.operations, code))
        return llvm.load(code, (name,)), False

    def _linearized(self, reverse: bool) -> Sweep:
        g, stage = self.graph, backward if reverse else forward
        try:
            linear = [stage(g, e, self.shared, self.jacobian(i)) for i, e in enumerate(self.equations)]
        except GraphTooLarge as error:
            raise too_large(error) from None
        return Sweep(g, self.shared, self.equations, linear, self.stages, reverse)

    def _planned(self) -> Plan:
        if self.plan is None:
            plan = self.bare
            try:
                plan.corrections = [newton_correction(self.graph, e, self.jacobian(i)) for i, e in enumerate(self.equations)]
                if self.compensated:
                    plan.increments = [increments(self.graph, e) for e in self.equations]
            except GraphTooLarge as error:
                raise too_large(error) from None
            self.plan, self.operations = plan, count_operations(plan)
        return self.plan


def too_large(error: GraphTooLarge) -> UnsupportedPrimitive:
    return UnsupportedPrimitive("the step as a whole", f"has {error}", "a larger system than the native engine is for")


def count_operations(plan: Plan) -> int:
    """Scalar operations of a step with two Newton updates a stage, one of either kind."""
    total = 0
    for index, _ in plan.stages:
        e, c = plan.equations[index], plan.corrections[index]
        needed = plan.graph.reachable([*e.guess, *e.residual, *e.advance, *c.change, *c.again, c.stable])
        total += sum(1 for node in needed if plan.graph.args[node])
    return total


@functools.cache
def source_digest() -> str:
    """A digest of the engine's own source: kernels made by another version of it are not reused."""
    digest = hashlib.sha256()
    rooms = Path(__file__).parents[1], Path(graph_module.__file__).parent
    for path in sorted(path for room in rooms for path in room.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


_programs: OrderedDict[tuple, tuple[Any, Program]] = OrderedDict()


def program(
    equation: Any, params: Any, batch_params: bool, compensated: bool = False, every_stage: bool = False
) -> tuple[Program, float]:
    """The program of a step, and the seconds that tracing took (0 when it was known); with `every_stage` each stage has a
    row in the saved arrays. Raises `UnsupportedPrimitive`."""
    p = parameters(params, batch_params)
    key = (id(equation), p.key, compensated, every_stage)
    if key in _programs:
        _programs.move_to_end(key)
        return _programs[key][1], 0.0
    started = time.perf_counter()
    graph = Graph(NODE_LIMIT)
    shared = inputs(graph, p.size)
    distinct: list[Any] = []
    stages = []
    for stage, fraction in equation.stages:
        index = next((i for i, other in enumerate(distinct) if other is stage), len(distinct))
        distinct += [stage] if index == len(distinct) else []
        stages.append((index, float(fraction)))
    equations = [trace(graph, shared, stage, p) for stage in distinct]
    made = Program(graph, shared, equations, stages, p, compensated, every_stage, "")
    made.digest = _digest(made)
    _programs[key] = (equation, p.fixed), made  # the equation is kept alive, so that its id stays its own
    if len(_programs) > KEPT:
        _programs.popitem(last=False)
    return made, time.perf_counter() - started


def _digest(made: Program) -> str:
    g = made.graph
    rows = lambda e: [(name, nodes.shape, nodes.ravel().tolist()) for name, nodes in sorted(e.rows.items())]
    digest = hashlib.sha256(source_digest().encode())
    outputs = [(e.state, e.unknowns, e.previous, e.guess, e.residual, e.advance, e.scale, rows(e)) for e in made.equations]
    for part in (g.op, g.args, sorted(g.value.items()), outputs, made.stages, made.shared, made.compensated, made.every_stage):
        digest.update(repr(part).encode() + b"\0")
    return digest.hexdigest()
