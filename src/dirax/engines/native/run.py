"""The run of a kernel, chunk by chunk."""

import math
import time
from typing import NamedTuple

import numpy as np

from dirax.engines.contract import ALL_UNKNOWNS, NOT_CONVERGED, OK, TOO_LARGE, Outcome, Problem, Progress, finished
from dirax.engines.native.collocation_kernels import CollocationKernels, collocation_kernels
from dirax.engines.native.kernels import Kernels, kernels
from dirax.engines.native.lanes import Closed, Lanes, width_for
from dirax.engines.native.loops.collocation_plan import depends
from dirax.engines.native.one_lane import OneLane, one_lane
from dirax.engines.native.sizes_of_lanes import find_sizes
from dirax.engines.native.stuck_lanes import otherwise
from dirax.program.interpreter import UnsupportedPrimitive
from dirax.text.representation import counted

CHUNK_SECONDS = 0.1
WORTH_THREADS = 2e-3
"""Seconds of work from which on it is shared among threads."""

FIRST_CHUNK = 2_000
"""Lane-steps of the first call, from which the speed is estimated."""


class Taken(NamedTuple):
    """A run that was taken: what was found, how long that took, how long its code was waited for, whether it was ready, whether
    Ctrl-C ended the run, and by which other ways trajectories went on."""

    closed: Closed
    run_seconds: float
    waited: float
    ready: bool
    interrupted: bool
    others: list[str]


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
        self.made = made
        newton = self.newton = made if isinstance(made, Kernels) else None
        self.width = width_for(p.batch or 1) if nodes is None or nodes.wide else 1
        kernel, cached = made.runs.kernel(self.width, self._steps(p))
        self.quick = kernel if made.runs.is_quick(self.width) else None
        if p.often and newton is not None and newton.record.kept:
            newton.of_sizes(self.width, often=True)
        if newton is not None and newton.rows_need_step is None:
            first = newton.step.equations[0]
            of_nodes = [n for name, nodes in first.rows.items() if p.is_node(name) for n in nodes.ravel().tolist()]
            newton.rows_need_step = depends(newton.step.graph, of_nodes, first.unknowns)
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

    def _steps(self, p: Problem) -> float:
        """The steps that a kernel is to take of it, in all blocks of lanes; as many as pay for any code if it is run `often`."""
        return math.inf if p.often else (p.steps - p.after) * -(-(p.batch or 1) // self.width)

    def __call__(self, p: Problem, progress: Progress | None = None) -> Outcome:
        """Run `p`, as `Native.run` has it."""
        lanes = one_lane(p, self.made) or Lanes(p, self.made, self.width)
        alone = isinstance(lanes, OneLane)
        taken = self._at_once(lanes, p) if alone and progress is None else None
        taken = taken or self._by_chunks(lanes, p, progress)
        if alone:
            self.made.idle[:] = [lanes]
        (table, fields, closing, closing_status), run_seconds, waited, ready, interrupted, others = taken
        compile_seconds, cached = self.compile_seconds + waited, self.notes["kernel_cached"] and ready
        self.compile_seconds, self.notes["kernel_cached"] = 0.0, True  # those of the first run
        record = lanes.record
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
            record=None if interrupted or others else (table,),
            engine="native",
            notes={**self.notes, "kernel_cached": cached, "threads": lanes.threads},
        )
        if self.newton is not None and self.newton.rows_need_step and not interrupted:
            bad = closing_status != OK
            outcome.unsaid = bad if bad.any() else None
        if others:
            outcome.notes["iteration"] = "; then ".join([str(self.notes.get("iteration", "Newton's method")), *others])
        whole = alone and outcome.completed[0] == p.steps  # then the closing row stands where it belongs
        return outcome if whole else finished(p, outcome)

    def _at_once(self, lanes: OneLane, p: Problem) -> Taken | None:
        """A short run from its first step by code that is ready, in one call; None for other runs, and those that stop."""
        if self.quick is None or self.newton is None or p.record is not None or p.steps > FIRST_CHUNK:
            return None
        sizes = self.newton.of_sizes(1)[0] if lanes.record.kept else None
        if sizes is None and lanes.record.kept:
            return None
        started, interrupted = time.perf_counter(), False
        try:
            closed = lanes.at_once(sizes, self.quick)
        except KeyboardInterrupt:  # what the call has found is there
            closed, interrupted = lanes.close(self.quick), True
        return None if closed is None else Taken(closed, time.perf_counter() - started, 0.0, True, interrupted, [])

    def _by_chunks(self, lanes: Lanes | OneLane, p: Problem, progress: Progress | None) -> Taken:
        """A run chunk by chunk, between which Ctrl-C is heard, and on several threads where that pays."""
        entered, runs = time.perf_counter(), self.made.runs
        kernel, ready = (self.quick, True) if self.quick else runs.kernel(self.width, self._steps(p))
        waited = 0.0 if ready else time.perf_counter() - entered
        if p.record is None and self.newton is not None:  # a fixed point finds its own
            waited += find_sizes(lanes, self.newton)
        started, before, done, interrupted, threads = time.perf_counter(), waited, p.after, False, 1
        count, others = FIRST_CHUNK if p.batch is None else max(1, FIRST_CHUNK // p.batch), []
        try:
            while done < p.steps and (done == p.after or lanes.going):
                count = min(count, p.steps - done)
                tick, busy = time.perf_counter(), 0.0 if self.quick else time.thread_time()
                lanes.advance(kernel, done, done + count, threads)
                done += count
                rate = count / max(time.perf_counter() - tick, 1e-9)
                if not self.quick:
                    busy = time.thread_time() - busy  # of one thread: another program may have the processor
                    runs.spent(self.width, busy)
                    if runs.quick_pays(self.width, busy * (p.steps - done) / count):
                        tick = time.perf_counter()
                        kernel, found = runs.kernel(self.width, math.inf)
                        ready, waited = ready and found, waited + time.perf_counter() - tick
                    self.quick = kernel if runs.is_quick(self.width) else None
                count = max(1, int(rate * CHUNK_SECONDS))
                threads = lanes.threads if threads > 1 or p.steps - done > rate * WORTH_THREADS else 1
                if progress:
                    progress(done, p.steps)
            if lanes.stuck:
                others = (
                    _by_newton(lanes, self.made) if isinstance(self.made, CollocationKernels) else otherwise(lanes, self.made)
                )
        except KeyboardInterrupt:
            interrupted = True
        run_seconds = time.perf_counter() - started - (waited - before)
        return Taken(lanes.close(kernel), run_seconds, waited, ready, interrupted, others)


def _by_newton(lanes: Lanes | OneLane, made: CollocationKernels) -> list[str]:
    """Go on with trajectories whose fixed-point iteration has not converged: by Newton's method with one Jacobian for all nodes,
    which needs systems of the size of one node alone, and where that does not converge by Newton's method with all unknowns
    together. Returns which were tried."""
    p, record, others = lanes.problem, lanes.record, []

    def left() -> tuple[np.ndarray, np.ndarray]:
        table = lanes.table()
        stuck = np.flatnonzero(table[:, record.status] == NOT_CONVERGED)
        own = table[stuck]
        own[:, record.differences] = 0.0
        return stuck, own

    stuck, own = left()
    if len(stuck) and made.by_newton is not None:
        own[:, record.status] = OK
        lanes.put(stuck, lanes.attempt(stuck, made.by_newton, own))
        others.append(f"simplified Newton in the eigenbasis of A, {counted(len(stuck), 'trajectory', 'trajectories')}")
        stuck, own = left()
    if not len(stuck):
        return others
    try:
        whole = kernels(p.equation, p.params, p.batch_params, True)
        whole.runs.kernel(1, p.steps)
    except UnsupportedPrimitive as error:  # too large to be written out: they end where they are
        return [*others, f"{TOO_LARGE} ({error})"]
    for i, (stage, _) in enumerate(p.equation.stages):
        own[:, record.sizes(i, stage.unknowns)] = 0.0
    lanes.put(stuck, own)
    others.append(f"{ALL_UNKNOWNS}, {counted(len(stuck), 'trajectory', 'trajectories')}")
    return others + otherwise(lanes, whole)
