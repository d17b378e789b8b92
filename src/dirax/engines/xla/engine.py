"""The engine "xla": steps on arrays, on any device, driven from the host in chunks, or one scan under a transformation."""

import dataclasses
import time
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from dirax.engines import policy
from dirax.engines.contract import UNSOLVED, Outcome, Problem, Progress, finished
from dirax.engines.engine import AbstractEngine
from dirax.engines.linear_solver import AbstractLinearSolver
from dirax.engines.sizes import sizes_of, sizes_of_traced
from dirax.engines.stuck import by_other_ways
from dirax.engines.xla.lane import Lane, Numerics, first_lane
from dirax.engines.xla.loop import Clock, axes_of, by_lane, make_step, unpack_rows
from dirax.engines.xla.run import Run, StuckRun


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
        run = Run(p, numerics, self._sizes(problem, sizes_of))
        compile_seconds, started, solved = time.perf_counter() - started, time.perf_counter(), numerics.seconds
        interrupted, stuck, with_sizes, others = False, StuckRun(run, problem), False, []
        try:
            run.onwards(p.after, p.steps, progress)
            if self.scalars != "never" and len(stuck.ended(UNSOLVED)):
                with_sizes, others = by_other_ways(stuck)
        except KeyboardInterrupt:
            interrupted = True
        closing, unsaid = run.closing()
        outcome = _outcome(p, run.lanes, run.fields, closing, notes, self.name)
        outcome.interrupted, outcome.compile_seconds = interrupted, compile_seconds
        outcome.unsaid = None if interrupted else unsaid
        outcome.record = None if interrupted or with_sizes or others else tuple(jax.tree.leaves(run.lanes))
        outcome.run_seconds = time.perf_counter() - started
        if others:
            outcome.notes |= {"iteration": "; then ".join(["Newton's method", *others])}
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
