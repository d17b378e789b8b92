"""The engine "native": the run of a kernel, chunk by chunk, and the run as a function that JAX differentiates."""

import time

import numpy as np

from dirax.engines.contract import NOT_CONVERGED, OK, Outcome, Problem, Progress, finished
from dirax.engines.engine import AbstractEngine
from dirax.engines.native.collocation_kernels import collocation_kernels
from dirax.engines.native.kernels import Kernels, kernels
from dirax.engines.native.lanes import Lanes, width_for
from dirax.engines.sizes import grown
from dirax.program.interpreter import UnsupportedPrimitive

CHUNK_SECONDS = 0.1
WORTH_THREADS = 2e-3
"""Seconds of work from which on it is shared among threads."""

FIRST_CHUNK = 20_000
"""Lane-steps of the first call, from which the speed is estimated."""


class Native(AbstractEngine):
    """Small systems on a CPU: the step traced to scalars, compiled by LLVM, run on vectors of trajectories and several threads.

    `most_operations` bounds the scalar operations of a step, except of one that is nested; None: as many as can be traced.
    """

    most_operations: int | None = None
    name = "native"

    def supports(self, problem: Problem) -> str | None:
        """None if the step is a scalar program, of so many operations; else the primitive and the line of the user's source, or
        how many operations there are."""
        try:
            if collocation_kernels(problem.equation, problem.params, problem.batch_params) is not None:
                return None
            made = kernels(problem.equation, problem.params, problem.batch_params, problem.compensated)
            if self.most_operations is not None and not made.step.nested:
                made.check()
                if made.operations > self.most_operations:
                    return f"{made.operations} scalar operations a step, more than {self.most_operations}"
        except UnsupportedPrimitive as error:
            return str(error)
        return None

    def run(self, problem: Problem, progress: Progress | None = None) -> Outcome:
        """Run `problem`, saving into NumPy arrays; Ctrl-C and failing steps keep what was computed.

        Raises `UnsupportedPrimitive` for a step that cannot be compiled.
        """
        return run(problem, progress)

    def run_traced(self, problem: Problem) -> Outcome:
        """The same as one primitive of JAX, with derivatives by loops over the steps; those of the second order and higher are
        by the xla engine. Raises `UnsupportedPrimitive` as well."""
        from dirax.engines.native.gradients.differentiate import run_traced  # imported when it is used

        return run_traced(problem)


