"""How large the unknowns of a step of very many are: by how much roundings, at random, change them.

The data u, state and h, each number changed by about a last place at random, change the residual by what its terms round by and
by what it makes of the change, and the root by r_u⁻¹ times that: in units of ε, and as a root mean square, this is what
`sizes.py` bounds by |r_u⁻¹| E. It takes an update of Newton's method for each sample, at the state and near the end of a short
step, where numbers are less special. Among unknowns of one part of the layout, which have one unit, none is less than LEAST of
the largest: where all is zero as yet, as ahead of a wave, nothing else says how large it will be.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dirax.engines.contract import Problem
from dirax.engines.linear_solver import AbstractLinearSolver
from dirax.engines.sparse.plan import quicker_plan
from dirax.engines.sparse.solver import SparseSolver
from dirax.engines.xla.dense import Dense
from dirax.numerics.equilibration import power_of_two
from dirax.numerics.tolerances import EPSILON
from dirax.program.compiled import compiled
from dirax.schemes.layout import Layout

SAMPLES = 4
"""Roundings at random at each of two states: a root mean square within a factor of two or so."""

LARGEST = 4.0
"""The largest of very many roundings in their root mean squares."""

SHORT, NEAR = 0.25, 1.0 / 16.0
"""The part of a step after which data are looked at again, and how much they are changed there, as in `sizes.py`."""

LEAST = 2.0**-12
"""Of the largest unknown of a part: what is less has roundoff of its neighbours, which then is below `stopping.STALLED`."""

LARGEST_DENSE = 2**24
"""Entries up to which a dense Jacobian is formed to find sizes."""


def sizes_of_many(p: Problem, traced: bool = False) -> tuple[Any, ...]:
    """The sizes of the unknowns of each stage, (k,) or (B, k); 1 where the Jacobian is neither sparse nor small enough. `traced`:
    of a problem that JAX traces, whose equation may close over what is traced."""
    plan = None if jax.default_backend() != "cpu" else quicker_plan(p.equation, p.params, p.batch_params)
    equation, solvers = p.equation, (None,) * len(p.equation.stages)
    if isinstance(plan, tuple):
        equation, solvers = plan.equation, plan.solvers
    elif max(stage.unknowns for stage, _ in p.equation.stages) ** 2 > LARGEST_DENSE:
        return tuple(jnp.ones(np.shape(guess)) for guess in p.guess)
    t, axes = p.t0 + p.first_step * p.h, None if p.batch is None else (0, 0, 0 if p.batch_params else None)
    if not traced and axes is None and all(solver is not None and solver.by_loops for solver in solvers):
        return _sizes(equation, solvers, np.asarray(p.state), tuple(map(np.asarray, p.guess)), p.params, t, p.h, None, np)
    numbers = (jnp.asarray(a, float) for a in (t, p.h))
    given = jnp.asarray(p.state), tuple(map(jnp.asarray, p.guess)), jax.tree.map(jnp.asarray, p.params), *numbers
    given = jax.lax.stop_gradient(given)
    if traced:
        return jax.jit(functools.partial(_sizes, equation, solvers, axes=axes))(*given)
    return tuple(map(np.asarray, _compiled(equation, solvers, *given, axes)))


def _sizes(
    equation: Any, solvers: tuple, state: Any, guess: tuple, params: Any, t: Any, h: Any, axes: tuple | None, xp: Any = jnp
) -> tuple:
    """By JAX; or by NumPy, without anything to compile, where loops evaluate the stages."""

    def one(state, guess, params):
        found: dict[int, Any] = {}
        for (stage, fraction), u, solver in zip(equation.stages, guess, solvers, strict=True):
            if id(stage) not in found:
                found[id(stage)] = _of_stage(stage, solver, u, state, t, fraction * h, params, xp)
        return tuple(found[id(stage)] for stage, _ in equation.stages)

    return one(state, guess, params) if axes is None else jax.vmap(one, axes)(state, guess, params)


class _Look(NamedTuple):
    """One evaluation: where its data are from, whether they are blurred, whether its root is that of the short step; the part of
    a step."""

    at_end: np.ndarray
    from_solution: np.ndarray
    blurred: np.ndarray
    ends: np.ndarray
    part: np.ndarray


def _looks() -> _Look:
    """First a short step to the end; then at either place the solution from the guess, that from there, and those of blurred
    data."""
    no, yes = False, True
    place = lambda at_end: [(at_end, no, no, no, 1.0), (at_end, yes, no, no, 1.0), *[(at_end, yes, yes, no, 1.0)] * SAMPLES]
    return _Look(*map(np.array, zip((no, no, no, yes, SHORT), *place(no), *place(yes), strict=True)))


def _of_stage(stage: Any, known: SparseSolver | None, guess: Any, state: Any, t: Any, h: Any, params: Any, xp: Any) -> Any:
    if not stage.unknowns:
        return xp.ones(0)
    solver: AbstractLinearSolver = known or Dense()
    jacobian = known.jacobian_of(stage.residual) if known else jax.jacfwd(stage.residual)
    solve = known.equations.solved if known else lambda matrix, right, _: solver.solve(solver.factorise(matrix), right)
    shaken = 1.0 + NEAR / 2 * _scattered(state.shape, 0, xp)

    def look(carry, given):
        end, solution, base, largest, moved = carry
        look, number = given
        blurred = lambda a: a * (1.0 + xp.where(look.blurred, EPSILON, 0.0) * _scattered(np.shape(a), number, xp))
        data = xp.where(look.from_solution, solution, guess), xp.where(look.at_end, end, state), look.part * h
        u, x, part = map(blurred, data)
        change = solve(jacobian(u, x, t, part, params), xp.asarray(stage.residual(u, x, t, part, params)), xp)
        root = u - xp.where(xp.isfinite(change), change, 0.0)
        size = xp.where(look.at_end, largest, xp.maximum(largest, xp.abs(root)))
        if xp is jnp or look.ends:
            after = shaken * xp.asarray(stage.advance(root, x, t, part, params))
            end = xp.where(look.ends, xp.where(xp.isfinite(after), after, 0.0), end)
        solution = xp.where(look.from_solution, solution, root)
        base = xp.where(look.blurred, base, root)
        return (end, solution, base, size, moved + ((root - base) / EPSILON) ** 2), None  # which is zero for what is not blurred

    looks, begun = _looks(), (state, guess, guess, xp.abs(guess), xp.zeros_like(guess))
    given = looks, np.arange(1, 1 + len(looks.part))
    if xp is np:
        for one in zip(*looks, given[1], strict=True):
            begun, _ = look(begun, (_Look(*one[:-1]), one[-1]))
        *_, largest, moved = begun
    else:  # one loop, so that XLA compiles the functions of the stage once
        (*_, largest, moved), _ = jax.lax.scan(look, begun, jax.tree.map(jnp.asarray, given))
    sizes = xp.maximum(largest, LARGEST * xp.sqrt(moved / SAMPLES))
    return power_of_two(_not_below_others(stage.unknown_layout, sizes, xp), xp)


def _scattered(shape: tuple[int, ...], number: Any, xp: Any) -> Any:
    """Numbers of mean square 1, others for another `number`: XLA takes a second to compile a generator of random ones."""
    place = xp.arange(max(1, *shape) if shape else 1, dtype=float).reshape(shape)
    return np.sqrt(2.0) * xp.sin(1.0 + 2.399963 * (place + 1.0) + 1.618034 * xp.asarray(number, float) * (place + 2.0))


def _not_below_others(layout: Layout, sizes: Any, xp: Any) -> Any:
    """Sizes of at least LEAST of the largest of their part, and 1 where all of a part are zero."""
    parts = (sizes[layout.place(name)] for name in layout)
    floored = (xp.maximum(part, LEAST * xp.max(part, initial=0.0)) for part in parts)
    return xp.concatenate([xp.where(part > 0.0, part, 1.0) for part in floored])


_compiled = compiled(_sizes, seldom=True)
