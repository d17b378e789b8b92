"""The sizes of the unknowns of a step, looked at closely: in numbers by its scalar program, and by JAX.

`sizes.py` says what they are.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.engines.first_sizes import NOTHING, TYPICAL
from dirax.engines.stage_look import END, RESIDUAL, SLOPES, TERMS, stage_look
from dirax.engines.step_program import StepProgram
from dirax.engines.stopping import STALLED
from dirax.numerics.equilibration import LEAST_SIZE, balanced_inverse, power_of_two
from dirax.numerics.tolerances import EPSILON
from dirax.program.rounding import rounding
from dirax.program.side_by_side import one_by_one, side_by_side
from dirax.schemes.step import first_of_each


@dataclass(frozen=True)
class Entries:
    """Where some steps begin, entry by entry: state (entries, s), first guesses of each stage (entries, k), t and h (entries,),
    parameters (entries, …); and the program of the step."""

    program: StepProgram
    stages: tuple
    state: np.ndarray
    guesses: Sequence[np.ndarray]
    t: np.ndarray
    h: np.ndarray
    leaves: np.ndarray


def close_sizes(at: Entries) -> list[np.ndarray]:
    """The sizes (entries, k) of each stage, once for stages that are equal. Raises `GraphTooLarge`."""

    def look(i, u, *places, sizes=None, only=()):
        """At several states, with a part of the step each: all of them at once, which is much quicker."""
        many = lambda a: np.concatenate([a] * len(places))
        x, steps = np.concatenate([x for x, _ in places]), np.concatenate([part * h[i] for _, part in places])
        sizes = many(np.abs(u) if sizes is None else sizes)
        values = stage_look(at.program, i)(many(u), x, many(at.t), steps, many(at.leaves), sizes, only)
        return zip(*(np.split(a, len(places)) for a in values), strict=True)

    stages, guesses, state, end = at.stages, at.guesses, at.state, at.state
    h = [fraction * at.h for _, fraction in stages]
    for i in first_of_each(stages):
        stage_look(at.program, i).runs += 1
        ((residual, slopes),) = look(i, guesses[i], (end, SHORT), only=(RESIDUAL, SLOPES))
        ((end,),) = look(i, _updated(residual, slopes, guesses[i], np), (end, SHORT), only=(END,))
    end = end * _nearby(end.shape[1])
    found: list[np.ndarray] = []
    for i, (stage, u) in enumerate(zip(stages, guesses, strict=True)):
        same = next((j for j in range(i) if stages[j] == stage and np.array_equal(guesses[j], u)), None)
        if same is None:
            places, both = [(x, part) for part in (1.0, SHORT) for x in (state, end)], ((state, 1.0), (end, 1.0))
            (residual, *here), (_, *there), (_, short, _), (_, near, _) = look(i, u, *places, only=OF_SIZES)
            again = lambda s, i=i, u=u, both=both: [a for (a,) in look(i, u, *both, sizes=s, only=(TERMS,))]
            after = lambda u, i=i: next(look(i, u, (state, 1.0), only=(END,)))[0]
            slopes, rounded = zip(here, there, strict=True)
            found.append(_sizes(residual, slopes, (short, near), u, rounded, again, after, h[i][:, None], np))
        else:
            found.append(found[same])
    return found


def sizes_at(equation: Any, state: Any, guess: tuple, params: Any, t: Any, h: Any, axes: tuple | None = None) -> tuple:
    """The sizes of each stage of a step from a state, over a batch with the `axes` of (state, guess, params, t), by JAX.

    States are looked at one after the other, for the reason that `side_by_side.py` gives."""

    def one(state, guess, params, t):
        def linear(i, u, xs, part):
            """At several states, each with its part of the step; they are one program."""
            stage, fraction = equation.stages[i]

            def at(x, h):
                residual = lambda u, h: stage.residual(u, x, t, h, params)
                by_u, by_h = jax.jacfwd(residual, argnums=(0, 1))(u, h)
                return residual(u, h), jnp.concatenate([by_u, by_h[:, None]], axis=1)

            return one_by_one(at, (0, 0))(jnp.stack(xs), jnp.array(part) * fraction * h)

        def terms(i, u, xs, sizes):
            stage, fraction = equation.stages[i]
            residual = lambda u, x, t, h: stage.residual(u, x, t, h, params)

            def at(x):
                numbers = u, x, t, fraction * h
                return rounding(residual, *numbers, errors=(sizes, *map(jnp.abs, numbers[1:])))

            return one_by_one(at, (0,))(jnp.stack(xs))

        end, found = state, []
        for i in first_of_each(equation.stages):
            stage, fraction = equation.stages[i]
            (residual,), (slopes,) = linear(i, guess[i], [end], [SHORT])
            end = stage.advance(_updated(residual, slopes, guess[i], jnp), end, t, SHORT * fraction * h, params)
        end = end * _nearby(len(state))
        for i, u in enumerate(guess):
            residuals, (*slopes, short, near) = linear(i, u, [state, end, state, end], [1.0, 1.0, SHORT, SHORT])
            again = lambda sizes, i=i, u=u: [*terms(i, u, [state, end], sizes)]
            part, stage = equation.stages[i][1] * h, equation.stages[i][0]
            after = lambda u, stage=stage, part=part: stage.advance(u, state, t, part, params)
            found.append(_sizes(residuals[0], slopes, (short, near), u, again(jnp.abs(u)), again, after, part, jnp))
        return tuple(found)

    given = jnp.asarray(state, float), tuple(jnp.asarray(u, float) for u in guess), params, t
    return one(*given) if axes is None else side_by_side(one, axes)(*given)


def _updated(residual: Any, slopes: Any, u: Any, xp: ModuleType) -> Any:
    """The unknowns (…, k) after one update of Newton's method; as they were where that is not finite."""
    k = u.shape[-1]
    if not k:
        return u
    with np.errstate(all="ignore"):
        change = (balanced_inverse(slopes[..., :k], xp) @ residual[..., None])[..., 0]
    return u - xp.where(xp.all(xp.isfinite(change), axis=-1, keepdims=True), change, 0.0)


