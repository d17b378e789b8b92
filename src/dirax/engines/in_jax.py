"""The scalar graph given back as JAX functions."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.engines.compensation import increments
from dirax.engines.native.program import Program, program
from dirax.engines.step_program import TracedEquation
from dirax.program.evaluation.by_jax import by_jax
from dirax.program.graph import GraphTooLarge
from dirax.program.interpreter import UnsupportedPrimitive
from dirax.schemes.step import StepEquation, StepSequence

MOST_OPERATIONS = 6000
"""Scalar operations of a residual with its Jacobian up to which XLA is given them: it takes some milliseconds to compile each."""


def function_of(made: Program, equation: TracedEquation, outputs: list[int]) -> Callable:
    """(u, state, t, h, params) ↦ the nodes `outputs` of a traced equation, as one array."""
    g, shared = made.graph, made.shared

    def evaluated(u, state, t, h, params):
        leaves = [leaf for leaf, moves in zip(jax.tree.leaves(params), made.parameters.dynamic, strict=True) if moves]
        numbers = [x for leaf in leaves for x in jnp.ravel(jnp.asarray(leaf, float))]
        values: dict[int, Any] = {shared.t: jnp.asarray(t, float), shared.h: jnp.asarray(h, float)}
        values.update(zip(shared.params, numbers, strict=True))
        values.update(zip([*equation.unknowns, *equation.state], [*u, *state], strict=True))
        return by_jax(g, outputs, values)

    return jax.jit(evaluated)  # so that JAX traces it once for all the places that a loop has it in


def increments_of(equation: Any, params: Any, batch_params: bool) -> tuple[Callable, ...] | str:
    """What each stage adds to the state, NaN where that is not found in the step; the same functions for the same program.

    Where the step is no scalar program, the reason."""
    try:
        made, _ = program(equation, params, batch_params)
        if made.increments is None:
            nowhere = made.graph.constant(float("nan"))
            found = [[nowhere if n is None else n for n in increments(made.graph, e)] for e in made.equations]
            functions = [function_of(made, e, nodes) for e, nodes in zip(made.equations, found, strict=True)]
            made.increments = tuple(functions[i] for i, _ in made.stages)
        return made.increments
    except UnsupportedPrimitive as error:
        return str(error)


def in_scalars(equation: Any, params: Any, batch_params: bool) -> tuple[Any, tuple[Callable, ...] | None]:
    """The equation with its functions as scalar programs, and the Jacobian (k, k) of the residual of each stage as one,
    (u, state, t, h, params) ↦ J; the same objects for the same program.

    The equation itself, and None, where it is no scalar program or one of more than MOST_OPERATIONS that is not nested."""
    try:
        made, _ = program(equation, params, batch_params)
        if made.as_scalars is None:
            made.as_scalars = _in_scalars(equation, made)
        return made.as_scalars or (equation, None)
    except (UnsupportedPrimitive, GraphTooLarge):
        return equation, None


def nested(equation: Any, params: Any, batch_params: bool) -> bool:
    """Whether an array program of the step would be far larger than its graph."""
    try:
        return program(equation, params, batch_params)[0].nested
    except (UnsupportedPrimitive, GraphTooLarge):
        return False


def _in_scalars(equation: Any, made: Program) -> tuple:
    """Nothing for a program that is too large."""
    g, slopes = made.graph, [made.jacobian(i) for i in range(len(made.equations))]
    outputs = [[*e.residual, *(n for row in rows for n in row.values())] for e, rows in zip(made.equations, slopes, strict=True)]
    large = any(sum(1 for node in g.reachable(nodes) if g.args[node]) > MOST_OPERATIONS for nodes in outputs)
    if large and not made.nested:
        return ()
    distinct = {index: stage for (index, _), (stage, _) in zip(made.stages, equation.stages, strict=True)}
    new = {i: _replaced(stage, made, made.equations[i]) for i, stage in distinct.items()}
    jacobians = {i: _dense(made, made.equations[i], slopes[i]) for i in distinct}
    single = len(equation.stages) == 1 and equation.stages[0][1] == 1.0
    stages = tuple((new[i], fraction) for i, fraction in made.stages)
    return stages[0][0] if single else StepSequence(stages), tuple(jacobians[i] for i, _ in made.stages)


def _dense(made: Program, equation: TracedEquation, rows: list[dict[int, int]]) -> Callable:
    """(u, state, t, h, params) ↦ the matrix (k, k) of these rows {column: node}."""
    k, zero = len(rows), made.graph.zero
    entries = function_of(made, equation, [row.get(j, zero) for row in rows for j in range(k)])
    return lambda *args: entries(*args).reshape(k, k)


def _unpacked(made: Program, traced: TracedEquation) -> Callable:
    sizes = np.cumsum([nodes.size for nodes in traced.rows.values()])[:-1].tolist()
    flat = function_of(made, traced, [node for nodes in traced.rows.values() for node in nodes.ravel().tolist()])

    def unpack(state, u, t, h, params):
        parts = jnp.split(flat(u, state, t, h, params), sizes)
        return {name: part.reshape(nodes.shape) for part, (name, nodes) in zip(parts, traced.rows.items(), strict=True)}

    return unpack


def _replaced(stage: StepEquation, made: Program, traced: TracedEquation) -> StepEquation:
    return StepEquation(
        start=stage.start,
        residual=function_of(made, traced, traced.residual) if stage.unknowns else stage.residual,
        advance=function_of(made, traced, traced.advance),
        unpack=_unpacked(made, traced),
        state_size=stage.state_size,
        unknowns=stage.unknowns,
        fields=stage.fields,
        guess=stage.guess,
        scale=stage.scale,
        labels=stage.labels,
        needs_leaving_step=stage.needs_leaving_step,
        canonical=stage.canonical,
    )
