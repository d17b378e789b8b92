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

All this is for data that are special, and takes milliseconds (`close_sizes.py`). `first_sizes.py` has the sizes from one
linearization alone, and says where they leave no doubt: they are those of most runs, and a kernel of the native engine finds
them itself in no time. Those of very many unknowns are found by `sizes_of_many.py`.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.engines.close_sizes import MOST, Entries, close_sizes, sizes_at
from dirax.engines.contract import Problem
from dirax.engines.first_sizes import FAR, first_sizes
from dirax.engines.policy import LARGEST_NATIVE, LARGEST_SCALARS
from dirax.engines.step_program import step_program
from dirax.engines.steps_in_numbers import StepsInNumbers
from dirax.numerics.equilibration import power_of_two
from dirax.numerics.tolerances import EPSILON, TINY
from dirax.program.compiled import compiled
from dirax.program.graph import GraphTooLarge
from dirax.program.interpreter import UnsupportedPrimitive
from dirax.program.linear_solves import solve
from dirax.program.on_host import called_on_host

Sizes = tuple[Any, ...]
"""Of the unknowns of each stage, (k,) or (B, k)."""


def sizes_of(problem: Problem) -> Sizes:
    """The sizes of the unknowns of each stage, (k,) or (B, k), of a problem in numbers."""
    if _is_large(problem):
        return _of_many(problem)
    return _in_numbers(problem, _start(problem), _looked_at)


def sizes_of_traced(problem: Problem) -> Sizes:
    """The same of a problem that JAX traces, without derivatives: in numbers when it runs, where the step has a scalar program,
    since XLA takes seconds to compile them."""
    if _is_large(problem):
        return _of_many(problem, traced=True)
    found = _on_host(problem)
    if found is None:
        equation, state, guess, params, t, h, axes = _arguments(problem, _start(problem))
        one = functools.partial(sizes_at, equation, axes=axes)  # which may close over what is traced
        found = jax.jit(one)(state, guess, params, t, h)
    return jax.lax.stop_gradient(found)


def _of_many(problem: Problem, traced: bool = False) -> Sizes:
    from dirax.engines.sizes_of_many import sizes_of_many  # imported when it is used

    return sizes_of_many(problem, traced)


def grown(problem: Problem, lanes: np.ndarray, completed: np.ndarray, state: np.ndarray, guess: tuple, sizes: Sizes) -> tuple:
    """The sizes of trajectories at which Newton's method stopped too early or not at all, and which of them grew: the largest of
    those where they began and of those where they stand, after `completed` steps at `state` (lanes, s) with the unknowns `guess`.

    Data may be so special where a run begins that an unknown has no size there. Sizes are those at the solution of the next step:
    at a guess that is far from it they may be anything, and what is far from solved would count as roundoff. Everything has an
    axis of the `lanes`.

    A solution of which roundoff leaves no digit, as where a root inside of the step goes to infinity, is none: with its sizes
    everything would count as roundoff."""
    guess, good = _next_step(problem, lanes, completed, state, guess)
    if not np.any(good):
        return sizes, good
    found = sizes_there(problem, lanes, completed, state, guess)
    good &= _is_known(guess, found)
    more = np.any([np.any(new > old, axis=1) for new, old in zip(found, sizes, strict=True)], axis=0)
    return tuple(np.maximum(new, old) for new, old in zip(found, sizes, strict=True)), more & good


def _is_known(unknowns: tuple, sizes: Sizes) -> np.ndarray:
    """Where some unknown is larger than its roundoff, or all are zero."""
    larger = [np.any(np.abs(u) > EPSILON * a, axis=1) for u, a in zip(unknowns, sizes, strict=True)]
    zero = [np.all(np.asarray(u) == 0.0, axis=1) for u in unknowns]
    return np.any(larger, axis=0) | np.all(zero, axis=0)


