"""The xla engine: jitted steps, driven from the host in chunks, or as one differentiable scan under a JAX transformation."""

import time
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dirax.engines.newton import solve
from dirax.engines.result import NOT_CONVERGED, NOT_FINITE, OK, Outcome, Problem, Progress

CHUNK_BYTES = 32 * 2**20
"""Largest buffer of saved rows on the device; longer runs go through it several times."""

CHUNK_ROWS = 4096
CHUNK_SECONDS = 0.25


class Lane(eqx.Module):
    """What is carried from step to step of one trajectory."""

    state: Any
    unknowns: Any  # per stage, of the step before
    older: Any  # per stage, of the step before that
    completed: Any
    status: Any
    iterations: Any
    max_residual: Any


def first_lane(state, guess) -> Lane:
    """The lane at the initial state, with one guess per stage."""
    zero = jnp.zeros((), jnp.int64)  # a strong type, so that the next chunk has the same signature
    return Lane(state, guess, guess, zero, zero + OK, zero, jnp.zeros(()))


def take_step(equation, lane: Lane, t, h, params, max_iterations: int, active=True) -> tuple[Lane, Any]:
    """One step of every stage; the lane after it (unchanged where it had failed or the step fails) and the unknowns."""
    state, unknowns = lane.state, []
    status, iterations, worst = lane.status, lane.iterations, lane.max_residual
    running = (lane.status == OK) & active
    for (stage, fraction), last, older in zip(equation.stages, lane.unknowns, lane.older, strict=True):
        step = fraction * h
        guess = stage.guess(state, last + (last - older), step, params)
        u, count, residual, converged = solve(
            lambda u, a, stage=stage: stage.residual(u, *a),
            stage.scale,
            guess,
            (state, t, step, params),
            max_iterations,
            running & (status == OK),
        )
        new = stage.advance(u, state, t, step, params)
        finite = jnp.all(jnp.isfinite(new)) & jnp.all(jnp.isfinite(u))
        failure = jnp.where(finite, jnp.where(converged, OK, NOT_CONVERGED), NOT_FINITE)
        status = jnp.where(running & (status == OK), failure, status)
        iterations = iterations + jnp.where(running, count, 0)
        worst = jnp.where(running & (status == OK), jnp.maximum(worst, residual), worst)
        good = running & (status == OK)
        state = jnp.where(good, new, state)
        unknowns.append(u)
        t = t + step
    good = running & (status == OK)
    kept = jnp.where(good, state, lane.state)
    freeze = lambda a, b: jax.tree.map(lambda x, y: jnp.where(good, x, y), a, b)
    after = Lane(
        kept,
        freeze(tuple(unknowns), lane.unknowns),
        freeze(lane.unknowns, lane.older),
        lane.completed + good,
        status,
        iterations,
        worst,
    )
    return after, tuple(unknowns)


def row_of(equation, lane: Lane, unknowns, t, h, params) -> dict:
    """The named arrays of the row that `lane` is at, `unknowns` being those of the step leaving it."""
    stage, fraction = equation.stages[0]
    finite = jax.tree.map(lambda new, old: jnp.where(jnp.isfinite(new), new, old), unknowns[0], lane.unknowns[0])
    return stage.unpack(lane.state, finite, t, fraction * h, params)


def advance_to_next_row(equation, lane: Lane, start, stop, t0, h, params, max_iterations: int) -> tuple[Lane, dict]:
    """Steps `start` to `stop` (numbers counted from t0): the lane after them and the row saved at the first."""
    t = t0 + start * h
    after, unknowns = take_step(equation, lane, t, h, params, max_iterations)
    row = row_of(equation, lane, unknowns, t, h, params)

    def more(k, lane):
        return take_step(equation, lane, t0 + k * h, h, params, max_iterations)[0]

    return jax.lax.fori_loop(start + 1, stop, more, after), row


