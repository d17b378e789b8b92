"""The xla engine: jitted steps, driven from the host in chunks, or as one differentiable scan under a JAX transformation."""

import dataclasses
import functools
import time
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dirax.engines.configure import fast_loops_asked_for
from dirax.engines.result import OK, Outcome, Problem, Progress
from dirax.engines.xla.lane import Derived, Lane, first_lane, packed_row, take_step, time_of, unpacked_row

__all__ = ["first_lane", "run", "run_traced", "take_step"]

CHUNK_BYTES = 2**20
"""Largest buffer of saved rows on the device. Runs of more go through it several times; runs of less pay for all of it."""

CHUNK_ROWS = 4096
UNPACKED_ROWS = 64
"""Rows that are unpacked together."""

FIRST_CHUNK = 64
"""Steps of the first chunk; those after it are as many as take CHUNK_SECONDS."""

CHUNK_SECONDS = 0.25


LARGEST_SCALAR = 16
"""Unknowns of a stage, or entries of the state, up to which a step may be written in scalars."""

SCALAR_BATCH = 64
"""Trajectories from which on it is, whatever XLA does with its loops."""

LARGEST_NESTED = 96
"""The same for a step that is nested (`engines/native/program.py`), whatever its batch and device."""

QUICK_TO_COMPILE = {"xla_cpu_use_fusion_emitters": False}
"""Halves the time of compilation on a CPU, where the steps were measured to take the same time or less."""


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


def make_step(equation, axes, max_iterations: int, differentiable: bool, derived: Derived):
    """(lanes, params, clock) ↦ (lanes after a step, packed rows that they left), over the batch if there is one."""

    def one(lane, params, clock):
        t = time_of(lane, clock.t0, clock.h, clock.first_step)
        after, unknowns = take_step(equation, lane, t, clock.h, params, max_iterations, differentiable, derived)
        return after, packed_row(lane, unknowns)

    return one if axes is None else jax.vmap(one, in_axes=(*axes, None))


def unpack_rows(equation, axes, packed, params, clock: Clock) -> dict:
    """The named arrays of packed rows (rows, …)."""
    one = lambda row, params: unpacked_row(equation, row, clock.t0, clock.h, clock.first_step, params)
    lanes = one if axes is None else jax.vmap(one, in_axes=axes)
    return jax.vmap(lanes, in_axes=(0, None))(packed, params)


@functools.cache
def _compiled(platform: str) -> Any:
    """`_chunk` compiled for a platform, with the options that this version of XLA knows."""
    if platform != "cpu":
        return eqx.filter_jit(_chunk)
    try:
        jax.jit(lambda: 0.0, compiler_options=QUICK_TO_COMPILE).lower().compile()
    except jax.errors.JaxRuntimeError:
        return eqx.filter_jit(_chunk)
    return eqx.filter_jit(_chunk, compiler_options=QUICK_TO_COMPILE)  # pyright: ignore[reportCallIssue]


def _chunk(
    equation, lanes: Lane, params, clock: Clock, capacity: int, axes, max_iterations: int, derived: Derived
) -> tuple[Lane, dict]:
    """The steps from clock.start to clock.stop: the lanes after them, and the at most `capacity` rows saved on the way."""
    step = make_step(equation, axes, max_iterations, False, derived)
    row = jax.eval_shape(step, lanes, params, clock)[1]
    first_row = _next_row(clock.start, clock.every)

    def going(carry):
        k, lanes, _ = carry
        return (k < clock.stop) & (clock.closing | jnp.any(lanes.status == OK))

    def body(carry):
        k, lanes, rows = carry
        lanes, row = step(lanes, params, clock)
        # the last slot is for the rows that are not saved
        slot = jnp.where(jax.lax.rem(k, clock.every) == 0, jax.lax.div(k, clock.every) - first_row, capacity)
        return k + 1, lanes, jax.lax.dynamic_update_index_in_dim(rows, row, slot, 0)

    rows = jnp.zeros((capacity + 1, *row.shape))
    _, lanes, rows = jax.lax.while_loop(going, body, (clock.start, lanes, rows))
    return lanes, _unpack_written(equation, axes, rows[:capacity], params, clock, _next_row(clock.stop, clock.every) - first_row)