def _next_step(p: Problem, lanes: np.ndarray, completed: np.ndarray, state: np.ndarray, guess: tuple) -> tuple[tuple, Any]:
    """The unknowns of each stage in the step that leaves `state`, and where it has a solution; of steps that cannot be taken in
    numbers the guess."""
    steps = StepsInNumbers.found(p.equation, p.params, p.batch_params) if not _is_large(p) else None
    if steps is None:
        return guess, np.ones(len(lanes), bool)
    params = steps.parameters(p.params, p.batch if p.batch_params else None, lanes)
    unknowns, _, good = steps.solved(state, guess, p.t0 + (p.first_step + completed) * p.h, p.h, params)
    return tuple(unknowns), good


def sizes_there(problem: Problem, lanes: np.ndarray, completed: np.ndarray, state: np.ndarray, guess: tuple) -> Sizes:
    """The sizes of some trajectories where they stand, looked at closely; arguments as above."""
    p = problem
    if _is_large(p):
        return tuple(np.ones((len(lanes), np.shape(u)[-1])) for u in guess)
    moved = lambda a: np.asarray(a)[lanes] if p.batch is not None else np.asarray(a)[None][lanes]
    params = jax.tree.map(moved, p.params) if p.batch_params else p.params
    here = dataclasses.replace(p, state=state, guess=guess, params=params, batch=len(lanes))
    return _in_numbers(here, p.t0 + (p.first_step + completed) * p.h, _closely)


def _is_large(p: Problem) -> bool:
    """Whether sizes would take long in numbers: there are very many unknowns, or many and no scalar program."""
    if not LARGEST_NATIVE < p.size <= LARGEST_SCALARS:
        return p.size > LARGEST_SCALARS
    try:
        step_program(p.equation, p.params, p.batch_params)
    except UnsupportedPrimitive:
        return True
    return False


def _start(p: Problem) -> Any:
    """The time at which the first step begins."""
    return p.t0 + p.first_step * p.h


def _in_numbers(p: Problem, t: Any, find: Callable[[Entries], list[np.ndarray]]) -> Sizes:
    """Those that `find` finds at the time t, () or (B,), by the scalar program of the step; by JAX where it has none."""
    try:
        found = find(_entries(p, t, np))
    except (UnsupportedPrimitive, GraphTooLarge):
        return tuple(map(np.asarray, _compiled(*_arguments(p, t))))
    return tuple(found if p.batch is not None else [a[0] for a in found])


def _entries(p: Problem, t: Any, xp: Any) -> Entries:
    """Raises `UnsupportedPrimitive`."""
    program, batch = step_program(p.equation, p.params, p.batch_params), p.batch or 1
    rows, each = lambda a: xp.asarray(a, float).reshape(batch, -1), lambda a: xp.broadcast_to(xp.asarray(a, float), (batch,))
    leaves = program.parameters.flatten(p.params, p.batch if p.batch_params else None, xp)
    leaves = xp.broadcast_to(leaves, (batch, program.parameters.size))
    return Entries(program, p.equation.stages, rows(p.state), [rows(u) for u in p.guess], each(t), each(p.h), leaves)


def _looked_at(at: Entries) -> list[np.ndarray]:
    """By one linearization where that leaves no doubt, else closely. Raises `GraphTooLarge`."""
    if not at.program.sizes_are_written:
        return _closely(at)
    found, sure = [], np.ones(len(at.state), bool)
    for stage, ((_, fraction), u) in enumerate(zip(at.stages, at.guesses, strict=True)):
        if u.shape[1]:
            sizes, known = first_sizes(at.program, stage, u, at.state, at.t, fraction * at.h, at.leaves)
            found.append(power_of_two(sizes))
            sure &= known
        else:
            found.append(np.ones(u.shape))
    if np.all(sure):
        return found
    return [np.where(sure[:, None], a, b) for a, b in zip(found, _closely(at), strict=True)]