@eqx.filter_jit
def _chunk(equation, lanes, params, t0, h, first, first_step, steps, every, count, capacity, axes, max_iterations):
    """`count` rows (at most `capacity`, static) from row number `first` on."""

    def one_row(lane, params, start, stop):
        return advance_to_next_row(equation, lane, start, stop, t0, h, params, max_iterations)

    move = one_row if axes is None else jax.vmap(one_row, in_axes=(0, axes, None, None))
    shapes = jax.eval_shape(move, lanes, params, 0, 1)[1]
    buffers = jax.tree.map(lambda s: jnp.zeros((capacity, *s.shape), s.dtype), shapes)

    def body(carry):
        i, lanes, buffers = carry
        start = (first + i) * every
        stop = jnp.minimum(start + every, steps)
        lanes, row = move(lanes, params, first_step + start, first_step + stop)
        buffers = jax.tree.map(lambda b, r: jax.lax.dynamic_update_index_in_dim(b, r, i, 0), buffers, row)
        return i + 1, lanes, buffers

    _, lanes, buffers = jax.lax.while_loop(lambda c: c[0] < count, body, (jnp.int64(0), lanes, buffers))
    return lanes, buffers


@eqx.filter_jit
def _closing_row(equation, lanes, params, t, h, axes, max_iterations):
    """The row at the end: with the unknowns of one more step where the saved fields depend on them."""

    def one(lane, params, t):
        unknowns = lane.unknowns
        if equation.stages[0][0].needs_leaving_step:
            _, unknowns = take_step(equation, lane, t, h, params, max_iterations)
        return row_of(equation, lane, unknowns, t, h, params)

    return (one if axes is None else jax.vmap(one, in_axes=(0, axes, 0)))(lanes, params, t)


