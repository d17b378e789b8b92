"""How large the unknowns of a step are: the units in which an engine measures them.

At the first guess u and the first state x of a step with the residual r, the terms of its equations have the sizes E that
`program/rounding.py` finds, however they cancel, and |r_u||u*| at the solution u* of the linearized step. A last place of each
changes the unknowns by

    ε |r_u⁻¹| (E + |r_u||u*|)        (Skeel 1979).

Without the ε this is the size of an unknown. Data may be special, such as a link that hangs straight: what the derivatives are
near the end of a short step counts as well. All sizes are rounded to powers of two, and they scale with the units of lengths,
masses and times: nothing in an engine is compared with 1. An equation is as large as its terms, |r_u|(|u| + sizes), wherever
Newton's method stands.

A velocity under constraints, whose size is |q|/h in short steps, is known to ε|q|/h. Where that is more than 4·STALLED of what it
comes to, v, or √(a|q|) where motion begins with the acceleration a, and where nothing that it is coupled to is known better and
the state after the step is lost with it, the step is too short for double precision, and the unknowns have that size instead:
Newton's method will not converge.

All this is for data that are special, and takes milliseconds. `first_sizes.py` has the sizes from one linearization alone, and
says where they leave no doubt: they are those of most runs, and a kernel of the native engine finds them itself in no time. Steps
of very many unknowns are measured by 1.
"""

import dataclasses
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.engines.contract import Problem
from dirax.engines.first_sizes import NOTHING, TYPICAL, first_sizes
from dirax.engines.stage_look import END, RESIDUAL, SLOPES, TERMS, stage_look
from dirax.engines.stopping import STALLED
from dirax.numerics.equilibration import LEAST_SIZE, balanced_inverse, power_of_two
from dirax.numerics.tolerances import EPSILON, TINY
from dirax.program.compiled import compiled
from dirax.program.linear_solves import solve
from dirax.program.roots import FEWEST_SPARSE
from dirax.program.rounding import rounding


def sizes_of(problem: Problem) -> tuple[np.ndarray, ...]:
    """The sizes of the unknowns of each stage, (k,) or (B, k), of a problem in numbers."""
    if problem.size >= FEWEST_SPARSE:
        return tuple(np.ones(np.shape(guess)) for guess in problem.guess)
    found, sure = _first_in_numbers(problem) or (None, np.zeros(problem.batch or 1, bool))
    if found is not None and np.all(sure):
        return found
    closer = _closely(problem, _start(problem))
    if found is None:
        return closer
    chosen = sure[:, None] if problem.batch is not None else sure[0]
    return tuple(np.where(chosen, a, b) for a, b in zip(found, closer, strict=True))


def sizes_by_jax(problem: Problem) -> tuple[jax.Array, ...]:
    """The same of a problem that JAX traces, without derivatives."""
    if problem.size >= FEWEST_SPARSE:
        return tuple(map(jnp.asarray, sizes_of(problem)))
    return jax.lax.stop_gradient(sizes_at(*_arguments(problem, _start(problem))))


def grown(problem: Problem, lanes: np.ndarray, completed: np.ndarray, state: np.ndarray, guess: tuple, sizes: tuple) -> tuple:
    """The sizes of trajectories at which Newton's method stopped too early or not at all, and which of them grew: the largest of
    those where they began and of those where they stand, after `completed` steps at `state` (lanes, s) with the unknowns `guess`.

    Data may be so special where a run begins that an unknown has no size there. Everything has an axis of the `lanes`."""
    found = sizes_there(problem, lanes, completed, state, guess)
    more = np.any([np.any(new > old, axis=1) for new, old in zip(found, sizes, strict=True)], axis=0)
    return tuple(np.maximum(new, old) for new, old in zip(found, sizes, strict=True)), more


