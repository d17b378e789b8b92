"""A run of the engine "xla" on the host: chunk by chunk, and once more where trajectories are stuck."""

import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from dirax.engines.contract import OK, Problem, Progress
from dirax.engines.sizes import Sizes
from dirax.engines.stuck import AbstractStuck, Standing
from dirax.engines.xla.lane import Lane, Numerics, first_lane
from dirax.engines.xla.loop import Clock, axes_of, by_lane, compiled_chunk, next_row, row_capacity

FIRST_CHUNK = 64
"""Steps of the first chunk; those after it are as many as take CHUNK_SECONDS."""

CHUNK_SECONDS = 0.25


class Run:
    """The `lanes` of a problem, in the form in which they are computed, and the saved arrays, in which they write their rows."""

    def __init__(self, p: Problem, numerics: Numerics, sizes: Sizes):
        self.p, self.numerics, self.sizes = p, numerics, sizes
        self._chunk = compiled_chunk(jax.default_backend(), numerics.sparse is not None)
        self._axes, self._capacity, self._params = axes_of(p), row_capacity(p), jax.device_put(p.params)
        self.lanes: Lane = first_lane(np.asarray(p.state), tuple(map(np.asarray, p.guess)), np, numerics.increments is not None)
        if p.record is not None:
            self.lanes = jax.tree.unflatten(jax.tree.structure(self.lanes), p.record)
        _, empty = self._call(self.lanes, sizes, 0, 0)  # compile
        saved = lambda name, a: np.full((len(a), p.rows - (not p.is_node(name)), *a.shape[2:]), np.nan)
        self.fields = {name: saved(name, values) for name, values in empty.items()}

    def onwards(self, progress: Progress | None = None) -> None:
        """From where a run begins, or goes on, to its end."""

        def save(at: slice, rows: dict[str, np.ndarray]) -> None:
            for name, values in rows.items():
                self.fields[name][:, at] = values

        self._advance(self.p.after, self.sizes, save, progress)

    def attempt(self, some: np.ndarray, first: int, lanes: Lane, sizes: Sizes) -> tuple[Lane, Callable[[np.ndarray], None]]:
        """These lanes, all of them after `first` steps and the others ended, on their way to the end; and what writes the rows of
        some, which were kept."""
        kept, own, self.lanes = [], self.lanes, lanes
        try:
            self._advance(first, sizes, lambda at, rows: kept.append((at, {name: a[some] for name, a in rows.items()})))
            after = jax.tree.map(np.asarray, self.lanes)
        finally:
            self.lanes = own

        def save(good: np.ndarray) -> None:
            for at, rows in kept:
                for name, values in rows.items():
                    self.fields[name][some[good], at] = values[good]

        return after, save

    def closing(self) -> dict[str, np.ndarray]:
        """The row of the state at which each lane ended."""
        _, rows = self._call(self.lanes, self.sizes, 0, 1, closing=True)
        self.lanes = jax.tree.map(np.asarray, self.lanes)
        return {name: values[:, 0] for name, values in rows.items()}

    def _advance(self, done: int, sizes: Sizes, save: Callable, progress: Progress | None = None) -> None:
        p, count = self.p, FIRST_CHUNK
        while done < p.steps and not np.all(np.asarray(self.lanes.counts)[..., 1] != OK):
            first = next_row(done, p.save_every)
            stop = min(done + count, (first + self._capacity) * p.save_every, p.steps)
            tick = time.perf_counter()
            after, rows = self._call(self.lanes, sizes, done, stop)
            last = next_row(stop, p.save_every)
            save(slice(first - p.first_row, last - p.first_row), {name: a[:, : last - first] for name, a in rows.items()})
            rate = (stop - done) / max(time.perf_counter() - tick, 1e-9)
            self.lanes, done = after, stop
            count = max(1, int(rate * CHUNK_SECONDS))
            if progress:
                progress(done, p.steps)

    def _call(
        self, lanes: Lane, sizes: Sizes, start: int, stop: int, closing: bool = False
    ) -> tuple[Lane, dict[str, np.ndarray]]:
        p = self.p
        t0, h, first_step = map(np.float64, (p.t0, p.h, p.first_step))
        every, start_, stop_ = map(np.int64, (p.save_every, start, stop))
        clock = Clock(t0, h, first_step, every, start_, stop_, np.bool_(closing))
        at = clock, self._capacity, self._axes, p.max_iterations, self.numerics
        after, rows = self._chunk(p.equation, lanes, self._params, sizes, *at)
        return after, {name: by_lane(np.asarray(values), p.batch, np) for name, values in rows.items()}


class StuckRun(AbstractStuck):
    """The lanes of a run that has ended, of a problem as it was given."""

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
        both = self.run.lanes, self.run.sizes
        lanes, of_all = jax.tree.map(lambda a: self._all(a).copy(), both)
        counts, completed, good = lanes.counts, self._all(self.run.lanes.completed)[some], np.zeros(len(some), bool)
        for stage, own in enumerate(sizes or ()):
            of_all[stage][some] = own
        for stage, u in enumerate(unknowns or ()):
            lanes.history[stage][some, 0], lanes.history[stage][some, 1:] = u, 0.0
        for first in np.unique(completed):
            here = completed == first
            ended, counts[:, 1] = counts[:, 1].copy(), ENDED
            counts[some[here], 1] = OK
            after, save = self.run.attempt(some[here], int(first), *jax.tree.map(self._own, (lanes, of_all)))
            counts[:, 1] = ended
            after = jax.tree.map(self._all, after)
            good[here] = further = after.counts[some[here], 0] > first
            save(further)
            _put(lanes, after, some[here][further])
        _put((lanes, of_all), jax.tree.map(self._all, both), some[~good])
        self.run.lanes, self.run.sizes = jax.tree.map(self._own, (lanes, of_all))
        return some[good], counts[some[good], 1]


ENDED = -1
"""The outcome of lanes that stay as they are."""


def _put(arrays: Any, others: Any, some: np.ndarray) -> None:
    """Take the entries `some` of other arrays, in place."""
    for own, other in zip(jax.tree.leaves(arrays), jax.tree.leaves(others), strict=True):
        own[some] = other[some]