def run(problem: Problem, progress: Progress | None = None) -> Outcome:
    """Run `problem`, saving into host arrays; Ctrl-C and failing steps keep what was computed."""
    p, started = problem, time.perf_counter()
    lanes = _start(p)
    batched, axes = p.batch is not None, _axes(p)
    shapes = _closing_shapes(p, lanes, axes)
    row_bytes = sum(8 * int(np.prod(s.shape)) for s in jax.tree.leaves(shapes))
    capacity = max(1, min(CHUNK_ROWS, CHUNK_BYTES // max(row_bytes, 1)))
    h, t0 = jnp.float64(p.h), jnp.float64(p.t0)
    fixed = (p.first_step, p.steps, p.save_every)
    call = lambda lanes, first, count: _chunk(
        p.equation, lanes, p.params, t0, h, *map(jnp.int64, (first, *fixed, count)), capacity, axes, p.max_iterations
    )
    jax.block_until_ready(call(lanes, 0, 0))  # compile (an empty chunk)
    compile_seconds, started = time.perf_counter() - started, time.perf_counter()

    fields = _host_arrays(p, shapes)
    done, count, interrupted = 0, min(64, capacity), False
    total_rows = p.rows - 1
    try:
        while done < total_rows and not _all_failed(lanes):
            count = min(count, total_rows - done)
            tick = time.perf_counter()
            lanes, buffers = call(lanes, done, count)
            for name, buffer in buffers.items():
                rows = np.asarray(buffer[:count])
                target = fields[name]
                target[:, done : done + count] = np.moveaxis(rows, 0, 1) if batched else rows[None]
            done += count
            rate = count / max(time.perf_counter() - tick, 1e-9)
            count = int(min(capacity, max(1, rate * CHUNK_SECONDS)))
            if progress:
                progress(min(done * p.save_every, p.steps), p.steps)
    except KeyboardInterrupt:
        interrupted = True
    ends = t0 + h * (p.first_step + lanes.completed)
    last = _closing_row(p.equation, lanes, p.params, ends, h, axes, p.max_iterations)
    closing = {name: np.asarray(value) if batched else np.asarray(value)[None] for name, value in last.items()}
    for name, value in closing.items():
        if done == total_rows and _field(p, name).place == "node":
            fields[name][:, done] = value
    squeeze = (lambda a: np.asarray(a)) if batched else (lambda a: np.asarray(a)[None])
    return Outcome(
        fields=fields,
        closing=closing,
        completed=squeeze(lanes.completed),
        status=squeeze(lanes.status),
        iterations=squeeze(lanes.iterations),
        max_residual=squeeze(lanes.max_residual),
        last_state=squeeze(lanes.state),
        last_unknowns=squeeze(lanes.unknowns[0]),
        interrupted=interrupted,
        compile_seconds=compile_seconds,
        run_seconds=time.perf_counter() - started,
    )


def run_traced(problem: Problem, checkpoint_rows: int | None = None) -> Outcome:
    """The same run as one scan, for `jax.grad`, `jit` and `vmap` around it; segments of about √rows are recomputed in
    reverse mode instead of being stored."""
    p = problem
    lanes, axes = _start(p), _axes(p)
    rows = p.rows - 1
    segment = checkpoint_rows or max(1, int(np.sqrt(rows)))

    def one_row(lane, params, start, stop):
        t = p.t0 + start * p.h
        after, unknowns = take_step(p.equation, lane, t, p.h, params, p.max_iterations)
        row = row_of(p.equation, lane, unknowns, t, p.h, params)

        def more(lane, k):
            # steps past `stop` are masked, so that the number of iterations is static and reverse mode works
            return take_step(p.equation, lane, p.t0 + k * p.h, p.h, params, p.max_iterations, k < stop)[0], None

        if p.save_every > 1:
            after, _ = jax.lax.scan(more, after, start + 1 + jnp.arange(p.save_every - 1))
        return after, row

    move = one_row if axes is None else jax.vmap(one_row, in_axes=(0, axes, None, None))

    def body(lanes, i):
        start = i * p.save_every
        stop = jnp.minimum(start + p.save_every, p.steps)
        return move(lanes, p.params, p.first_step + start, p.first_step + stop)

    @jax.checkpoint
    def piece(lanes, numbers):
        return jax.lax.scan(body, lanes, numbers)

    whole = rows // segment * segment
    lanes, saved = jax.lax.scan(piece, lanes, jnp.arange(whole).reshape(-1, segment))
    saved = jax.tree.map(lambda a: a.reshape(whole, *a.shape[2:]), saved)
    if whole < rows:
        lanes, rest = piece(lanes, jnp.arange(whole, rows))
        saved = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), saved, rest)
    ends = p.t0 + p.h * (p.first_step + lanes.completed)
    last = _closing_row(p.equation, lanes, p.params, ends, p.h, axes, p.max_iterations)
    fields = {}
    for name, value in saved.items():
        if _field(p, name).place == "node":
            value = jnp.concatenate([value, last[name][None]])
        fields[name] = jnp.moveaxis(value, 0, 1) if p.batch is not None else value[None]
    lift = (lambda a: a) if p.batch is not None else (lambda a: jnp.asarray(a)[None])
    return Outcome(
        fields=fields,
        closing={name: lift(value) for name, value in last.items()},
        completed=lift(lanes.completed),
        status=lift(lanes.status),
        iterations=lift(lanes.iterations),
        max_residual=lift(lanes.max_residual),
        last_state=lift(lanes.state),
        last_unknowns=lift(lanes.unknowns[0]),
    )


def _axes(p: Problem):
    """None for one trajectory; else the axes of `params` under vmap."""
    if p.batch is None:
        return None
    return jax.tree.map(lambda _: 0 if p.batch_params else None, p.params) if p.params is not None else 0


def _start(p: Problem) -> Lane:
    make = first_lane if p.batch is None else jax.vmap(first_lane)
    return make(jnp.asarray(p.state), jax.tree.map(jnp.asarray, tuple(p.guess)))


def _closing_shapes(p: Problem, lanes: Lane, axes):
    one = lambda lane, params: row_of(p.equation, lane, lane.unknowns, 0.0, p.h, params)
    return jax.eval_shape(one if axes is None else jax.vmap(one, in_axes=(0, axes)), lanes, p.params)


def _field(p: Problem, name: str):
    return p.equation.stages[0][0].fields[name]


def _host_arrays(p: Problem, shapes) -> dict:
    arrays = {}
    for name, shape in shapes.items():
        rows = p.rows - (_field(p, name).place == "step")
        inner = shape.shape[1:] if p.batch is not None else shape.shape
        arrays[name] = np.full((p.batch or 1, rows, *inner), np.nan)
    return arrays


def _all_failed(lanes: Lane) -> bool:
    return bool(np.all(np.asarray(lanes.status) != OK))
