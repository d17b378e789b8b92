"""How large the unknowns and the equations of a step are: the units in which an engine measures them.

The residual r of a step is a sum of terms of the size |r| + |r_u||u| + |r_x||x|, at the first guess u and the first state x; a
last place of each changes the solution by

    ε |r_u⁻¹| (|r| + |r_u||u| + |r_x||x|)        (Skeel 1979),

the roundoff of the unknowns. Without the ε this is the size of an unknown, and |r_u| times these sizes that of an equation.
Both are rounded to powers of two, by which one multiplies without rounding, and scale with the units of lengths, masses and
times: nothing in an engine is compared with 1.
"""

from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.engines.contract import Problem
from dirax.numerics.equilibration import inverse_sizes, power_of_two
from dirax.program.compiled import compiled


def sizes_of(problem: Problem) -> tuple[np.ndarray, ...]:
    """The sizes of the unknowns and of the equations of each stage, (2, k) or (B, 2, k), of a problem in numbers."""
    if problem.sizes is not None:
        return tuple(map(np.asarray, problem.sizes))
    found = _in_numbers(problem)
    return tuple(map(np.asarray, _compiled(*_arguments(problem)))) if found is None else found


def sizes_by_jax(problem: Problem) -> tuple[jax.Array, ...]:
    """The same of a problem that JAX traces, without derivatives."""
    if problem.sizes is not None:
        return tuple(map(jnp.asarray, problem.sizes))
    return jax.lax.stop_gradient(_by_jax(*_arguments(problem)))


def _in_numbers(p: Problem) -> tuple[np.ndarray, ...] | None:
    """By the scalar program of the step, equal stages side by side; None where it has none."""
    from dirax.engines.step_program import linearized  # imported when it is used

    batch, stages = p.batch or 1, p.equation.stages
    state = np.asarray(p.state, float).reshape(batch, -1)
    t = np.full(batch, p.t0 + p.first_step * p.h)
    found: list[np.ndarray] = []
    for number, (stage, fraction) in enumerate(stages):
        u = np.asarray(p.guess[number], float).reshape(batch, -1)
        same = [i for i in range(number) if stages[i] == (stage, fraction) and np.array_equal(p.guess[i], p.guess[number])]
        if same:
            found.append(found[same[0]])
            continue
        if not stage.unknowns:
            found.append(np.ones((batch, 2, 0)))
            continue
        h = np.full(batch, fraction * p.h)
        linear = linearized(p.equation, p.params, p.batch_params, u, state, t, h, number, True)
        if linear is None:
            return None
        found.append(_sizes(*linear, u, state, np))
    return tuple(found if p.batch is not None else [a[0] for a in found])


def _sizes(residual: Any, slopes: Any, u: Any, state: Any, xp: ModuleType) -> Any:
    """(…, 2, k) from r (…, k) and its derivatives by (u, x), (…, k, k + s)."""
    k = u.shape[-1]
    with np.errstate(all="ignore"):
        signed, slopes, numbers = slopes, xp.abs(slopes), xp.abs(xp.concatenate([u, state], axis=-1))
        terms = xp.abs(residual) + (slopes @ numbers[..., None])[..., 0]
        change = (inverse_sizes(signed[..., :k], xp) @ terms[..., None])[..., 0]
        change = xp.where(xp.isfinite(change), change, xp.abs(u))  # of a singular equation
        unknowns = power_of_two(change, xp)
        equations = power_of_two((slopes[..., :k] @ unknowns[..., None])[..., 0], xp)
    return xp.stack([unknowns, equations], axis=-2)


def _arguments(p: Problem) -> tuple:
    axes = None if p.batch is None else (0, 0, 0 if p.batch_params else None)
    t, h = jnp.asarray(p.t0 + p.first_step * p.h, float), jnp.asarray(p.h, float)
    return p.equation, jnp.asarray(p.state), tuple(map(jnp.asarray, p.guess)), jax.tree.map(jnp.asarray, p.params), t, h, axes


def _by_jax(equation: Any, state: Any, guess: tuple, params: Any, t: Any, h: Any, axes: tuple | None) -> tuple:
    def one(state, guess, params):
        found = []
        for (stage, fraction), u in zip(equation.stages, guess, strict=True):
            if not stage.unknowns:
                found.append(jnp.ones((2, 0)))
                continue
            residual = lambda u, x, stage=stage, fraction=fraction: stage.residual(u, x, t, fraction * h, params)
            slopes = jnp.concatenate(jax.jacfwd(residual, argnums=(0, 1))(u, state), axis=1)
            found.append(_sizes(residual(u, state), slopes, u, state, jnp))
        return tuple(found)

    given = jnp.asarray(state, float), tuple(jnp.asarray(u, float) for u in guess), params
    return one(*given) if axes is None else jax.vmap(one, in_axes=axes)(*given)


_compiled = compiled(_by_jax)