def _unpack_written(equation, axes, packed, params, clock: Clock, count) -> dict:
    """The named arrays of packed rows, of the first `count` of them: unpacking can cost as much as a step."""
    capacity, block = len(packed), min(UNPACKED_ROWS, len(packed))
    unpack = lambda rows: unpack_rows(equation, axes, rows, params, clock)
    shapes = jax.eval_shape(unpack, packed[:block])
    empty = jax.tree.map(lambda a: jnp.zeros((capacity, *a.shape[1:]), a.dtype), shapes)

    def body(carry):
        i, out = carry
        first = jnp.minimum(i, capacity - block)
        rows = unpack(jax.lax.dynamic_slice_in_dim(packed, first, block))
        return i + block, jax.tree.map(lambda a, b: jax.lax.dynamic_update_slice_in_dim(a, b, first, 0), out, rows)

    return jax.lax.while_loop(lambda carry: carry[0] < count, body, (jnp.zeros((), int), empty))[1]


def run(problem: Problem, progress: Progress | None = None) -> Outcome:
    """Run `problem`, saving into host arrays; Ctrl-C and failing steps keep what was computed."""
    started = time.perf_counter()
    p, derived, notes = _derived(problem)
    chunk = _compiled(jax.default_backend())
    axes, capacity, params = _axes(p), _capacity(p), jax.device_put(p.params)
    lanes = first_lane(np.asarray(p.state), tuple(map(np.asarray, p.guess)), np, derived.increments is not None)

    def call(lanes, start, stop, closing=False):
        t0, h, first_step = map(np.float64, (p.t0, p.h, p.first_step))
        every, start, stop = map(np.int64, (p.save_every, start, stop))
        clock = Clock(t0, h, first_step, every, start, stop, np.bool_(closing))
        after, rows = chunk(p.equation, lanes, params, clock, capacity, axes, p.max_iterations, derived)
        return after, {name: _by_lane(np.asarray(values), p.batch, np) for name, values in rows.items()}

    _, empty = call(lanes, 0, 0)  # compile
    compile_seconds, started = time.perf_counter() - started, time.perf_counter()

    fields = _host_arrays(p, empty)
    done, count, interrupted = 0, FIRST_CHUNK, False
    try:
        while done < p.steps and not np.all(np.asarray(lanes.counts)[..., 1] != OK):
            first = _next_row(done, p.save_every)
            stop = min(done + count, (first + capacity) * p.save_every, p.steps)
            tick = time.perf_counter()
            after, rows = call(lanes, done, stop)
            last = _next_row(stop, p.save_every)
            for name, values in rows.items():
                fields[name][:, first:last] = values[:, : last - first]
            rate = (stop - done) / max(time.perf_counter() - tick, 1e-9)
            lanes, done = after, stop
            count = max(1, int(rate * CHUNK_SECONDS))
            if progress:
                progress(done, p.steps)
    except KeyboardInterrupt:
        interrupted = True
    _, rows = call(lanes, 0, 1, closing=True)
    closing = {name: values[:, 0] for name, values in rows.items()}  # at each trajectory's last good step
    for name, value in closing.items():
        if done == p.steps and _is_node(p, name):
            fields[name][:, -1] = value
    lanes = jax.tree.map(lambda a: np.asarray(a) if p.batch is not None else np.asarray(a)[None], lanes)
    return Outcome(
        fields=fields,
        closing=closing,
        completed=lanes.completed,
        status=lanes.status,
        iterations=lanes.iterations,
        max_residual=lanes.max_residual,
        last_state=lanes.state,
        last_unknowns=lanes.unknowns[0],
        interrupted=interrupted,
        compile_seconds=compile_seconds,
        run_seconds=time.perf_counter() - started,
        notes=notes,
    )


def _derived(p: Problem) -> tuple[Problem, Derived, dict[str, Any]]:
    """The run with its equations written in scalars where that was measured to pay, what the scalar graph derives from them,
    and what `stats` say about what it cannot."""
    from dirax.engines import in_jax  # the scalar graph is imported when it is used

    key, notes, jacobians, increments = (p.equation, p.params, p.batch_params), {}, None, None
    if p.compensated:
        found = in_jax.increments_of(*key)
        increments, notes = (None, {"not_compensated": found}) if isinstance(found, str) else (found, {})
    if _small(p) or (p.size <= LARGEST_NESTED and in_jax.nested(*key)):
        equation, jacobians = in_jax.in_scalars(*key)
        p = dataclasses.replace(p, equation=equation)
    return p, Derived(increments, jacobians), notes


