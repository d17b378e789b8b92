"""The derivative of one step, at the engine's solution of it."""

from typing import Any

import jax
import jax.numpy as jnp

from dirax.engines.xla.lane import first_lane, take_step
from dirax.numerics.equilibration import condition_number
from dirax.numerics.tolerances import TINY
from dirax.program.linear_solves import solve
from dirax.schemes.discrete_structure import DifferentiatedStep

MAX_ITERATIONS = 50


def differentiated_step(equation: Any, h: Any, state, guess, t, params) -> DifferentiatedStep:
    """One step solved by the engine's Newton method, differentiated by the implicit function theorem; NaN where it fails.

    With r(u, x) = 0 and x' = a(u, x) of each stage, ∂x'/∂x = ∂_x a − ∂_u a (∂_u r)⁻¹ ∂_x r.
    """
    lane = first_lane(state, (guess,) * len(equation.stages))
    sizes = tuple(_sizes(stage, guess, state, t, fraction * h, params) for stage, fraction in equation.stages)
    after, unknowns, _ = take_step(equation, lane, t, h, params, sizes, MAX_ITERATIONS, differentiable=False)
    jacobian, condition = jnp.eye(state.shape[0]), jnp.ones(())
    for (stage, fraction), u in zip(equation.stages, unknowns, strict=True):

        def both(u, x, stage=stage, at=(t, fraction * h, params)):
            return stage.residual(u, x, *at), stage.advance(u, x, *at)

        (residual_u, residual_x), (advance_u, advance_x) = jax.jacfwd(both, argnums=(0, 1))(u, state)
        if stage.unknowns:
            advance_x = advance_x - advance_u @ solve(residual_u, residual_x)
            condition = jnp.maximum(condition, condition_number(residual_u, jnp))
        jacobian = advance_x @ jacobian
        state = stage.advance(u, state, t, fraction * h, params)
        t = t + fraction * h
    good = after.completed > 0
    return DifferentiatedStep(jnp.where(good, state, jnp.nan), jnp.where(good, jacobian, jnp.nan), condition)


def _sizes(stage: Any, u, state, t, h, params):
    """The sizes of the unknowns near u, as `dirax.engines.sizes` has them but for their rounding; 1 for the equations."""
    if not stage.unknowns:
        return jnp.ones((2, 0))
    by_u, by_state = jax.jacfwd(lambda u, x: stage.residual(u, x, t, h, params), argnums=(0, 1))(u, state)
    terms = jnp.abs(by_u) @ jnp.abs(u) + jnp.abs(by_state) @ jnp.abs(state)
    size = jnp.abs(solve(by_u, jnp.eye(len(u)))) @ terms
    return jnp.stack([jnp.where(size > TINY, size, TINY), jnp.ones(len(u))])
