"""One step of one trajectory: solve every stage, advance, and judge; what an engine carries from step to step."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dirax.engines.contract import NOT_CONVERGED, NOT_FINITE, OK, Problem
from dirax.engines.linear_solver import AbstractLinearSolver
from dirax.engines.xla.newton import as_function, folded, newton_root
from dirax.schemes.step import composed_row, needs_every_part


class Numerics(NamedTuple):
    """How a step is computed, besides the functions of its equation.

    `linear_solver` solves the equations of Newton's method. Where they are known, each stage has a function of
    (u, state, t, h, params) for what the step adds to the state (NaN: unknown), and for the Jacobian (k, k) of the residual.
    With `sparse` each stage has a solver and a Jacobian of its own that belong together.
    """

    linear_solver: AbstractLinearSolver | None = None
    increments: tuple[Callable, ...] | None = None
    jacobians: tuple[Callable, ...] | None = None
    sparse: tuple[Any, ...] | None = None

    @property
    def seconds(self) -> float | None:
        """How long sparse solvers have run so far, all that go the same ways; None without them."""
        if self.sparse is None:
            return None
        return sum(made.seconds for made in {id(own.equations): own.equations.elimination for own in self.sparse}.values())

    def of_stages(self, equation) -> list[tuple]:
        """(linear solver, increment, Jacobian) of every stage."""
        none = (None,) * len(equation.stages)
        increments = self.increments or none
        if self.sparse is None:
            return [(self.linear_solver, *own) for own in zip(increments, self.jacobians or none, strict=True)]
        jacobians = (own.jacobian_of(stage.residual) for own, (stage, _) in zip(self.sparse, equation.stages, strict=True))
        return list(zip(self.sparse, increments, jacobians, strict=True))


class Lane(eqx.Module):
    """What is carried from step to step of one trajectory, in few arrays, because every array costs XLA kernels and copies.

    `history` holds for each stage the unknowns of the step before and their first and second differences over the steps
    before, (3, k); `counts` (3,) the good steps, the outcome, and Newton's updates. `max_residual` is the largest entry of
    the residual that was left at the unknowns of any good step; `lost` (s,) what rounding took from the state, with
    compensated summation, else (0,).
    """

    state: Any
    history: tuple
    counts: Any
    max_residual: Any
    lost: Any

    @property
    def unknowns(self) -> tuple:
        """Those of the step before, per stage."""
        return tuple(stage[..., 0, :] for stage in self.history)

    @property
    def completed(self):
        """Number of good steps."""
        return self.counts[..., 0]

    @property
    def status(self):
        """The outcome of the last attempted step."""
        return self.counts[..., 1]

    @property
    def iterations(self):
        """Updates of Newton's method so far."""
        return self.counts[..., 2]


def first_lane(state, guess: tuple, xp=jnp, compensated: bool = False) -> Lane:
    """The lane at the initial state, with one guess per stage; a leading batch axis is kept. `xp`: numpy or jax.numpy."""
    batch = state.shape[:-1]
    history = tuple(xp.stack([u, xp.zeros_like(u), xp.zeros_like(u)], axis=-2) for u in guess)
    lost = xp.zeros((*batch, state.shape[-1] if compensated else 0))
    return Lane(state, history, xp.full((*batch, 3), OK), xp.zeros(batch), lost)


def take_step(
    equation, lane: Lane, t, h, params, sizes, max_iterations: int, differentiable: bool = True, numerics: Numerics | None = None
) -> tuple[Lane, tuple, tuple]:
    """One step of every stage, with unknowns of these `sizes`; the lane after it (unchanged where it had failed or
    the step fails), and of each stage the unknowns and the state that it left.

    With `differentiable` it can be differentiated in reverse mode too, and no derivative passes through a step that failed."""
    numerics = numerics or Numerics()
    known = numerics.of_stages(equation)
    stages, fractions = zip(*equation.stages, strict=True)

    def solved(carry, fraction, before, sizes, stage, known):
        linear_solver, increment, jacobian = known
        residual = jax.jit(stage.residual, inline=True)  # traced once for all the places that it is in
        state, lost, t, status, updates, worst = carry
        left_state = state
        running = status == OK
        args = (state, t, fraction * h, params)
        fixed = passing(args, False) if differentiable else args
        guess, other = (stage.guess(fixed[0], u, *fixed[2:]) for u in (jnp.sum(before, axis=0), before[0]))
        if differentiable:
            guess, other = jax.lax.stop_gradient((guess, other))
        how = max_iterations, sizes, running, jacobian, linear_solver
        u, count, converged = newton_root(residual, guess, fixed, *how, other)
        new, left = stage.advance(u, *fixed), residual(u, *fixed)
        # a sum keeps every nan, where XLA's vectorized maximum loses some; 0·x is nan where x is not finite
        nothing, largest = folded((0.0 * left, jnp.add, 0.0), (jnp.abs(left), jnp.maximum, 0.0))
        finite = jnp.isfinite(jnp.sum(0.0 * new) + nothing)
        outcome = jnp.where(finite, jnp.where(converged, OK, NOT_CONVERGED), NOT_FINITE)
        status = jnp.where(running, outcome, status)
        updates = updates + jnp.where(running, count, 0)
        worst = jnp.where(status == OK, jnp.maximum(worst, largest), worst)
        if differentiable:
            args = passing(args, status == OK)
            u = as_function(residual, u, args, linear_solver, jacobian if numerics.sparse else None, sizes)
            new = stage.advance(u, *args)
        if increment is not None:
            new, left_out = compensated_sum(state, lost, increment(u, *args), new)
            lost = jnp.where(status == OK, left_out, lost)
        state = jnp.where(status == OK, new, state)
        found = _remembered(u, before, lane.completed), u, left_state
        return (state, lost, t + fraction * h, status, updates, worst), found

    carry = (lane.state, lane.lost, jnp.asarray(t, float), lane.status, jnp.zeros_like(lane.iterations), lane.max_residual)
    if len(stages) > 1 and len({(stage.residual, stage.advance, stage.guess) for stage in stages}) == 1:
        one = lambda carry, given: solved(carry, given[0], given[1], given[2], stages[0], known[0])
        given = jnp.array(fractions), jnp.stack(lane.history), None if sizes is None else jnp.stack(sizes)
        carry, (histories, solutions, left) = jax.lax.scan(one, carry, given)
        history, unknowns, states = tuple(histories), tuple(solutions), tuple(left)
    else:
        history, unknowns, states = (), (), ()
        for i, before in enumerate(lane.history):
            own = None if sizes is None else sizes[i]
            carry, (remembered, u, left) = solved(carry, fractions[i], before, own, stages[i], known[i])
            history, unknowns, states = (*history, remembered), (*unknowns, u), (*states, left)
    state, lost, _, status, updates, worst = carry
    good = status == OK
    after = Lane(
        jnp.where(good, state, lane.state),
        tuple(jnp.where(good, new, old) for new, old in zip(history, lane.history, strict=True)),
        jnp.stack([lane.completed + good.astype(int), status, lane.iterations + updates]),
        worst,
        jnp.where(good, lost, lane.lost),
    )
    return after, unknowns, states