def run(p: Problem, progress: Progress | None = None) -> Outcome:
    """The run of a problem, as `Native.run` has it."""
    started = time.perf_counter()
    nodes = collocation_kernels(p.equation, p.params, p.batch_params)
    made = nodes or kernels(p.equation, p.params, p.batch_params, p.compensated)
    lanes = Lanes(p, made, width_for(p.batch or 1) if nodes is None else 1)
    kernel, cached = made.kernel(lanes.width)
    fields, outs = lanes.arrays(p.rows)
    compile_seconds, started = time.perf_counter() - started, time.perf_counter()

    done, interrupted, threads = 0, False, 1
    count = max(1, FIRST_CHUNK // max(1, p.batch or 1))
    try:
        while done < p.steps and (done == 0 or lanes.going):
            count = min(count, p.steps - done)
            tick = time.perf_counter()
            lanes.call(kernel, lanes.records, outs, done, done + count, p.save_every, threads)
            done += count
            rate = count / max(time.perf_counter() - tick, 1e-9)
            count = max(1, int(rate * CHUNK_SECONDS))
            threads = lanes.threads if threads > 1 or p.steps - done > rate * WORTH_THREADS else 1
            if progress:
                progress(done, p.steps)
    except KeyboardInterrupt:
        interrupted = True
    if not interrupted:
        if nodes is not None:
            _by_newton(lanes, outs)
        _with_present_sizes(lanes, kernels(p.equation, p.params, p.batch_params, p.compensated) if nodes is None else None, outs)
    run_seconds = time.perf_counter() - started
    closing, outs = lanes.arrays(2)
    lanes.call(kernel, lanes.records.copy(), outs, 0, 1, 1, threads)
    table, record = lanes.table(), lanes.record
    whole = lambda quantity: table[:, quantity].astype(np.int64)
    outcome = Outcome(
        fields=fields,
        closing={name: rows[:, 0] for name, rows in closing.items()},
        completed=whole(record.completed),
        status=whole(record.status),
        iterations=whole(record.iterations),
        max_residual=table[:, record.max_residual].copy(),
        last_state=table[:, record.state].copy(),
        last_unknowns=table[:, record.unknowns(0, p.equation.stages[0][0].unknowns)].copy(),
        interrupted=interrupted,
        compile_seconds=compile_seconds,
        run_seconds=run_seconds,
        engine="native",
        notes={
            "unknowns": sum(len(made.step.equations[i].unknowns) for i, _ in made.step.stages),
            "operations": made.operations,
            "lanes": lanes.width,
            "threads": lanes.threads,
            "kernel_cached": cached,
            **({} if nodes is None else nodes.notes),
        },
    )
    return finished(p, outcome)


def _by_newton(lanes: Lanes, outs: np.ndarray) -> None:
    """Go on with trajectories whose fixed-point iteration has not converged, by Newton's method for all nodes together."""
    p, record = lanes.problem, lanes.record
    left = np.flatnonzero(lanes.records[:, record.status, 0] == NOT_CONVERGED).tolist()
    if not left:
        return
    try:
        newton, _ = kernels(p.equation, p.params, p.batch_params, True).kernel(1)
    except UnsupportedPrimitive:  # too large to be written out: they end where they are
        return
    for lane in left:
        one = lanes.records[lane : lane + 1]
        one[:, record.status] = OK
        one[:, record.differences] = 0.0
        lanes.call(newton, one, outs[lane : lane + 1], int(one[0, record.completed, 0]), p.steps, p.save_every, 1, lane)


RESUMED = 16
"""How often trajectories go on with other sizes."""


def _with_present_sizes(lanes: Lanes, made: Kernels | None, outs: np.ndarray) -> None:
    """Go on with trajectories whose unknowns have become larger than where they began: one by one, since each is at another
    step, and with the bits that it has alone. An attempt that does not come to another step leaves no trace."""
    p, record = lanes.problem, lanes.record
    failed = np.flatnonzero(lanes.table()[:, record.status] == NOT_CONVERGED)
    for _ in range(RESUMED if made is not None else 0):
        if not len(failed):
            return
        table = lanes.table().copy()
        assert made is not None
        own, stages = table[failed], [stage.unknowns for stage, _ in p.equation.stages]
        places = [record.sizes(i, k) for i, k in enumerate(stages)]
        before = tuple(np.stack([own[:, part] for part in pair], axis=1) for pair in places)
        guess = tuple(own[:, record.unknowns(i, k)] for i, k in enumerate(stages))
        sizes, more = grown(p, failed, own[:, record.completed], own[:, record.state], guess, before)
        if not np.any(more):
            return
        for pair, values in zip(places, sizes, strict=True):
            for part, numbers in zip(pair, np.moveaxis(values, 1, 0), strict=True):
                own[:, part] = numbers
        own[more, record.status] = OK
        chosen, kernel = failed[more], made.kernel(1)[0]
        alone = lanes.alone(chosen, made, tuple(a[more] for a in sizes))
        alone.records[:] = own[more][:, :, None]
        blocks, places_in = np.divmod(chosen, lanes.width)
        addresses = np.ascontiguousarray(outs[blocks, :, places_in][:, :, None])
        for i, done in enumerate(own[more, record.completed].astype(int).tolist()):
            one = slice(i, i + 1)
            alone.call(kernel, alone.records[one], addresses[one], done, p.steps, p.save_every, 1, i)
        further = alone.records[:, record.completed, 0] > own[more, record.completed]
        lanes.records[blocks[further], :, places_in[further]] = alone.records[further, :, 0]
        failed = chosen[further & (alone.records[:, record.status, 0] == NOT_CONVERGED)]