def sizes_there(problem: Problem, lanes: np.ndarray, completed: np.ndarray, state: np.ndarray, guess: tuple) -> tuple:
    """The sizes of some trajectories where they stand, looked at closely; arguments as above."""
    p = problem
    if p.size >= FEWEST_SPARSE:
        return tuple(np.ones((len(lanes), np.shape(u)[-1])) for u in guess)
    moved = lambda a: np.asarray(a)[lanes] if p.batch is not None else np.asarray(a)[None][lanes]
    params = jax.tree.map(moved, p.params) if p.batch_params else p.params
    here = dataclasses.replace(p, state=state, guess=guess, params=params, batch=len(lanes))
    return _closely(here, p.t0 + (p.first_step + completed) * p.h)


def _start(p: Problem) -> Any:
    """The time at which the first step begins."""
    return p.t0 + p.first_step * p.h


def _closely(p: Problem, t: Any) -> tuple[np.ndarray, ...]:
    """The sizes at the time t, () or (B,), looked at closely."""
    found = _in_numbers(p, t)
    return tuple(map(np.asarray, _compiled(*_arguments(p, t)))) if found is None else found


def _in_numbers(p: Problem, t: Any) -> tuple[np.ndarray, ...] | None:
    """By the scalar program of the step at the time t, () or (B,), once for stages that are equal; None where it has none."""
    from dirax.engines.step_program import step_program  # imported when it is used
    from dirax.program.graph import GraphTooLarge
    from dirax.program.interpreter import UnsupportedPrimitive

    batch, stages, key = p.batch or 1, p.equation.stages, (p.params, p.batch_params)
    t, state = np.broadcast_to(np.asarray(t, float), (batch,)), np.asarray(p.state, float).reshape(batch, -1)
    guesses, h = [np.asarray(g, float).reshape(batch, -1) for g in p.guess], [np.full(batch, a * p.h) for _, a in stages]
    firsts = _first_of_each(stages)
    try:
        program = step_program(p.equation, *key)
        leaves = program.parameters.flatten(p.params, p.batch if p.batch_params else None)
        leaves = np.broadcast_to(leaves, (batch, program.parameters.size))

        def look(i, u, *places, sizes=None, only=()):
            """At several states, with a part of the step each: all of them at once, which is much quicker."""
            many = lambda a: np.concatenate([a] * len(places))
            x, steps = np.concatenate([x for x, _ in places]), np.concatenate([part * h[i] for _, part in places])
            sizes = many(np.abs(u) if sizes is None else sizes)
            values = stage_look(program, i)(many(u), x, many(t), steps, many(leaves), sizes, only)
            return zip(*(np.split(a, len(places)) for a in values), strict=True)

        end = state
        for i in firsts:
            stage_look(program, i).runs += 1
            ((residual, slopes),) = look(i, guesses[i], (end, SHORT), only=(RESIDUAL, SLOPES))
            ((end,),) = look(i, _updated(residual, slopes, guesses[i], np), (end, SHORT), only=(END,))
        end = end * _nearby(end.shape[1])
        found: list[np.ndarray] = []
        for i, (stage, u) in enumerate(zip(stages, guesses, strict=True)):
            same = next((j for j in range(i) if stages[j] == stage and np.array_equal(guesses[j], u)), None)
            if same is None:
                there, both = [(x, part) for part in (1.0, SHORT) for x in (state, end)], ((state, 1.0), (end, 1.0))
                (residual, slopes, terms), (*_, other), (_, short, _), (_, near, _) = look(i, u, *there, only=OF_SIZES)
                again = lambda s, i=i, u=u, both=both: [a for (a,) in look(i, u, *both, sizes=s, only=(TERMS,))]
                after = lambda u, i=i: next(look(i, u, (state, 1.0), only=(END,)))[0]
                found.append(_sizes(residual, slopes, short, near, u, (terms, other), again, after, h[i][:, None], np))
            else:
                found.append(found[same])
    except (UnsupportedPrimitive, GraphTooLarge):
        return None
    return tuple(found if p.batch is not None else [a[0] for a in found])


