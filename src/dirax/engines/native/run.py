"""The run of a kernel, chunk by chunk."""

import time

import numpy as np

from dirax.engines.contract import NOT_CONVERGED, OK, Outcome, Problem, Progress, finished
from dirax.engines.native.collocation_kernels import collocation_kernels
from dirax.engines.native.kernels import Kernels, kernels
from dirax.engines.native.lanes import Lanes, width_for
from dirax.engines.native.loops.record import DOUBTFUL
from dirax.engines.native.one_lane import OneLane, places_of
from dirax.engines.sizes import grown, sizes_there
from dirax.program.interpreter import UnsupportedPrimitive

CHUNK_SECONDS = 0.1
WORTH_THREADS = 2e-3
"""Seconds of work from which on it is shared among threads."""

FIRST_CHUNK = 20_000
"""Lane-steps of the first call, from which the speed is estimated."""


def run(p: Problem, progress: Progress | None = None) -> Outcome:
    """The run of a problem, as `Native.run` has it."""
    return Ready(p)(p, progress)


class Ready:
    """The kernel of a problem and of those that differ from it in numbers alone; called with one of them, it runs it.

    Raises `UnsupportedPrimitive` for a step that cannot be compiled.
    """

    def __init__(self, p: Problem):
        started = time.perf_counter()
        nodes = collocation_kernels(p.equation, p.params, p.batch_params)
        made = nodes or kernels(p.equation, p.params, p.batch_params, p.compensated)
        self.made, self.is_collocation = made, nodes is not None
        self.width = 1 if self.is_collocation else width_for(p.batch or 1)
        self.kernel, cached = made.kernel(self.width)
        self.first_unknowns = made.record.unknowns(0, p.equation.stages[0][0].unknowns)
        self.notes = {
            "unknowns": sum(len(made.step.equations[i].unknowns) for i, _ in made.step.stages),
            "operations": made.operations,
            "lanes": self.width,
            "threads": 1,
            "kernel_cached": cached,
            **({} if nodes is None else nodes.notes),
        }
        self.compile_seconds = time.perf_counter() - started

    def __call__(self, p: Problem, progress: Progress | None = None) -> Outcome:
        """Run `p`, as `Native.run` has it."""
        places = places_of(p, self.made)
        lanes = Lanes(p, self.made, self.width) if places is None else OneLane(p, self.made, places)
        fields = lanes.fields
        if places is None and self.made.finds_sizes:
            lanes.advance(self.kernel, p.after, p.after)
            look_closer(lanes)
        compile_seconds, cached, started = self.compile_seconds, self.notes["kernel_cached"], time.perf_counter()
        done, interrupted, threads = p.after, False, 1
        count = max(1, FIRST_CHUNK // max(1, p.batch or 1))
        try:
            while done < p.steps and (done == p.after or lanes.going):
                count = min(count, p.steps - done)
                tick = time.perf_counter()
                lanes.advance(self.kernel, done, done + count, threads)
                if done == p.after and lanes.doubtful:
                    look_closer(lanes)
                    lanes.advance(self.kernel, done, done + count, threads)
                done += count
                rate = count / max(time.perf_counter() - tick, 1e-9)
                count = max(1, int(rate * CHUNK_SECONDS))
                threads = lanes.threads if threads > 1 or p.steps - done > rate * WORTH_THREADS else 1
                if progress:
                    progress(done, p.steps)
        except KeyboardInterrupt:
            interrupted = True
        by_newton = False
        if not interrupted:
            by_newton = self.is_collocation and _by_newton(lanes)
            if not self.is_collocation:
                _with_present_sizes(lanes, self.made)
        run_seconds = time.perf_counter() - started
        closing = lanes.close(self.kernel)
        self.compile_seconds, self.notes["kernel_cached"] = 0.0, True  # those of the first run
        table, record = lanes.table(), lanes.record
        counts = table[:, record.completed : record.iterations + 1].astype(np.int64)
        outcome = Outcome(
            fields=fields,
            closing=closing,
            completed=counts[:, 0],
            status=counts[:, 1],
            iterations=counts[:, 2],
            max_residual=table[:, record.max_residual],
            last_state=table[:, record.state],
            last_unknowns=table[:, self.first_unknowns],
            interrupted=interrupted,
            compile_seconds=compile_seconds,
            run_seconds=run_seconds,
            record=None if interrupted or by_newton else table,
            engine="native",
            notes={**self.notes, "kernel_cached": cached, "threads": lanes.threads},
        )
        whole = places is not None and outcome.completed[0] == p.steps  # then the closing row stands where it belongs
        return outcome if whole else finished(p, outcome)


def _by_newton(lanes: Lanes | OneLane) -> bool:
    """Go on with trajectories whose fixed-point iteration has not converged, by Newton's method for all nodes together; whether
    there are any."""
    if left := lanes.left():
        p = lanes.problem
        try:
            newton, _ = kernels(p.equation, p.params, p.batch_params, True).kernel(1)
        except UnsupportedPrimitive:  # too large to be written out: they end where they are
            return False
        for lane in left:
            lanes.again(newton, lane)
    return bool(left)


def look_closer(lanes: Lanes | OneLane) -> None:
    """Find the sizes that are in doubt."""
    p, record, table = lanes.problem, lanes.record, lanes.table()
    doubtful = np.flatnonzero(table[:, record.status] == DOUBTFUL)
    if len(doubtful):
        own = table[doubtful]
        guess = tuple(own[:, record.unknowns(i, stage.unknowns)] for i, (stage, _) in enumerate(p.equation.stages))
        record.put_sizes(own, sizes_there(p, doubtful, own[:, record.completed], own[:, record.state], guess))
        own[:, record.status] = OK
        lanes.put(doubtful, own)


RESUMED = 16
"""How often trajectories go on with other sizes."""


def _with_present_sizes(lanes: Lanes | OneLane, made: Kernels) -> None:
    """Go on with trajectories whose unknowns have become larger than where they began. An attempt that does not come to another
    step leaves no trace."""
    p, record = lanes.problem, lanes.record
    if not lanes.stuck:
        return
    table = lanes.table()
    failed, tried = np.flatnonzero(table[:, record.status] == NOT_CONVERGED), 0
    while len(failed) and tried < RESUMED:
        tried, own, stages = tried + 1, table[failed], [stage.unknowns for stage, _ in p.equation.stages]
        places = [record.sizes(i, k) for i, k in enumerate(stages)]
        before = tuple(np.stack([own[:, part] for part in pair], axis=1) for pair in places)
        guess = tuple(own[:, record.unknowns(i, k)] for i, k in enumerate(stages))
        sizes, more = grown(p, failed, own[:, record.completed], own[:, record.state], guess, before)
        if not np.any(more):
            return
        record.put_sizes(own, sizes)
        own[:, record.status] = OK
        before, chosen = table[failed[more]], failed[more]
        after = lanes.attempt(chosen, made, own[more])
        further = after[:, record.completed] > own[more, record.completed]
        lanes.put(chosen, np.where(further[:, None], after, before))
        table, failed = lanes.table(), chosen[further & (after[:, record.status] == NOT_CONVERGED)]
