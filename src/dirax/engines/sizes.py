"""How large the unknowns and the equations of a step are: the units in which an engine measures them.

At the first guess u and the first state x of a step with the residual r, the terms of its equations have the sizes
|r| + |r_u||u| + |r_x||x|, and a last place of each changes the unknowns by

    ε |r_u⁻¹| (|r| + |r_u||u| + |r_x||x|)        (Skeel 1979).

Without the ε this is the size of an unknown, and |r_u| times these sizes that of an equation. Data may be special, such as a
link that hangs straight: what the derivatives are near them counts as well. All sizes are rounded to powers of two, by which one
multiplies without rounding, and they scale with the units of lengths, masses and times: nothing in an engine is compared with 1.

A velocity under constraints, whose size is |q|/h in short steps, is known to ε|q|/h. Where that is more than STALLED of what it
comes to, v, or √(a|q|) where motion begins with the acceleration a, and where nothing that it is coupled to is known better, the
step is too short for double precision, and the unknowns have that size instead: Newton's method will not converge.
"""

from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.engines.contract import Problem
from dirax.engines.stopping import STALLED
from dirax.numerics.equilibration import inverse_sizes, power_of_two
from dirax.numerics.tolerances import EPSILON
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
        near = linearized(p.equation, p.params, p.batch_params, u, state * _nearby(state.shape[1]), t, h, number, True)
        assert near is not None
        found.append(_sizes(*linear, near[1], u, state, h[:, None], np))
    return tuple(found if p.batch is not None else [a[0] for a in found])


NEAR = 1.0 / 16.0
"""How much, relative, the data are changed to see what derivatives are near them."""


COUPLED = 1e-8
"""Unknowns that change each other by less than this of their sizes are not coupled."""

ROUNDINGS = 64.0
"""Roundings up to which an unknown is zero."""


def _nearby(count: int) -> np.ndarray:
    """A factor near 1 for each of so many numbers, all of them different."""
    return 1.0 + NEAR * (np.modf(np.arange(1, count + 1) * (np.sqrt(5.0) - 1.0) / 2.0)[0] - 0.5)


def _sizes(residual: Any, slopes: Any, near: Any, u: Any, state: Any, h: Any, xp: ModuleType) -> Any:
    """(…, 2, k) from r (…, k) and its derivatives by (u, x, h) at the data and near them, (…, k, k + s + 1)."""
    k, applied = u.shape[-1], lambda matrix, vector: (matrix @ vector[..., None])[..., 0]
    finite = lambda sizes: xp.where(xp.isfinite(sizes), sizes, 0.0)
    with np.errstate(all="ignore"):
        numbers, both = xp.abs(xp.concatenate([u, state], axis=-1)), (slopes, near)
        inverses = [inverse_sizes(derivatives[..., :k], xp) for derivatives in both]
        sizes = [
            finite(applied(inverse, xp.abs(residual) + applied(xp.abs(derivatives[..., :-1]), numbers)))
            for inverse, derivatives in zip(inverses, both, strict=True)
        ]
        reached = xp.abs(u) + xp.sqrt(finite(applied(inverses[0], xp.abs(h * slopes[..., -1]))) * sizes[0])
        known = EPSILON * sizes[0] <= STALLED * reached
        coupling = (finite(i @ xp.abs(d[..., :k])) for i, d in zip(inverses, both, strict=True))
        coupled = xp.maximum(*coupling) * sizes[0][..., None, :] > COUPLED * sizes[0][..., None]
        hidden = ~known & (xp.abs(u) > ROUNDINGS * EPSILON * sizes[0]) & ~xp.any(coupled & known[..., None, :], axis=-1)
        too_short = xp.any(hidden, axis=-1, keepdims=True)
        unknowns = power_of_two(xp.maximum(xp.where(too_short, reached, xp.maximum(*sizes)), xp.abs(u)), xp)
        equations = (finite(applied(xp.abs(derivatives[..., :k]), unknowns)) for derivatives in both)
        return xp.stack([unknowns, power_of_two(xp.maximum(*equations), xp)], axis=-2)


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
            residual = lambda u, x, h, stage=stage: stage.residual(u, x, t, h, params)
            part = fraction * h

            def slopes(x, u=u, residual=residual, part=part):
                by_u, by_x, by_h = jax.jacfwd(residual, argnums=(0, 1, 2))(u, x, part)
                return jnp.concatenate([by_u, by_x, by_h[:, None]], axis=1)

            near = slopes(state * _nearby(len(state)))
            found.append(_sizes(residual(u, state, part), slopes(state), near, u, state, part, jnp))
        return tuple(found)

    given = jnp.asarray(state, float), tuple(jnp.asarray(u, float) for u in guess), params
    return one(*given) if axes is None else jax.vmap(one, in_axes=axes)(*given)


_compiled = compiled(_by_jax)
