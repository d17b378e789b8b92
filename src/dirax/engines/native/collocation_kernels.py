"""The kernels of a collocation step: nodes in lanes, a fixed-point iteration; Newton's method where that does not converge."""

import functools
import hashlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.engines.contract import FIXED_POINT
from dirax.engines.native.kernels import Linked, Runs, linked, source_digest, too_large
from dirax.engines.native.loops.collocation_loop import collocation_module
from dirax.engines.native.loops.collocation_plan import CollocationPlan, MeanPlan, TracedMean, TracedRelation, depends
from dirax.engines.native.loops.record import Record
from dirax.engines.native.loops.simplified_newton import pays
from dirax.engines.step_program import KEPT, StepProgram, step_program
from dirax.program import machine_code as llvm
from dirax.program.graph import NODE_LIMIT, Graph, GraphTooLarge
from dirax.program.memo import Memo, Same
from dirax.program.scalar_program import ScalarProgram
from dirax.schemes.stage_relation import MeanRelation, StageRelation

MOST_SIDE_BY_SIDE = 100
"""Unknowns of a step up to which a batch has trajectories in lanes: the iterates of more do not stay near the processor."""


class CollocationKernels:
    """The machine code of a collocation step: for one trajectory, and for several side by side; or, with `newton`, that by
    Newton's method in the eigenbasis of A, for one."""

    def __init__(self, step: StepProgram, plan: CollocationPlan | MeanPlan, newton: bool = False):
        self.step, self.plan, self.newton = step, plan, newton
        g = plan.graph
        self.operations = sum(1 for node in g.reachable(plan.outputs) if g.args[node])
        digest = hashlib.sha256(source_digest().encode())
        for part in (g.op, g.args, sorted(g.value.items()), plan.identity):
            digest.update(repr(part).encode() + b"\0")
        self.digest = digest.hexdigest()
        self.saved: Any = None
        """The arrays that kernels save, once they are known."""
        self.idle: list[Any] = []
        """The memory of the last short run, for the next one."""
        self.runs = Runs(self._run)

    @functools.cached_property
    def record(self) -> Record:
        """What is kept of a trajectory."""
        return self.plan.record

    @property
    def wide(self) -> bool:
        """Whether a batch has trajectories in lanes."""
        return self.plan.tableau.stages * len(self.plan.relation.first) <= MOST_SIDE_BY_SIDE

    @functools.cached_property
    def by_newton(self) -> "CollocationKernels | None":
        """Those that go on where the fixed-point iteration does not converge: with s/2 complex linear systems of the size of one
        node. None where they do not pay or are too large."""
        if not pays(self.plan):
            return None
        try:
            _ = self.plan.pencil  # with which the graph has all its nodes
        except GraphTooLarge:
            return None
        return CollocationKernels(self.step, self.plan, newton=True)

    @property
    def notes(self) -> dict[str, Any]:
        """What `stats` say of the iteration."""
        plan = self.plan
        kind = "rates" if plan.gain is None else "accelerations"
        side = f"{plan.tableau.stages} nodes side by side"
        if isinstance(plan, MeanPlan):
            side = f"{len(plan.quadrature.points)} points of the quadrature side by side, then {side}"
        return {"iteration": f"{FIXED_POINT} {kind}, {side}"}

    def _run(self, width: int, levels: tuple[int, ...]) -> Linked:
        """The code of `run` for a width."""
        text = lambda: collocation_module(self.plan, width, llvm.has_fma(), self.newton)
        key = self.digest, width, "collocation", "newton" * self.newton
        return linked("run", key, text, lambda: self.operations, levels)


_kernels: Memo[CollocationKernels | None] = Memo(KEPT)


def collocation_kernels(equation: Any, params: Any, batch_params: bool) -> CollocationKernels | None:
    """The kernels of a step that says it is collocation; None for any other, and for one whose rows need the unknowns.

    Raises `UnsupportedPrimitive`."""
    (first, fraction), *others = equation.stages
    if others or fraction != 1.0 or first.collocation is None:
        return None
    step = step_program(equation, params, batch_params)
    return _kernels.get((Same(step),), lambda: _made(first.collocation, step))


def _made(stage: Any, step: StepProgram) -> CollocationKernels | None:
    """The relation at one node is traced into a copy of the step's graph."""
    equation = step.equations[0]
    rows = [(name, equation.rows[name].ravel().tolist()) for name in sorted(equation.rows)]
    g = step.graph.copy(len(step.graph) + NODE_LIMIT)
    if depends(g, [node for _, nodes in rows for node in nodes], [*equation.unknowns, step.shared.t, step.shared.h]):
        return None
    try:
        if isinstance(stage, MeanRelation):
            plan = MeanPlan(g, step.shared, _traced_mean(g, stage, step), stage.tableau, stage.quadrature, rows)
        else:
            plan = CollocationPlan(g, step.shared, _traced(g, stage, step), stage.tableau, rows)
        return CollocationKernels(step, plan)
    except GraphTooLarge as error:
        raise too_large(error) from None


def _traced(g: Graph, stage: StageRelation, step: StepProgram) -> TracedRelation:
    equation, t = step.equations[0], step.shared.t
    a, b, y = equation.state[: stage.first], equation.state[stage.first :], equation.unknowns[: stage.first]
    both = lambda a, b, y, t, params: (stage.rates(a, y, t, params), stage.relation(a, b, y, t, params))
    rates, relation = _nodes(g, both, [a, b, y, t], step)
    return TracedRelation(a, b, y, rates.tolist(), relation.tolist())


def _traced_mean(g: Graph, stage: MeanRelation, step: StepProgram) -> TracedMean:
    equation, t, h = step.equations[0], step.shared.t, step.shared.h
    a, b, y = equation.state[: stage.first], equation.state[stage.first :], equation.unknowns[: stage.first]
    (slopes,) = _nodes(g, stage.slopes, [a, y, t], step)
    means = [g.input(f"mean{i}") for i in range(len(slopes))]
    after = [g.input(f"after{i}") for i in range(len(equation.state))]
    (rates,) = _nodes(g, stage.rates, [a, means, t], step)
    (settled,) = _nodes(g, stage.settle, [equation.state, after, y, t, h], step)
    return TracedMean(a, b, y, means, after, slopes.tolist(), rates.tolist(), settled.tolist())


def _nodes(g: Graph, function: Callable, arguments: list[list[int] | int], step: StepProgram) -> list[np.ndarray]:
    """The results of `function(*arguments, params)` for vectors and numbers of nodes."""
    p = step.parameters
    shapes = [(len(nodes),) if isinstance(nodes, list) else () for nodes in arguments]
    kinds = [jax.ShapeDtypeStruct(shape, jnp.float64) for shape in (*shapes, *p.shapes)]
    many = len(arguments)
    closed = jax.make_jaxpr(lambda *values: function(*values[:many], p.rebuild(list(values[many:]))))(*kinds)
    ids, at = [np.array(nodes, dtype=np.int64).reshape(shape) for nodes, shape in zip(arguments, shapes, strict=True)], 0
    for shape in p.shapes:
        count = int(np.prod(shape))
        ids.append(np.array(step.shared.params[at : at + count], dtype=np.int64).reshape(shape))
        at += count
    program = ScalarProgram(g, ids)
    program.run(closed)
    return program.results
