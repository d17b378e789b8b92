"""The loop over the steps of a run as a function that XLA compiles: a chunk of steps, and the rows saved on the way."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from dirax.engines.contract import OK, Problem
from dirax.engines.xla.lane import Lane, Numerics, packed_row, parts_of_row, take_step, time_of, unpacked_row
from dirax.program.compiled import compiled, known_options
from dirax.program.side_by_side import of_one, side_by_side, waits

CHUNK_BYTES = 2**20
"""Largest buffer of saved rows on the device. Runs of more go through it several times; runs of less pay for all of it."""

CHUNK_ROWS = 4096
UNPACKED_ROWS = 64
"""Rows that are unpacked together."""

QUICK_TO_COMPILE = {"xla_cpu_use_fusion_emitters": False}
"""Halves the time of compilation on a CPU, where the steps were measured to take the same time or less."""

BY_ITSELF = {"xla_cpu_experimental_ynn_fusion_type": ""}
"""Leaves long arrays to the code that XLA compiles: its library of array operations shares them out to threads that wait for one
another, which takes a fifth more of the processor's time."""


class Clock(eqx.Module):
    """The numbers of a chunk of steps, all of them traced, so that one compiled function serves every run of an equation.

    Steps are counted from the run's first state, which is at t0 + first_step·h.
    """

    t0: Any
    h: Any
    first_step: Any
    every: Any  # steps between saved rows
    start: Any  # first step of the chunk
    stop: Any  # one past its last
    closing: Any  # whether it is the step leaving the last row, taken even if every trajectory has ended

    @classmethod
    def of(cls, p: Problem) -> "Clock":
        """That of the whole run as one chunk."""
        return cls(p.t0, p.h, float(p.first_step), p.save_every, 0, p.steps, False)


def make_step(equation, axes, max_iterations: int, differentiable: bool, numerics: Numerics):
    """(lanes, params, sizes, clock) ↦ (lanes after a step, packed rows that they left), over the batch if there is one."""

    def one(lane, params, sizes, clock):
        t = time_of(lane, clock.t0, clock.h, clock.first_step)
        after, unknowns, states = take_step(equation, lane, t, clock.h, params, sizes, max_iterations, differentiable, numerics)
        return after, packed_row(equation, lane, unknowns, states)

    if axes is None:
        return one

    def together(lanes, params, sizes, clock):
        waiting = _waits(equation, of_one(params, axes[1] is not None))
        return side_by_side(one, (*axes, 0, None), waiting)(lanes, params, sizes, clock)

    return together


def _waits(equation, params) -> bool:
    """Whether the residuals of trajectories, with their derivatives, could have the threads of XLA wait for one another."""
    vector, number = (lambda size: jax.ShapeDtypeStruct((size,), jnp.float64)), jax.ShapeDtypeStruct((), jnp.float64)
    given = ((stage, vector(stage.unknowns), vector(stage.state_size)) for stage, _ in equation.stages)
    return any(waits(stage.residual, u, state, number, number, params) for stage, u, state in given)


def unpack_rows(equation, axes, packed, params, clock: Clock) -> dict:
    """The named arrays of packed rows (rows, …)."""
    one = lambda row, params: unpacked_row(equation, row, clock.t0, clock.h, clock.first_step, params)
    waiting = waits(one, of_one(packed, 1 if axes is None else 2), of_one(params, axes is not None and axes[1] is not None))
    lanes = one if axes is None else side_by_side(one, axes, waiting)
    return side_by_side(lanes, (0, None), waiting)(packed, params)


@functools.cache
def compiled_chunk(platform: str, long: bool = False) -> Any:
    """`_chunk` compiled for a platform, with the options that this version of XLA knows; for `long` arrays with more of them."""
    options = {} if platform != "cpu" else QUICK_TO_COMPILE | (BY_ITSELF if long else {})
    known = known_options(options)
    return compiled(_chunk, compiler_options=known) if known else compiled(_chunk)


def _chunk(
    equation, lanes: Lane, params, sizes: tuple, clock: Clock, capacity: int, axes, max_iterations: int, numerics: Numerics
) -> tuple[Lane, dict]:
    """The steps from clock.start to clock.stop: the lanes after them, and the at most `capacity` rows saved on the way."""
    step = jax.jit(make_step(equation, axes, max_iterations, False, numerics), inline=True)  # traced once for both uses
    row = jax.eval_shape(step, lanes, params, sizes, clock)[1]
    first_row = next_row(clock.start, clock.every)

    def going(carry):
        k, lanes, _ = carry
        return (k < clock.stop) & (clock.closing | jnp.any(lanes.status == OK))

    def body(carry):
        k, lanes, rows = carry
        lanes, row = step(lanes, params, sizes, clock)
        # the last slot is for the rows that are not saved
        slot = jnp.where(jax.lax.rem(k, clock.every) == 0, jax.lax.div(k, clock.every) - first_row, capacity)
        return k + 1, lanes, jax.lax.dynamic_update_index_in_dim(rows, row, slot, 0)

    rows = jnp.zeros((capacity + 1, *row.shape))
    _, lanes, rows = jax.lax.while_loop(going, body, (clock.start, lanes, rows))
    return lanes, _unpack_written(equation, axes, rows[:capacity], params, clock, next_row(clock.stop, clock.every) - first_row)


def _unpack_written(equation, axes, packed, params, clock: Clock, count) -> dict:
    """The named arrays of packed rows, of the first `count` of them: unpacking can cost as much as a step."""
    capacity, block = len(packed), min(UNPACKED_ROWS, len(packed))
    unpack = jax.jit(lambda rows: unpack_rows(equation, axes, rows, params, clock), inline=True)
    shapes = jax.eval_shape(unpack, packed[:block])
    empty = jax.tree.map(lambda a: jnp.zeros((capacity, *a.shape[1:]), a.dtype), shapes)

    def body(carry):
        i, out = carry
        first = jnp.minimum(i, capacity - block)
        rows = unpack(jax.lax.dynamic_slice_in_dim(packed, first, block))
        return i + block, jax.tree.map(lambda a, b: jax.lax.dynamic_update_slice_in_dim(a, b, first, 0), out, rows)

    return jax.lax.while_loop(lambda carry: carry[0] < count, body, (jnp.zeros((), int), empty))[1]


def unpacked_rows(problem: Problem, packed) -> dict:
    """The named arrays (B, rows, …) of packed rows (B, rows, …), B = 1 for one trajectory."""
    p = problem
    clock = Clock.of(p)
    rows = packed[0] if p.batch is None else jnp.moveaxis(packed, 1, 0)
    return {name: by_lane(a, p.batch, jnp) for name, a in unpack_rows(p.equation, axes_of(p), rows, p.params, clock).items()}


def next_row(step, every):
    """Number of the first row saved at `step` or later."""
    return -(-step // every)


def by_lane(values, batch: int | None, xp):
    """(B, rows, …) from (rows, B, …) or, without a batch, from (rows, …)."""
    return values[None] if batch is None else xp.moveaxis(values, 0, 1)


def axes_of(p: Problem) -> tuple | None:
    """None for one trajectory; else the axes of lanes and `params` under vmap."""
    return None if p.batch is None else (0, 0 if p.batch_params else None)


def row_capacity(p: Problem) -> int:
    """Rows of a chunk."""
    parts = p.equation.stages[: parts_of_row(p.equation)]
    row_bytes = 8 * (p.batch or 1) * (sum(stage.state_size + stage.unknowns for stage, _ in parts) + 1)
    return max(1, min(CHUNK_ROWS, CHUNK_BYTES // row_bytes))