def _closely(at: Entries) -> list[np.ndarray]:
    """The sizes looked at closely, and where they are far above the unknowns, no larger than the solution of the step allows in
    any of its parts by the same equations, or where none is found the guess, which may be far from one; or, where the step is too
    large to be solved in numbers, what is not zero of it. Raises `GraphTooLarge` where the sizes themselves are too large."""
    found = close_sizes(at)
    far = [np.any(a > FAR * np.abs(u), axis=1) for a, u in zip(found, at.guesses, strict=True)]
    if not np.any(far):
        return found
    try:
        here = at.state, at.guesses, at.t, at.h, at.leaves
        _, sizes, good = StepsInNumbers.of_program(at.program).solved(*here, follow=True, sizes=found)
        of_equations = lambda stage: np.max([a for (s, _), a in zip(at.stages, sizes, strict=True) if s is stage], axis=0)
        solutions = [MOST * of_equations(stage) for stage, _ in at.stages]
        most = [np.where(good[:, None], a, FAR * np.abs(u)) for a, u in zip(solutions, at.guesses, strict=True)]
        bounded = ~good[:, None]
    except GraphTooLarge:
        most, bounded = [FAR * np.abs(u) for u in at.guesses], np.zeros((len(at.state), 1), bool)
    return [np.where(bounded | (b > 0.0), np.minimum(a, power_of_two(b)), a) for a, b in zip(found, most, strict=True)]


def _on_host(p: Problem) -> Sizes | None:
    """By a call of the host from where XLA runs; None where the step has no scalar program, or a device of its own."""
    if jax.default_backend() != "cpu":
        return None
    try:
        at = _entries(p, _start(p), jnp)
        once = lambda a: np.ones((1, *a.shape[1:]))
        _looked_at(
            dataclasses.replace(
                at,
                state=once(at.state),
                guesses=[once(u) for u in at.guesses],
                t=np.ones(1),
                h=np.ones(1),
                leaves=once(at.leaves),
            )
        )
    except (UnsupportedPrimitive, GraphTooLarge):
        return None

    def find(state: np.ndarray, t: np.ndarray, h: np.ndarray, leaves: np.ndarray, *guesses: np.ndarray) -> list[np.ndarray]:
        return _looked_at(dataclasses.replace(at, state=state, guesses=guesses, t=t[:, 0], h=h[:, 0], leaves=leaves))

    widths = [u.shape[1] for u in at.guesses]
    found = called_on_host(find, widths, at.state, at.t[:, None], at.h[:, None], at.leaves, *at.guesses)
    return tuple(found) if p.batch is not None else tuple(a[0] for a in found)


def _arguments(p: Problem, t: Any) -> tuple:
    axes = None if p.batch is None else (0, 0, 0 if p.batch_params else None, 0 if np.ndim(t) else None)
    t, h = jnp.asarray(t, float), jnp.asarray(p.h, float)
    return p.equation, jnp.asarray(p.state), tuple(map(jnp.asarray, p.guess)), jax.tree.map(jnp.asarray, p.params), t, h, axes


def sizes_near(equation: Any, state: Any, guess: tuple, t: Any, h: Any, params: Any) -> tuple:
    """Sizes of the unknowns of each stage of a single step, from its derivatives alone."""

    def one(stage, u, h):
        if not stage.unknowns:
            return jnp.ones(0)
        residual = lambda u, x: stage.residual(u, x, t, h, params)
        by_u, by_state = jax.jacfwd(residual, argnums=(0, 1))(u, state)
        inverse = solve(by_u, jnp.eye(len(u)))
        solution = u - inverse @ residual(u, state)  # at rest it alone has a size
        terms = jnp.abs(by_u) @ jnp.maximum(jnp.abs(u), jnp.abs(solution)) + jnp.abs(by_state) @ jnp.abs(state)
        size = jnp.abs(inverse) @ terms
        return jnp.where(jnp.isfinite(size) & (size > TINY), size, TINY)

    found = (one(stage, u, fraction * h) for (stage, fraction), u in zip(equation.stages, guess, strict=True))
    return jax.lax.stop_gradient(tuple(found))


_compiled = compiled(sizes_at, seldom=True)
