"""Steps in scalars for JAX: an equation with the functions of its scalar program, and what the graph derives from them."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from dirax.engines import policy
from dirax.engines.compensation import increments
from dirax.engines.step_program import KEPT, StepProgram, step_program
from dirax.program.graph import GraphTooLarge
from dirax.program.interpreter import UnsupportedPrimitive
from dirax.program.memo import Memo, Same
from dirax.schemes.step import StepEquation, StepSequence

_increments: Memo[tuple[Callable, ...]] = Memo(KEPT)
_equations: Memo[tuple[Any, tuple[Callable, ...] | None]] = Memo(KEPT)


def increments_of(equation: Any, params: Any, batch_params: bool) -> tuple[Callable, ...] | str:
    """What each stage adds to the state, NaN where that is not found in the step; the same functions for the same program.

    Where the step is no scalar program, the reason."""
    try:
        made = step_program(equation, params, batch_params).differentiable
    except UnsupportedPrimitive as error:
        return str(error)
    return _increments.get(Same(made), lambda: _increments_of(made))


def _increments_of(made: StepProgram) -> tuple[Callable, ...]:
    graph = made.graph.copy()
    nowhere = graph.constant(float("nan"))
    found = [[nowhere if n is None else n for n in increments(graph, e)] for e in made.equations]
    functions = [made.in_jax(i, nodes, graph) for i, nodes in enumerate(found)]
    return tuple(functions[i] for i, _ in made.stages)


def in_scalars(equation: Any, params: Any, batch_params: bool) -> tuple[Any, tuple[Callable, ...] | None]:
    """The equation with its functions as scalar programs, and the Jacobian (k, k) of the residual of each stage as one,
    (u, state, t, h, params) ↦ J; the same objects for the same program.

    The equation itself, and None, where it is no scalar program or one of more than policy.MOST_FOR_XLA that is not nested."""
    try:
        made = step_program(equation, params, batch_params).differentiable
        return _equations.get(Same(made), lambda: _in_scalars(equation, made))
    except (UnsupportedPrimitive, GraphTooLarge):
        return equation, None


def nested(equation: Any, params: Any, batch_params: bool) -> bool:
    """Whether an array program of the step would be far larger than its graph."""
    try:
        return step_program(equation, params, batch_params).nested
    except UnsupportedPrimitive:
        return False


def _in_scalars(equation: Any, made: StepProgram) -> tuple[Any, tuple[Callable, ...] | None]:
    g = made.graph
    outputs = [
        [*e.residual, *(n for row in rows for n in row.values())] for e, rows in zip(made.equations, made.jacobians, strict=True)
    ]
    large = any(sum(1 for node in g.reachable(nodes) if g.args[node]) > policy.MOST_FOR_XLA for nodes in outputs)
    if large and not made.nested:
        return equation, None
    distinct = {index: stage for (index, _), (stage, _) in zip(made.stages, equation.stages, strict=True)}
    new = {i: replaced(stage, made, i, made.in_jax) for i, stage in distinct.items()}
    jacobians = {i: _dense(made, i) for i in distinct}
    stages = tuple((new[i], fraction) for i, fraction in made.stages)
    return joined(equation, stages), tuple(jacobians[i] for i, _ in made.stages)


def _dense(made: StepProgram, index: int) -> Callable:
    """(u, state, t, h, params) ↦ the Jacobian (k, k) of an equation."""
    rows, zero = made.jacobians[index], made.graph.zero
    k = len(rows)
    entries = made.in_jax(index, [row.get(j, zero) for row in rows for j in range(k)])
    return lambda *args: entries(*args).reshape(k, k)


def _unpacked(made: StepProgram, index: int, written: Callable) -> Callable:
    rows = made.equations[index].rows
    sizes = np.cumsum([nodes.size for nodes in rows.values()])[:-1].tolist()
    flat = written(index, [node for nodes in rows.values() for node in nodes.ravel().tolist()])

    def unpack(state, u, t, h, params):
        parts = jnp.split(flat(u, state, t, h, params), sizes)
        return {name: part.reshape(nodes.shape) for part, (name, nodes) in zip(parts, rows.items(), strict=True)}

    return unpack


def replaced(stage: StepEquation, made: StepProgram, index: int, written: Callable) -> StepEquation:
    """The equation with its functions as nodes; `written(index, nodes)` gives nodes as a function in JAX."""
    traced = made.equations[index]
    return dataclasses.replace(
        stage,
        residual=written(index, traced.residual) if stage.unknowns else stage.residual,
        advance=written(index, traced.advance),
        unpack=_unpacked(made, index, written),
    )


def joined(equation: Any, stages: tuple[tuple[StepEquation, float], ...]) -> Any:
    """These stages in place of those of the equation."""
    single = len(equation.stages) == 1 and equation.stages[0][1] == 1.0
    return stages[0][0] if single else StepSequence(stages)
