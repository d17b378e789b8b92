"""The engine "xla": steps on arrays, on any device, driven from the host in chunks, or one scan under a transformation."""

import dataclasses
import time
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from dirax.engines import policy
from dirax.engines.contract import OK, Outcome, Problem, Progress, finished
from dirax.engines.engine import AbstractEngine
from dirax.engines.linear_solver import AbstractLinearSolver
from dirax.engines.sizes import sizes_of, sizes_of_traced
from dirax.engines.xla.lane import Lane, Numerics, first_lane
from dirax.engines.xla.loop import Clock, axes_of, by_lane, compiled_chunk, make_step, next_row, row_capacity, unpack_rows

FIRST_CHUNK = 64
"""Steps of the first chunk; those after it are as many as take CHUNK_SECONDS."""

CHUNK_SECONDS = 0.25


class Xla(AbstractEngine):
    """Everything that JAX traces, on any device.

    `linear_solver` solves the equations of Newton's method, `Dense()` unless another is given. With `scalars="policy"` steps
    are written as scalar programs where that was measured to pay (`policy.py`); with `"never"` every function of the step is run
    as JAX has it, and no other part of dirax touches it: the oracle. Then sums are not compensated.
    """

    linear_solver: AbstractLinearSolver | None = None
    scalars: Literal["policy", "never"] = "policy"
    name = "xla"

    def __check_init__(self):
        if not isinstance(self.linear_solver, AbstractLinearSolver | None):
            raise TypeError(
                f"linear_solver must be a dx.AbstractLinearSolver, such as one of your own, but "
                f"{self.linear_solver!r:.80} was given."
            )
        if self.scalars not in ("policy", "never"):
            raise ValueError(f"scalars must be 'policy' or 'never', but {self.scalars!r} was given.")

    def supports(self, problem: Problem) -> str | None:
        """Every problem."""
        return None

    def compiles_start(self, traced: bool) -> bool:
        """Where everything is; other starts are found on the host, for XLA would compile longer than they take."""
        return traced or self.scalars == "never"

    def run(self, problem: Problem, progress: Progress | None = None) -> Outcome:
        """Run `problem`, saving into host arrays; Ctrl-C and failing steps keep what was computed."""
        started = time.perf_counter()
        p, numerics, notes = self._planned(problem)
        chunk = compiled_chunk(jax.default_backend(), numerics.sparse is not None)
        axes, capacity, params = axes_of(p), row_capacity(p), jax.device_put(p.params)
        sizes = self._sizes(problem, sizes_of)
        lanes = first_lane(np.asarray(p.state), tuple(map(np.asarray, p.guess)), np, numerics.increments is not None)
        if p.record is not None:
            lanes = jax.tree.unflatten(jax.tree.structure(lanes), p.record)

        def call(lanes, start, stop, closing=False):
            t0, h, first_step = map(np.float64, (p.t0, p.h, p.first_step))
            every, start, stop = map(np.int64, (p.save_every, start, stop))
            clock = Clock(t0, h, first_step, every, start, stop, np.bool_(closing))
            after, rows = chunk(p.equation, lanes, params, sizes, clock, capacity, axes, p.max_iterations, numerics)
            return after, {name: by_lane(np.asarray(values), p.batch, np) for name, values in rows.items()}

        _, empty = call(lanes, 0, 0)  # compile
        compile_seconds, started, solved = time.perf_counter() - started, time.perf_counter(), numerics.seconds

        fields = _host_arrays(p, empty)
        done, count, interrupted = p.after, FIRST_CHUNK, False
        try:
            while done < p.steps and not np.all(np.asarray(lanes.counts)[..., 1] != OK):
                first = next_row(done, p.save_every)
                stop = min(done + count, (first + capacity) * p.save_every, p.steps)
                tick = time.perf_counter()
                after, rows = call(lanes, done, stop)
                last, before = next_row(stop, p.save_every), p.first_row
                for name, values in rows.items():
                    fields[name][:, first - before : last - before] = values[:, : last - first]
                rate = (stop - done) / max(time.perf_counter() - tick, 1e-9)
                lanes, done = after, stop
                count = max(1, int(rate * CHUNK_SECONDS))
                if progress:
                    progress(done, p.steps)
        except KeyboardInterrupt:
            interrupted = True
        _, rows = call(lanes, 0, 1, closing=True)
        lanes = jax.tree.map(np.asarray, lanes)
        outcome = _outcome(p, lanes, fields, {name: values[:, 0] for name, values in rows.items()}, notes, self.name)
        outcome.interrupted, outcome.compile_seconds = interrupted, compile_seconds
        outcome.record = None if interrupted else tuple(jax.tree.leaves(lanes))
        outcome.run_seconds = time.perf_counter() - started
        if solved is not None:
            spent = (numerics.seconds or 0.0) - solved
            outcome.notes |= {"evaluation_seconds": outcome.run_seconds - spent, "solution_seconds": spent}
        return finished(p, outcome)

    def run_traced(self, problem: Problem) -> Outcome:
        """The same run as one scan; in reverse mode segments of about √steps steps are computed again instead of stored."""
        p, numerics, notes = self._planned(problem)
        axes = axes_of(p)
        lanes = first_lane(jnp.asarray(p.state), tuple(map(jnp.asarray, p.guess)), compensated=numerics.increments is not None)
        clock, sizes = Clock.of(p), self._sizes(problem, sizes_of_traced)
        one = make_step(p.equation, axes, p.max_iterations, True, numerics)

        def step(lanes, k):
            """The lanes after step k and the row that they left; a step past the last is undone."""
            after, row = one(lanes, p.params, sizes, clock)
            return jax.tree.map(lambda a, b: jnp.where(k < p.steps, a, b), after, lanes), row

        def to_next_row(lanes, start):
            """The lanes at the next row and the row that they leave here, by one step in the program, run many times."""
            if p.save_every == 1:
                return step(lanes, start)

            def onwards(carry, k):
                lanes, row = carry
                after, left = step(lanes, k)
                return (after, jnp.where(k == start, left, row)), None

            shape = jax.eval_shape(step, lanes, start)[1]
            return jax.lax.scan(onwards, (lanes, jnp.zeros(shape.shape, shape.dtype)), start + jnp.arange(p.save_every))[0]

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
        rows = {name: by_lane(a, p.batch, jnp) for name, a in unpack_rows(p.equation, axes, packed, p.params, clock).items()}
        fields = {name: values if p.is_node(name) else values[:, :-1] for name, values in rows.items()}
        return finished(p, _outcome(p, lanes, fields, {name: values[:, -1] for name, values in rows.items()}, notes, self.name))

    def _planned(self, p: Problem) -> tuple[Problem, Numerics, dict[str, Any]]:
        """The run with its equations in scalars where the policy has them so, how its steps are computed, and what `stats` say
        about what cannot be."""
        if self.scalars == "never":
            notes = {"not_compensated": "scalars='never' leaves the increments of the step unknown"} if p.compensated else {}
            return p, Numerics(self.linear_solver), notes
        from dirax.engines import in_jax  # the scalar program is imported when it is used

        key, notes, jacobians, increments = (p.equation, p.params, p.batch_params), {}, None, None
        if p.compensated:
            found = in_jax.increments_of(*key)
            increments, notes = (None, {"not_compensated": found}) if isinstance(found, str) else (found, {})
        if policy.small_for_scalars(p) or (p.size <= policy.LARGEST_NESTED and in_jax.nested(*key)):
            equation, jacobians = in_jax.in_scalars(*key)
            p = dataclasses.replace(p, equation=equation)
        return p, Numerics(self.linear_solver, increments, jacobians), notes

    def _sizes(self, p: Problem, found: Callable) -> tuple:
        """Those of the unknowns of every stage."""
        return found(p)


def _outcome(
    p: Problem, lanes: Lane, fields: dict[str, Any], closing: dict[str, Any], notes: dict[str, Any], name: str
) -> Outcome:
    lanes = lanes if p.batch is not None else jax.tree.map(lambda a: a[None], lanes)
    return Outcome(
        fields=fields,
        closing=closing,
        completed=lanes.completed,
        status=lanes.status,
        iterations=lanes.iterations,
        max_residual=lanes.max_residual,
        last_state=lanes.state,
        last_unknowns=lanes.unknowns[0],
        engine=name,
        notes=notes,
    )


def _host_arrays(p: Problem, rows: dict[str, Any]) -> dict[str, np.ndarray]:
    """Arrays for the whole run, given those of a chunk."""
    shapes = {name: (len(values), p.rows - (not p.is_node(name)), *values.shape[2:]) for name, values in rows.items()}
    return {name: np.full(shape, np.nan) for name, shape in shapes.items()}
