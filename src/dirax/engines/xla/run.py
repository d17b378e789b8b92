"""A run of the engine "xla" on the host: chunk by chunk, and once more where trajectories are stuck."""

import time
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from dirax.engines.contract import NOT_CONVERGED, OK, Problem, Progress
from dirax.engines.sizes import Sizes
from dirax.engines.stuck import AbstractStuck, Standing
from dirax.engines.xla.lane import Lane, Numerics, first_lane, nodes_need_step
from dirax.engines.xla.loop import Clock, axes_of, by_lane, compiled_chunk, next_row, row_capacity

FIRST_CHUNK = 64
"""Steps of the first chunk; those after it are as many as take CHUNK_SECONDS."""

CHUNK_SECONDS = 0.25


class Run:
    """The `lanes` of a problem, in the form in which they are computed, and the saved arrays, in which they write their rows."""

    def __init__(self, p: Problem, numerics: Numerics, sizes: Sizes, lanes: Lane | None = None):
        self.p, self.numerics, self.sizes = p, numerics, sizes
        self._chunk = compiled_chunk(jax.default_backend(), numerics.sparse is not None)
        self._axes, self._capacity, self._params = axes_of(p), row_capacity(p), jax.device_put(p.params)
        self.lanes: Lane = lanes or first_lane(
            np.asarray(p.state), tuple(map(np.asarray, p.guess)), np, numerics.increments is not None
        )
        if lanes is None and p.record is not None:
            self.lanes = jax.tree.unflatten(jax.tree.structure(self.lanes), p.record)
        _, empty = self._call(self.lanes, 0, 0)  # compile
        saved = lambda name, a: np.full((len(a), p.rows - (not p.is_node(name)), *a.shape[2:]), np.nan)
        self.fields = {name: saved(name, values) for name, values in empty.items()}

    def onwards(self, done: int, until: int, progress: Progress | None = None) -> None:
        """From a step on, at which all lanes are that have not ended, to another one."""
        p, count = self.p, FIRST_CHUNK
        while done < until and not np.all(np.asarray(self.lanes.counts)[..., 1] != OK):
            first = next_row(done, p.save_every)
            stop = min(done + count, (first + self._capacity) * p.save_every, until)
            tick = time.perf_counter()
            after, rows = self._call(self.lanes, done, stop)
            last = next_row(stop, p.save_every)
            for name, values in rows.items():
                self.fields[name][:, first - p.first_row : last - p.first_row] = values[:, : last - first]
            rate = (stop - done) / max(time.perf_counter() - tick, 1e-9)
            self.lanes, done = after, stop
            count = max(1, int(rate * CHUNK_SECONDS))
            if progress:
                progress(done, p.steps)

    def closing(self) -> tuple[dict[str, np.ndarray], np.ndarray | None]:
        """The row of the state at which each lane ended; and which (B,) have nodes there made of a step without a solution, None
        where none has."""
        after, rows = self._call(self.lanes, 0, 1, closing=True)
        lanes = self.lanes = jax.tree.map(np.asarray, self.lanes)
        closing = {name: values[:, 0] for name, values in rows.items()}
        unsaid, p = np.atleast_1d(np.asarray(after.status) != OK), self.p
        if not np.any(unsaid):
            return closing, None
        lane = int(np.argmax(unsaid))
        params = jax.tree.map(lambda leaf: leaf[lane], p.params) if p.batch_params else p.params
        return closing, unsaid if nodes_need_step(p, lanes.state if p.batch is None else lanes.state[lane], params) else None

    def _call(self, lanes: Lane, start: int, stop: int, closing: bool = False) -> tuple[Lane, dict[str, np.ndarray]]:
        p = self.p
        t0, h, first_step = map(np.float64, (p.t0, p.h, p.first_step))
        every, begins, ends = map(np.int64, (p.save_every, start, stop))
        clock = Clock(t0, h, first_step, every, begins, ends, np.bool_(closing))
        at = clock, self._capacity, self._axes, p.max_iterations, self.numerics
        after, rows = self._chunk(p.equation, lanes, self._params, self.sizes, *at)
        return after, {name: by_lane(np.asarray(values), p.batch, np) for name, values in rows.items()}


class StuckRun(AbstractStuck):
    """The lanes of a run that has ended, of a problem as it was given. They go on in batches of their own, of few sizes, for each
    of which XLA compiles."""

    def __init__(self, run: Run, problem: Problem):
        self.run, self.problem = run, problem
        one = problem.batch is None
        self._all = lambda a: np.asarray(a)[None] if one else np.asarray(a)
        self._own = lambda a: a[0] if one else a

    def ended(self, status: Sequence[int]) -> np.ndarray:
        return np.flatnonzero(np.isin(self._all(self.run.lanes.status), status))

    def standing(self, some: np.ndarray) -> Standing:
        lanes, of_all = self.run.lanes, lambda arrays: tuple(self._all(a)[some] for a in arrays)
        completed, state = of_all((lanes.completed, lanes.state))
        return Standing(completed, state, of_all(lanes.unknowns), of_all(self.run.sizes))

    def further(
        self, some: np.ndarray, sizes: Sizes | None = None, unknowns: Sequence[np.ndarray] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        both = jax.tree.map(lambda a: self._all(a).copy(), (self.run.lanes, self.run.sizes))
        count, p = len(some), self.run.p
        completed, run = both[0].completed[some], self._alone(some, both, sizes, unknowns)
        begins = np.unique(completed).astype(int).tolist()
        for first, until in zip(begins, [*begins[1:], p.steps], strict=True):  # each begins where it stands
            lanes = jax.tree.map(lambda a: self._all(a).copy(), run.lanes)
            lanes.counts[:count, 1][completed == first] = OK
            run.lanes = jax.tree.map(self._own, lanes)
            run.onwards(first, until)
        after = jax.tree.map(lambda a: self._all(a)[:count], (run.lanes, run.sizes))
        further = after[0].completed > completed
        for own, new in zip(jax.tree.leaves(both), jax.tree.leaves(after), strict=True):
            own[some[further]] = new[further]
        for i in np.flatnonzero(further):
            row = next_row(int(completed[i]), p.save_every) - p.first_row
            for name, values in run.fields.items():
                self.run.fields[name][some[i], row:] = values[i, row:]
        self.run.lanes, self.run.sizes = jax.tree.map(self._own, both)
        return some[further], after[0].status[further]

    def _alone(self, some: np.ndarray, both: Any, sizes: Any, unknowns: Any) -> Run:
        """A run of lanes alone, as many as the next power of four, which all have ended."""
        p = self.run.p
        width = 4 ** int(np.ceil(np.log2(len(some)) / 2))
        taken = some[np.minimum(np.arange(width), len(some) - 1)]
        lanes, of_all = jax.tree.map(lambda a: a[taken], both)
        for stage, own in enumerate(sizes or ()):
            of_all[stage][: len(some)] = own
        for stage, u in enumerate(unknowns or ()):
            lanes.history[stage][: len(some), 0], lanes.history[stage][: len(some), 1:] = u, 0.0
        lanes.counts[:, 1] = NOT_CONVERGED
        if p.batch is not None:
            params = jax.tree.map(lambda a: np.asarray(a)[taken], p.params) if p.batch_params else p.params
            p = p.with_numbers(batch=width, params=params)
        return Run(p, self.run.numerics, *jax.tree.map(self._own, (of_all, lanes)))
