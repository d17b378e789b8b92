"""The kernels of a collocation step: nodes in lanes, a fixed-point iteration; Newton's method where that does not converge."""

import functools
import hashlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.engines.native import compile as llvm
from dirax.engines.native.kernels import SIGNATURE, linked, source_digest, too_large
from dirax.engines.native.loops.collocation_loop import collocation_module
from dirax.engines.native.loops.collocation_plan import CollocationPlan, TracedRelation, depends
from dirax.engines.native.loops.record import Record
from dirax.engines.step_program import KEPT, StepProgram, step_program
from dirax.program.graph import NODE_LIMIT, Graph, GraphTooLarge
from dirax.program.memo import Memo, Same
from dirax.program.scalar_program import ScalarProgram


class CollocationKernels:
    """The machine code of a collocation step, for one trajectory at a time."""

    def __init__(self, step: StepProgram, plan: CollocationPlan):
        self.step, self.plan = step, plan
        g = plan.graph
        outputs = [*plan.solved, *plan.relation.rates, *(node for _, nodes in plan.rows for node in nodes)]
        self.operations = sum(1 for node in g.reachable(outputs) if g.args[node])
        digest = hashlib.sha256(source_digest().encode())
        kept = (plan.relation, plan.solved, plan.stable, plan.gain, plan.carried, plan.rows, plan.shared, plan.tableau.stages)
        for part in (g.op, g.args, sorted(g.value.items()), kept, plan.tableau.matrix.tolist()):
            digest.update(repr(part).encode() + b"\0")
        self.digest = digest.hexdigest()
        self.saved: Any = None
        """The arrays that kernels save, and where they stood in memory in the last short run, once they are known."""
        self.places: Any = None
        self._run: tuple[Any, Any] | None = None

    @functools.cached_property
    def record(self) -> Record:
        """What is kept of a trajectory."""
        return self.plan.record

    @property
    def notes(self) -> dict[str, Any]:
        """What `stats` say of the iteration."""
        kind = "rates" if self.plan.gain is None else "accelerations"
        return {"iteration": f"fixed point of the {kind}, {self.plan.tableau.stages} nodes side by side"}

    def kernel(self, width: int) -> tuple[Any, bool]:
        """The compiled `run`, and whether it came from a cache."""
        if self._run is not None:
            return self._run[1], True
        text = lambda: collocation_module(self.plan, llvm.has_fma())
        library, _, cached = linked("run", (self.digest, width, "collocation"), text, lambda: self.operations)
        self._run = library, SIGNATURE(library["run"])
        return self._run[1], cached


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
    g = step.graph.copy(NODE_LIMIT)
    if depends(g, [node for _, nodes in rows for node in nodes], [*equation.unknowns, step.shared.t, step.shared.h]):
        return None
    try:
        return CollocationKernels(step, CollocationPlan(g, step.shared, _traced(g, stage, step), stage.tableau, rows))
    except GraphTooLarge as error:
        raise too_large(error) from None


def _traced(g: Graph, stage: Any, step: StepProgram) -> TracedRelation:
    p, equation = step.parameters, step.equations[0]
    vector = lambda *shape: jax.ShapeDtypeStruct(shape, jnp.float64)
    leaves = [jax.ShapeDtypeStruct(shape, jnp.float64) for shape in p.shapes]

    def both(a, b, y, t, leaves):
        params = p.rebuild(leaves)
        return stage.rates(a, y, t, params), stage.relation(a, b, y, t, params)

    closed = jax.make_jaxpr(both)(vector(stage.first), vector(stage.second), vector(stage.first), vector(), leaves)
    a, b = equation.state[: stage.first], equation.state[stage.first :]
    y = equation.unknowns[: stage.first]
    ids = lambda nodes, shape: np.array(nodes, dtype=np.int64).reshape(shape)
    arguments, at = [ids(a, (-1,)), ids(b, (-1,)), ids(y, (-1,)), ids(step.shared.t, ())], 0
    for shape in p.shapes:
        count = int(np.prod(shape))
        arguments.append(ids(step.shared.params[at : at + count], shape))
        at += count
    program = ScalarProgram(g, arguments)
    program.run(closed)
    rates, relation = program.results
    return TracedRelation(a, b, y, rates.tolist(), relation.tolist())