def _first_in_numbers(p: Problem) -> tuple[tuple[np.ndarray, ...], np.ndarray] | None:
    """The sizes by one linearization, and of which trajectories there is no doubt; None for a step that has no small program."""
    from dirax.engines.step_program import step_program  # imported when it is used
    from dirax.program.graph import GraphTooLarge
    from dirax.program.interpreter import UnsupportedPrimitive

    batch = p.batch or 1
    t, state = np.full(batch, _start(p)), np.asarray(p.state, float).reshape(batch, -1)
    found, sure = [], np.ones(batch, bool)
    try:
        program = step_program(p.equation, p.params, p.batch_params)
        if not program.sizes_are_written:
            return None
        leaves = program.parameters.flatten(p.params, p.batch if p.batch_params else None)
        leaves = np.broadcast_to(leaves, (batch, program.parameters.size))
        for stage, ((_, fraction), guess) in enumerate(zip(program.stages, p.guess, strict=True)):
            u = np.asarray(guess, float).reshape(batch, -1)
            if not u.shape[1]:
                found.append(np.ones((batch, 0)))
                continue
            values = first_sizes(program, stage, u, state, t, np.full(batch, fraction * p.h), leaves)
            found.append(power_of_two(values[:, :-1]))
            sure &= values[:, -1] > 0.0
    except (UnsupportedPrimitive, GraphTooLarge):
        return None
    return tuple(a if p.batch is not None else a[0] for a in found), sure


def _first_of_each(stages: tuple) -> list[int]:
    """The number of the first stage with each of the equations."""
    return [i for i, (stage, _) in enumerate(stages) if all(stage is not other for other, _ in stages[:i])]


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
    slopes: Any,
    short: Any,
    near: Any,
    u: Any,
    rounded: Sequence,
    again: Callable,
    after: Callable,
    h: Any,
    xp: ModuleType,
) -> Any:
    """(…, k) from r (…, k) and its derivatives by (u, h) at the state, and those of a short step there and near its end,
    (…, k, k + 1); `rounded` are the sizes of the terms (…, k) at either place, and `again` those with unknowns of given sizes;
    `after` is the state after the step with given unknowns."""
    if not u.shape[-1]:
        return xp.ones(u.shape)
    k, applied = u.shape[-1], lambda matrix, vector: (matrix @ vector[..., None])[..., 0]
    finite = lambda sizes: xp.where(xp.isfinite(sizes), sizes, 0.0)
    with np.errstate(all="ignore"):
        both = slopes, near
        inverse, *others = balanced_inverse(xp.stack([d[..., :k] for d in (slopes, short, near)]), xp)
        solution = xp.abs(u - finite(applied(inverse, residual)))
        largest = xp.maximum(xp.abs(u), solution)
        inverses = [xp.abs(other) for other in others]

        def of_terms(rounded):
            terms = [of + applied(xp.abs(d[..., :k]), largest) for of, d in zip(rounded, both, strict=True)]
            sizes = [TYPICAL * finite(applied(other, of)) for other, of in zip(inverses, terms, strict=True)]
            return terms, xp.maximum(*sizes)

        terms, sizes = of_terms(rounded)
        blurred = EPSILON * finite(applied(xp.abs(inverse), terms[0]))
        moved = finite(applied(xp.abs(inverse), xp.abs(h * slopes[..., -1])))
        reached = solution + xp.sqrt(moved * blurred / EPSILON)
        known = blurred <= 4.0 * STALLED * reached
        coupling = (finite(i @ xp.abs(d[..., :k])) for i, d in zip((xp.abs(inverse), inverses[1]), both, strict=True))
        coupled = xp.maximum(*coupling) * blurred[..., None, :] > COUPLED * blurred[..., None]
        coupled = coupled & xp.swapaxes(coupled, -1, -2)
        hidden = ~known & (solution > ROUNDINGS * blurred) & ~xp.any(coupled & known[..., None, :], axis=-1)
        end, moved_end = xp.abs(after(u)), xp.abs(after(u + xp.where(hidden, blurred, 0.0)) - after(u))
        lost = (moved_end > 4.0 * STALLED * end) & (end > ROUNDINGS * moved_end)
        too_short = xp.any(hidden, axis=-1, keepdims=True) & xp.any(lost, axis=-1, keepdims=True)
        unknowns = xp.maximum(xp.where(too_short, reached, sizes), xp.abs(u))
        rounded = again(unknowns)
        more, matters = of_terms(rounded)[1], _matters(slopes[..., :k], rounded[0], xp)
        more = xp.where((more < ZERO) & (matters < xp.inf), TYPICAL * matters, more)
        return power_of_two(xp.where(unknowns < NOTHING * more, more, unknowns), xp)


