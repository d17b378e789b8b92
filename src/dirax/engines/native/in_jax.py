"""The scalar graph given back as JAX functions."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from dirax.engines.native.compensation import increments
from dirax.engines.native.interpret import UnsupportedPrimitive
from dirax.engines.native.program import Program, program
from dirax.engines.native.trace import TracedEquation
from dirax.schemes.step import StepEquation, StepSequence

OPERATIONS: dict[str, Callable] = {
    **{name: getattr(jax.lax, name) for name in ("add", "sub", "mul", "neg", "abs", "sqrt", "floor", "ceil", "sign")},
    **{name: getattr(jax.lax, name) for name in ("max", "min", "rem", "sin", "cos", "tan", "asin", "acos", "atan", "atan2")},
    **{name: getattr(jax.lax, name) for name in ("sinh", "cosh", "tanh", "asinh", "acosh", "atanh", "exp", "exp2", "expm1")},
    **{name: getattr(jax.lax, name) for name in ("log", "log1p", "pow", "cbrt", "erf", "erfc", "lt", "le", "eq", "ne")},
    "recip": jax.lax.reciprocal,
    "round": jnp.rint,
    "trunc": jnp.trunc,
    "select": lambda condition, yes, no: jax.lax.select(condition, *map(jnp.asarray, (yes, no))),
    "finite": jax.lax.is_finite,
    "and": jax.lax.bitwise_and,
    "or": jax.lax.bitwise_or,
    "not": jax.lax.bitwise_not,
}
"""What the operations of the graph are on scalars in JAX."""


def function_of(made: Program, equation: TracedEquation, outputs: list[int]) -> Callable:
    """(u, state, t, h, params) ↦ the nodes `outputs` of a traced equation, as one array."""
    g, shared = made.graph, made.shared

    def evaluated(u, state, t, h, params):
        leaves = [leaf for leaf, moves in zip(jax.tree.leaves(params), made.parameters.dynamic, strict=True) if moves]
        numbers = [x for leaf in leaves for x in jnp.ravel(jnp.asarray(leaf, float))]
        values: dict[int, Any] = {shared.t: jnp.asarray(t, float), shared.h: jnp.asarray(h, float)}
        values.update(zip(shared.params, numbers, strict=True))
        values.update(zip([*equation.unknowns, *equation.state], [*u, *state], strict=True))
        for node in g.reachable(outputs, values):
            if g.is_constant(node):
                values[node] = jnp.asarray(g.value[node])
        return jnp.stack([jnp.asarray(x, float) for x in g.evaluate(outputs, {}, OPERATIONS, values)])

    return evaluated


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


def in_scalars(equation: Any, params: Any, batch_params: bool) -> Any:
    """The equation with its residual and its advance as scalar programs; the same object for the same program, and the
    equation itself where it is none."""
    try:
        made, _ = program(equation, params, batch_params)
    except UnsupportedPrimitive:
        return equation
    if made.as_scalars is None:
        distinct = {index: stage for (index, _), (stage, _) in zip(made.stages, equation.stages, strict=True)}
        new = {i: _replaced(stage, made, made.equations[i]) for i, stage in distinct.items()}
        single = len(equation.stages) == 1 and equation.stages[0][1] == 1.0
        stages = tuple((new[i], fraction) for i, fraction in made.stages)
        made.as_scalars = stages[0][0] if single else StepSequence(stages)
    return made.as_scalars


def _replaced(stage: StepEquation, made: Program, traced: TracedEquation) -> StepEquation:
    return StepEquation(
        start=stage.start,
        residual=function_of(made, traced, traced.residual) if stage.unknowns else stage.residual,
        advance=function_of(made, traced, traced.advance),
        unpack=stage.unpack,
        state_size=stage.state_size,
        unknowns=stage.unknowns,
        fields=stage.fields,
        guess=stage.guess,
        scale=stage.scale,
        labels=stage.labels,
        needs_leaving_step=stage.needs_leaving_step,
        canonical=stage.canonical,
    )