OF_SIZES = RESIDUAL, SLOPES, TERMS
"""What is looked at everywhere."""

SHORT = 0.25
"""The part of a step whose equations are inverted: those of a step that is too long may be singular anywhere."""

NEAR = 1.0 / 16.0
"""How much, relative, the data are changed to see what derivatives are near them."""


MOST = 2.0**8
"""What is too much for the size of an unknown, beside its value and its size by the derivatives of whole steps: at a first guess
that is far off, those of a short step and the terms of a whole one may be worlds apart."""

COUPLED = 1e-3
"""Unknowns that change others by less than this of their sizes are not coupled."""

ZERO = 2.0**20 * LEAST_SIZE
"""Sizes below this are those of nothing."""

ROUNDINGS = 64.0
"""Roundings up to which an unknown is zero."""


def _nearby(count: int) -> np.ndarray:
    """A factor near 1 for each of so many numbers, all of them different."""
    return 1.0 + NEAR * (np.modf(np.arange(1, count + 1) * (np.sqrt(5.0) - 1.0) / 2.0)[0] - 0.5)


def _sizes(
    residual: Any,
    slopes: Sequence,
    short: Sequence,
    u: Any,
    rounded: Sequence,
    again: Callable,
    after: Callable,
    h: Any,
    xp: ModuleType,
) -> Any:
    """(…, k) from r (…, k) at the state, its derivatives by (u, h) there and near the end of a short step, and those of a short
    step at either place, (…, k, k + 1); `rounded` are the sizes of the terms (…, k) at either, and `again` those with unknowns of
    given sizes; `after` is the state after the step with given unknowns."""
    if not u.shape[-1]:
        return xp.ones(u.shape)
    k, applied = u.shape[-1], lambda matrix, vector: (matrix @ vector[..., None])[..., 0]
    finite = lambda sizes: xp.where(xp.isfinite(sizes), sizes, 0.0)
    with np.errstate(all="ignore"):
        both = slopes[0], short[1]
        inverse, other, *others = balanced_inverse(xp.stack([d[..., :k] for d in (*slopes, *short)]), xp)
        solution = xp.abs(u - finite(applied(inverse, residual)))
        largest = xp.maximum(xp.abs(u), solution)
        inverses = [xp.abs(other) for other in others]

        def of_terms(rounded):
            terms = [of + applied(xp.abs(d[..., :k]), largest) for of, d in zip(rounded, both, strict=True)]
            sizes = [TYPICAL * finite(applied(other, of)) for other, of in zip(inverses, terms, strict=True)]
            whole = [applied(xp.abs(one), of) for one, of in zip((inverse, other), rounded, strict=True)]
            most = xp.maximum(largest, xp.maximum(*map(finite, whole)))
            return terms, xp.minimum(xp.maximum(*sizes), xp.where(most > 0.0, MOST * most, xp.inf))

        terms, sizes = of_terms(rounded)
        blurred = EPSILON * finite(applied(xp.abs(inverse), terms[0]))
        moved = finite(applied(xp.abs(inverse), xp.abs(h * slopes[0][..., -1])))
        reached = solution + xp.sqrt(moved * blurred / EPSILON)
        known = blurred <= 4.0 * STALLED * reached
        coupling = (finite(i @ xp.abs(d[..., :k])) for i, d in zip((xp.abs(inverse), inverses[1]), both, strict=True))
        coupled = xp.maximum(*coupling) * blurred[..., None, :] > COUPLED * blurred[..., None]
        coupled = coupled & xp.swapaxes(coupled, -1, -2)
        hidden = ~known & (solution > ROUNDINGS * blurred) & ~xp.any(coupled & known[..., None, :], axis=-1)
        if xp is not np or np.any(hidden):
            end, moved_end = xp.abs(after(u)), xp.abs(after(u + xp.where(hidden, blurred, 0.0)) - after(u))
            lost = (moved_end > 4.0 * STALLED * end) & (end > ROUNDINGS * moved_end)
            too_short = xp.any(hidden, axis=-1, keepdims=True) & xp.any(lost, axis=-1, keepdims=True)
            sizes = xp.where(too_short, reached, sizes)
        unknowns = xp.maximum(sizes, xp.abs(u))
        rounded = again(unknowns)
        more, matters = of_terms(rounded)[1], _matters(slopes[0][..., :k], rounded[0], xp)
        more = xp.where((more < ZERO) & (matters < xp.inf), TYPICAL * matters, more)
        return power_of_two(xp.where(unknowns < NOTHING * more, more, unknowns), xp)


def _matters(slopes: Any, terms: Any, xp: ModuleType) -> Any:
    """The least size (…, k) at which an unknown matters in an equation that has terms (…, k) and it among them; ∞ in none."""
    there = (slopes != 0.0) & (terms[..., None] > 0.0)
    sizes = xp.where(there, terms[..., None] / xp.abs(xp.where(there, slopes, 1.0)), xp.inf)
    return xp.min(xp.where(sizes > ZERO, sizes, xp.inf), axis=-2)