def _matters(slopes: Any, terms: Any, xp: ModuleType) -> Any:
    """The least size (…, k) at which an unknown matters in an equation that has terms (…, k) and it among them; ∞ in none."""
    there = (slopes != 0.0) & (terms[..., None] > 0.0)
    sizes = xp.where(there, terms[..., None] / xp.abs(xp.where(there, slopes, 1.0)), xp.inf)
    return xp.min(xp.where(sizes > ZERO, sizes, xp.inf), axis=-2)


def _arguments(p: Problem, t: Any) -> tuple:
    axes = None if p.batch is None else (0, 0, 0 if p.batch_params else None, 0 if np.ndim(t) else None)
    t, h = jnp.asarray(t, float), jnp.asarray(p.h, float)
    return p.equation, jnp.asarray(p.state), tuple(map(jnp.asarray, p.guess)), jax.tree.map(jnp.asarray, p.params), t, h, axes


def sizes_at(equation: Any, state: Any, guess: tuple, params: Any, t: Any, h: Any, axes: tuple | None = None) -> tuple:
    """The sizes of each stage of a step from a state, over a batch with the `axes` of (state, guess, params, t), by
    JAX."""

    def one(state, guess, params, t):
        def linear(i, u, x, part):
            stage, fraction = equation.stages[i]
            residual = lambda u, h: stage.residual(u, x, t, h, params)
            by_u, by_h = jax.jacfwd(residual, argnums=(0, 1))(u, part * fraction * h)
            return residual(u, part * fraction * h), jnp.concatenate([by_u, by_h[:, None]], axis=1)

        def terms(i, u, x, sizes):
            stage, fraction = equation.stages[i]
            numbers = u, x, t, fraction * h
            errors = sizes, *map(jnp.abs, numbers[1:])
            return rounding(lambda u, x, t, h: stage.residual(u, x, t, h, params), *numbers, errors=errors)

        end, found = state, []
        for i in _first_of_each(equation.stages):
            stage, fraction = equation.stages[i]
            u = _updated(*linear(i, guess[i], end, SHORT), guess[i], jnp)
            end = stage.advance(u, end, t, SHORT * fraction * h, params)
        end = end * _nearby(len(state))
        for i, u in enumerate(guess):
            short, near = linear(i, u, state, SHORT)[1], linear(i, u, end, SHORT)[1]
            again = lambda sizes, i=i, u=u: [terms(i, u, x, sizes) for x in (state, end)]
            part, stage = equation.stages[i][1] * h, equation.stages[i][0]
            after = lambda u, stage=stage, part=part: stage.advance(u, state, t, part, params)
            found.append(_sizes(*linear(i, u, state, 1.0), short, near, u, again(jnp.abs(u)), again, after, part, jnp))
        return tuple(found)

    given = jnp.asarray(state, float), tuple(jnp.asarray(u, float) for u in guess), params, t
    return one(*given) if axes is None else jax.vmap(one, in_axes=axes)(*given)


def sizes_near(equation: Any, state: Any, guess: tuple, t: Any, h: Any, params: Any) -> tuple:
    """Sizes of the unknowns of each stage of a single step, from its derivatives alone."""

    def one(stage, u, h):
        if not stage.unknowns:
            return jnp.ones(0)
        by_u, by_state = jax.jacfwd(lambda u, x: stage.residual(u, x, t, h, params), argnums=(0, 1))(u, state)
        terms = jnp.abs(by_u) @ jnp.abs(u) + jnp.abs(by_state) @ jnp.abs(state)
        size = jnp.abs(solve(by_u, jnp.eye(len(u)))) @ terms
        return jnp.where(jnp.isfinite(size) & (size > TINY), size, TINY)

    found = (one(stage, u, fraction * h) for (stage, fraction), u in zip(equation.stages, guess, strict=True))
    return jax.lax.stop_gradient(tuple(found))


_compiled = compiled(sizes_at)