def passing(numbers: Any, pass_on: Any) -> Any:
    """The same numbers, through which derivatives, NaNs among them, go on where `pass_on` is true and not otherwise."""
    stop = jax.lax.stop_gradient
    one = lambda x: stop(x) if pass_on is False else jnp.where(pass_on, x, stop(x))
    return jax.tree.map(lambda x: one(x) if eqx.is_inexact_array(x) else x, numbers)


def compensated_sum(state, lost, increment, new):
    """state + increment and what rounding takes from it: what was taken before is given back to the increment (Kahan).
    Where the increment is not known, the new state as it is."""
    small = increment + lost
    total = state + small
    back = total - state
    error = (state - (total - back)) + (small - back)
    known = jnp.isfinite(increment)
    return jnp.where(known, total, new), jnp.where(known, error, 0.0)


def _remembered(u, before, completed):
    """The unknowns with their differences, which are zero until there are enough steps: the first guess is none of them."""
    slope = jnp.where(completed >= 1, u - before[0], 0.0)
    bend = jnp.where(completed >= 2, slope - before[1], 0.0)
    return jnp.stack([u, slope, bend])


def time_of(lane: Lane, t0, h, first_step):
    """The time that the lane is at."""
    return t0 + (first_step + lane.completed.astype(jnp.float64)) * h


def packed_row(equation, lane: Lane, unknowns, states) -> Any:
    """All that the row at `lane` depends on as one array, `unknowns` and `states` being those of the step leaving it: the state
    and the unknowns of every part of it that a row takes, and the number of steps before."""
    parts = []
    for i in range(parts_of_row(equation)):
        finite = jnp.where(jnp.isfinite(unknowns[i]), unknowns[i], lane.unknowns[i])
        parts += [states[i] if i else lane.state, finite]
    return jnp.concatenate([*parts, lane.counts[:1].astype(lane.state.dtype)])


def parts_of_row(equation) -> int:
    """How many parts of a step its row takes, from the first on: one, or all."""
    return len(equation.stages) if needs_every_part(equation) else 1


def nodes_need_step(p: Problem, state: np.ndarray, params: Any) -> bool:
    """Whether the fields of nodes are made of the step that leaves them, at a state of one trajectory: then they are not finite
    where its unknowns are not."""
    sizes = [(stage.state_size, stage.unknowns) for stage, _ in p.equation.stages[: parts_of_row(p.equation)]]
    packed = np.full(sum(map(sum, sizes)) + 1, np.nan)
    packed[: len(state)], packed[-1] = state, p.steps
    row = unpacked_row(p.equation, jnp.asarray(packed), p.t0, p.h, p.first_step, params)
    return not all(np.all(np.isfinite(a)) for name, a in row.items() if p.is_node(name))


def unpacked_row(equation, packed, t0, h, first_step, params) -> dict:
    """The named arrays of the row."""
    t, at, parts = t0 + (first_step + packed[-1]) * h, 0, []
    for stage, fraction in equation.stages[: parts_of_row(equation)]:
        middle, end = at + stage.state_size, at + stage.state_size + stage.unknowns
        parts.append((stage, packed[at:middle], packed[middle:end], t, fraction * h))
        t, at = t + fraction * h, end
    return composed_row(equation, _rows_of_parts(parts, params))


def _rows_of_parts(parts: list[tuple], params) -> list[dict]:
    """The rows of (stage, state, u, t, h), in order; those of equal stages side by side, so that each is written out once."""
    rows: list[Any] = [None] * len(parts)
    for stage in {id(part[0]): part[0] for part in parts}.values():
        own = [i for i, part in enumerate(parts) if part[0] is stage]
        one = lambda state, u, t, h, stage=stage: stage.unpack(state, u, t, h, params)
        if len(own) == 1:
            rows[own[0]] = one(*parts[own[0]][1:])
            continue
        given = (jnp.stack([jnp.asarray(a) for a in each]) for each in zip(*(parts[i][1:] for i in own), strict=True))
        together = jax.vmap(one)(*given)
        for place, i in enumerate(own):
            rows[i] = {name: values[place] for name, values in together.items()}
    return rows
