"""The derivative of single steps, each at the solution of its equations."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dirax.diagnostics.rows import over_rows
from dirax.engines.sizes import sizes_near
from dirax.engines.steps_in_numbers import StepsInNumbers
from dirax.engines.xla.lane import first_lane, take_step
from dirax.numerics.equilibration import condition_number
from dirax.program.evaluation.noise import Noise
from dirax.program.linear_solves import solve
from dirax.program.memo import Same
from dirax.schemes.discrete_structure import DifferentiatedStep
from dirax.solution.solution import Solution

MAX_ITERATIONS = 50


def differentiated_steps(
    sol: Solution, states: np.ndarray, guesses: Sequence[np.ndarray], t: np.ndarray, noise: Noise | None = None
) -> DifferentiatedStep:
    """The steps from states (B, rows, s) at times (B, rows), from first guesses (B, rows, k) of every part: arrays (B, rows, …),
    NaN where a step has no solution. By their scalar program, where there is one; nothing is compiled then. `noise`: of the
    arithmetic; of the states and of the entries of the Jacobians alone, where the step is compiled."""
    lanes, rows, size = states.shape
    if (steps := StepsInNumbers.found(sol.equation, sol.given_params, sol.batch_params)) is None:
        blur = np.zeros((lanes, rows, 2))
        if noise:
            states, blur = noise.off(states), np.stack([np.full((lanes, rows), noise.size), noise.draw((lanes, rows))], axis=-1)
        items = states, tuple(guesses), t, blur
        items = items if sol.batch is not None else jax.tree.map(lambda a: a[0], items)
        flat = over_rows(eqx.Partial(_by_jax, Same(sol.equation), sol.step), sol, items)
        jacobians = flat[..., size:-1].reshape(lanes, rows, size, size)
        return DifferentiatedStep(flat[..., :size], jacobians, flat[..., -1])
    of_states = np.repeat(np.arange(lanes), rows)
    params = steps.parameters(sol.given_params, sol.batch if sol.batch_params else None, of_states)
    joined = lambda a: a.reshape(lanes * rows, *a.shape[2:])
    given = joined(states), [joined(guess) for guess in guesses], joined(t)
    made = steps.step(*given, sol.step, params, noise)
    jacobians, conditions = steps.differentiated(made, joined(t), sol.step, params, noise)
    good = np.where(made.good, 1.0, np.nan)
    apart = lambda a: a.reshape(lanes, rows, *a.shape[1:])
    return DifferentiatedStep(apart(made.after * good[:, None]), apart(jacobians * good[:, None, None]), apart(conditions))


def _by_jax(same: Same, h: Any, state, guesses, t, blur, params):
    step = differentiated_step(same.object, h, state, guesses, t, params, blur)
    return jnp.concatenate([step.state, step.jacobian.ravel(), step.condition[None]])


def differentiated_step(equation: Any, h: Any, state, guesses, t, params, blur=(0.0, 0.0)) -> DifferentiatedStep:
    """One step solved by the engine's Newton method from a guess for each part, differentiated by the implicit function theorem;
    NaN where it fails. `blur`: by how much entries of Jacobians are off, and the number in [0, 1) that decides by how much each.

    With r(u, x) = 0 and x' = a(u, x) of each stage, ∂x'/∂x = ∂_x a − ∂_u a (∂_u r)⁻¹ ∂_x r.
    """
    lane, sizes = first_lane(state, guesses), sizes_near(equation, state, guesses, t, h, params)
    after, unknowns, _ = take_step(equation, lane, t, h, params, sizes, MAX_ITERATIONS, differentiable=False)
    jacobian, condition = jnp.eye(state.shape[0]), jnp.ones(())

    def blurred(matrix):
        return matrix * (1.0 + blur[0] * jnp.sin(1e4 * blur[1] * jnp.arange(1.0, 1.0 + matrix.size)).reshape(matrix.shape))

    for (stage, fraction), u in zip(equation.stages, unknowns, strict=True):

        def both(u, x, stage=stage, at=(t, fraction * h, params)):
            return stage.residual(u, x, *at), stage.advance(u, x, *at)

        (residual_u, residual_x), (advance_u, advance_x) = jax.tree.map(blurred, jax.jacfwd(both, argnums=(0, 1))(u, state))
        if stage.unknowns:
            advance_x = advance_x - advance_u @ solve(residual_u, residual_x)
            condition = jnp.maximum(condition, condition_number(residual_u, jnp))
        jacobian = advance_x @ jacobian
        state = stage.advance(u, state, t, fraction * h, params)
        t = t + fraction * h
    good = after.completed > 0
    return DifferentiatedStep(jnp.where(good, state, jnp.nan), jnp.where(good, jacobian, jnp.nan), condition)