def _small(p: Problem) -> bool:
    """Whether the step should be written in scalars: small ones on a CPU, in batches, and in loops that XLA makes one kernel
    (`dirax.engines.configure`)."""
    many = p.batch is not None and p.batch >= SCALAR_BATCH
    return p.size <= LARGEST_SCALAR and (many or fast_loops_asked_for()) and jax.default_backend() == "cpu"


def run_traced(problem: Problem) -> Outcome:
    """The same run as one scan, for `jax.grad`, `jit` and `vmap` around it; in reverse mode segments of about √steps steps
    are computed again instead of being stored."""
    p, derived, notes = _derived(problem)
    axes = _axes(p)
    lanes = first_lane(jnp.asarray(p.state), tuple(map(jnp.asarray, p.guess)), compensated=derived.increments is not None)
    clock = Clock.of(p)
    one = make_step(p.equation, axes, p.max_iterations, True, derived)

    def step(lanes, k):
        """The lanes after step k and the row that they left; a step past the last is undone."""
        after, row = one(lanes, p.params, clock)
        return jax.tree.map(lambda a, b: jnp.where(k < p.steps, a, b), after, lanes), row

    def to_next_row(lanes, start):
        after, row = step(lanes, start)
        if p.save_every == 1:
            return after, row
        later = start + 1 + jnp.arange(p.save_every - 1)
        return jax.lax.scan(lambda lanes, k: (step(lanes, k)[0], None), after, later)[0], row

    @jax.checkpoint
    def segment(lanes, starts):
        return jax.lax.scan(to_next_row, lanes, starts)

    # saving every step, the closing row is that of one more step, undone like the others that fill up the last segment
    count = p.rows if p.save_every == 1 else p.rows - 1
    length = max(1, int(np.sqrt(p.steps)) // p.save_every)
    starts = jnp.arange(-(-count // length) * length).reshape(-1, length) * p.save_every
    lanes, packed = jax.lax.scan(segment, lanes, starts)
    packed = packed.reshape(-1, *packed.shape[2:])[:count]
    if count < p.rows:
        packed = jnp.concatenate([packed, step(lanes, p.steps)[1][None]])
    rows = {name: _by_lane(a, p.batch, jnp) for name, a in unpack_rows(p.equation, axes, packed, p.params, clock).items()}
    lanes = lanes if p.batch is not None else jax.tree.map(lambda a: a[None], lanes)
    return Outcome(
        fields={name: values if _is_node(p, name) else values[:, :-1] for name, values in rows.items()},
        closing={name: values[:, -1] for name, values in rows.items()},
        completed=lanes.completed,
        status=lanes.status,
        iterations=lanes.iterations,
        max_residual=lanes.max_residual,
        last_state=lanes.state,
        last_unknowns=lanes.unknowns[0],
        notes=notes,
    )


def unpacked_rows(problem: Problem, packed) -> dict:
    """The named arrays (B, rows, …) of packed rows (B, rows, …), B = 1 for one trajectory."""
    p = problem
    clock = Clock.of(p)
    rows = packed[0] if p.batch is None else jnp.moveaxis(packed, 1, 0)
    return {name: _by_lane(a, p.batch, jnp) for name, a in unpack_rows(p.equation, _axes(p), rows, p.params, clock).items()}


def _next_row(step, every):
    """Number of the first row saved at `step` or later."""
    return -(-step // every)


def _by_lane(values, batch: int | None, xp):
    """(B, rows, …) from (rows, B, …) or, without a batch, from (rows, …)."""
    return values[None] if batch is None else xp.moveaxis(values, 0, 1)


def _axes(p: Problem) -> tuple | None:
    """None for one trajectory; else the axes of lanes and `params` under vmap."""
    return None if p.batch is None else (0, 0 if p.batch_params else None)


def _capacity(p: Problem) -> int:
    """Rows of a chunk."""
    stage = p.equation.stages[0][0]
    row_bytes = 8 * (p.batch or 1) * (stage.state_size + stage.unknowns + 1)
    return max(1, min(CHUNK_ROWS, CHUNK_BYTES // row_bytes))


def _is_node(p: Problem, name: str) -> bool:
    return p.equation.stages[0][0].fields[name].place == "node"


def _host_arrays(p: Problem, rows: dict) -> dict:
    """Empty arrays for the whole run, given the arrays of a chunk."""
    shapes = {name: (len(values), p.rows - (not _is_node(p, name)), *values.shape[2:]) for name, values in rows.items()}
    return {name: np.full(shape, np.nan) for name, shape in shapes.items()}
