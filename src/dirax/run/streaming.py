"""A run whose rows go to the disk while it goes on, piece by piece, and which the same call goes on with."""

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dirax.engines.contract import OK, Outcome, Problem, cut, saved_steps
from dirax.run.progress import reporting
from dirax.run.result import messages, solution_of, stats_of, times_of, warn_of_last_rows
from dirax.run.settings import Settings
from dirax.run.validate import Case, refuse_more_than_memory
from dirax.solution import fingerprint
from dirax.solution.atomic_files import checked_place, clear_leftovers, placed
from dirax.solution.description import Variable, describe, layout_of
from dirax.solution.flushed_files import Hold, refuse_more_than_disk, taken, writing
from dirax.solution.loading import stored_run
from dirax.solution.run_store import CHUNK_BYTES, MOST_ROWS, Growing, Reached, RunStore, is_growing
from dirax.solution.saving import file_form
from dirax.solution.solution import Solution
from dirax.solution.stored import Unreadable
from dirax.text.tables import plain

FIRST_PIECE = 16
"""Steps of the first piece."""

PIECE_SECONDS = 5.0
"""How long others take: what is done at least as often is not lost."""

FEWEST_ROWS = 256
"""Rows of a chunk where there is room for them: a run of few rows may go on."""

STOPPED = "the run was stopped before its end: the same call of dx.simulate goes on, and so does extend"


@dataclass
class Stream:
    """A run into a store; `row0` is the given row 0 of a start from two points, which stands before those of the problem."""

    settings: Settings
    case: Case
    problem: Problem
    row0: dict[str, Any] | None
    run: Callable
    path: Path
    steps: int
    save_every: int
    """As they were asked for."""

    def __post_init__(self):
        self.offset = int(self.row0 is not None)
        self.hold = Hold()
        self.store: RunStore | None = None
        self.layout = layout_of(self.problem.fields)
        self.compile_seconds, self.run_seconds = 0.0, 0.0

    # ------------------------------------------------------------------------------------------ the whole run

    def solution(self, progress: Any) -> Solution:
        """Run what is left, and open the store."""
        try:
            if self.path.exists():
                self._take_up()
            else:
                checked_place(self.path, False)
                clear_leftovers(self.path)
            with reporting(progress, self.steps) as report:
                self._fill(report)
        except KeyboardInterrupt:
            if self.store is None:
                raise
        finally:
            self.hold.release(self.path)
        return self._opened()

    def _fill(self, report: Any) -> None:
        reached = None if self.store is None else self.store.reached
        if reached is None or not (reached.ended or reached.steps == self.problem.steps):
            for piece, outcome in self._pieces(report):
                self.compile_seconds += outcome.compile_seconds
                self.run_seconds += outcome.run_seconds
                if self.store is None:
                    self._make(piece, outcome)
                else:
                    self._write(self.store, piece, outcome)
        assert self.store is not None
        self.store.finish()

    def _pieces(self, report: Any) -> Iterator[tuple[Problem, Outcome]]:
        """The rest of the run, cut at the chunks of the store and where a piece takes PIECE_SECONDS."""
        p, count = self.problem, FIRST_PIECE
        tell = None if report is None else (lambda done, _: report(done, p.steps))
        reached = None if self.store is None else self.store.reached
        done, record = (0, None) if reached is None else (reached.steps, reached.record)
        while True:
            row = next_row(p, done)
            chunk = (row + self.offset) // self.chunk + 1
            stop = min(done + count, (chunk * self.chunk - self.offset) * p.save_every, p.steps)
            piece = p.with_numbers(steps=stop, after=done, record=record, first_row=row)
            tick = time.perf_counter()
            outcome = self.run(piece, tell)
            if not outcome.interrupted and outcome.record is None and stop < p.steps and np.any(outcome.status == OK):
                stop, piece = p.steps, p  # an engine that does not go on
                refuse_more_than_memory(p)
                outcome = self.run(p, tell)
            if outcome.interrupted:
                raise KeyboardInterrupt
            count = max(1, int((stop - done) / max(time.perf_counter() - tick, 1e-9) * PIECE_SECONDS))
            yield piece, outcome
            done, record = stop, outcome.record
            if stop == p.steps or (p.batch is None and outcome.status[0] != OK):
                return

    # ------------------------------------------------------------------------------------------ the store

    @property
    def chunk(self) -> int:
        """Rows of a chunk."""
        if self.store is not None:
            return self.store.reached.chunk
        lanes = self.problem.batch or 1
        largest = max(8 * lanes * int(np.prod(field.shape)) for field in self.problem.fields.values())
        return max(1, min(CHUNK_BYTES // max(largest, 1), MOST_ROWS, max(FEWEST_ROWS, self.rows)))

    @property
    def rows(self) -> int:
        """Those of the whole run."""
        return self.problem.rows + self.offset

    def _take_up(self) -> None:
        """Hold the store that is there. Raises for what is no store of a run, and that of another run."""
        path, p = self.path, self.problem
        if not is_growing(path):
            raise FileExistsError(f"{path} exists and is not the store of a run that to= has written: choose another path.")
        taken(path, self.hold)
        try:
            reached = Reached.of(path)
        except Unreadable as error:
            raise ValueError(f"{path} cannot be gone on with: {error}. Choose another path for to=, or remove it.") from error
        if found := fingerprint.differences(reached.marks, self.marks()):
            raise ValueError(
                f"{path} belongs to another run, which differs in {'; '.join(found)}: choose another path for to=, or remove it."
            )
        if reached.steps > p.steps:
            raise ValueError(
                f"{path} has {reached.steps + p.first_step} steps already, and {p.steps + p.first_step} were asked for: "
                "dx.load opens it, and sol[t0:t1] is a part of it."
            )
        self.store = RunStore(path, reached)
        self.run_seconds = float(json.loads(reached.said["stats"])["run_seconds"])
        if not reached.ended and reached.steps < p.steps:
            self.store.keep(next_row(p, reached.steps) + self.offset)
            self.store.grow(self.rows)

    def _make(self, piece: Problem, outcome: Outcome) -> None:
        """Make the store, with the rows of its first piece."""
        s, p = self.settings, self.problem
        fields = {name: values.copy() for name, values in outcome.fields.items()}
        first = solution_of(s.system, s.scheme, self.case, piece, replace(outcome, fields=fields), self.row0, False)
        variables, attributes = file_form(describe(first, derived=False))
        attributes |= {"ok": json.dumps(False), "message": json.dumps({} if p.batch is not None else STOPPED)}
        if "ok" in variables:
            variables["ok"] = Variable(variables["ok"].dims, np.zeros(p.batch or 1, np.int8), variables["ok"].about)
        arrays = {entry["variable"]: Growing(p.batch, tuple(entry["shape"]), entry["place"] == "step") for entry in self.layout}
        arrays |= {name: Growing(None, (), name == "interval") for name in ("time", "interval") if name in variables}
        sums = json.loads(attributes["checksums"])
        attributes["checksums"] = json.dumps({name: value for name, value in sums.items() if name not in arrays})
        width = sum(8 * int(np.prod([*(() if a.batch is None else (a.batch,)), *a.inner])) for a in arrays.values())
        refuse_more_than_disk(self.path, self.rows * width, "save fewer rows with save_every=")
        reached = Reached(arrays, self.chunk, self.marks())
        with writing(self.path), placed(self.path, False) as beside:
            store = RunStore.made(beside, variables, attributes, reached, self.rows)
            self._write(store, piece, outcome)
            self.hold.take(beside)
        store.path, self.store = self.path, store

    def _write(self, store: RunStore, piece: Problem, outcome: Outcome) -> None:
        """The rows of a piece, and that they are there; the row after its last step only where the run ends there."""
        p, reached = self.problem, store.reached
        ended = p.batch is None and bool(outcome.status[0] != OK)
        last = ended or piece.steps == p.steps
        numbers, fields = cut(piece, outcome) if ended else (saved_steps(piece), outcome.fields)
        count = len(numbers) if last else next_row(p, piece.steps) - piece.first_row
        numbers, first = numbers[:count], piece.first_row + self.offset
        values = {entry["variable"]: fields[entry["name"]][:, :count] for entry in self.layout}
        if self.row0 is not None and piece.first_row == 0:
            lead = lambda a: np.asarray(a if p.batch is not None else np.asarray(a)[None])[:, None]
            rows0 = {entry["variable"]: lead(self.row0[entry["name"]]) for entry in self.layout}
            values = {name: np.concatenate([rows0[name], rows], axis=1) for name, rows in values.items()}
            numbers, first = np.concatenate([[-1.0], numbers]), 0
        if p.batch is None:
            values = {name: rows[0] for name, rows in values.items()}
        times = times_of(p, numbers, False)
        axes = {"time": times, "interval": times[: len(times) - last]}
        store.put(first, values | {name: axis for name, axis in axes.items() if name in reached.arrays})
        reached.steps, reached.rows, reached.ended = piece.steps, first + len(numbers), ended
        reached.record = outcome.record or ()
        reached.said = self._said(outcome, last)
        store.mark()

    def _said(self, outcome: Outcome, last: bool) -> dict[str, Any]:
        """What the attributes of the store say of the run so far."""
        p = self.problem
        good = (outcome.completed == p.steps) & last
        if last:
            warn_of_last_rows(p, outcome)
        text = messages(p, outcome, saved_steps(p), None) if last else [STOPPED] * len(good)
        outcome = replace(outcome, compile_seconds=self.compile_seconds, run_seconds=self.run_seconds)
        by_lane = text[0] if p.batch is None else {lane: one for lane, one in enumerate(text) if one}
        return {
            "ok": json.dumps(bool(np.all(good))),
            "message": json.dumps(by_lane),
            "stats": json.dumps(plain(stats_of(p, outcome, False), nonfinite=True)),
            "lanes_ok": [] if p.batch is None else good.tolist(),
        }

    def marks(self) -> dict[str, Any]:
        """Everything on which the bits of the rows depend, but how many there are."""
        s, p, case = self.settings, self.problem, self.case
        data, params = case.first
        try:
            installed = version("dirax")
        except PackageNotFoundError:
            installed = "unknown"
        return {
            "dirax": installed,
            "system": fingerprint.of_steps(s.system, p.equation, data, params, case.h, case.t0, s.project),
            "scheme": fingerprint.of_scheme(s.scheme),
            "initial data": fingerprint.of_value({name: np.asarray(a) for name, a in case.data.items()}),
            "params": fingerprint.of_value(jax.tree.leaves(case.params)),
            "step": float(case.h),
            "t0": float(case.t0),
            "save_every": self.save_every,
            "engine": fingerprint.ADDRESS.sub("", repr(s.engine)),
            "compensated": s.compensated,
            "max_iterations": s.max_iterations,
        }

    # ------------------------------------------------------------------------------------------ what comes out

    def _opened(self) -> Solution:
        """The Solution of the store, with what its file does not hold."""
        assert self.store is not None
        reached, s = self.store.reached, self.settings
        sol = stored_run(self.path)
        sol.system, sol.scheme, sol.equation = s.system, s.scheme, self.problem.equation
        sol._params, sol.initial = self.case.params, dict(self.case.data)
        sol.stats |= self.problem.equation.stages[0][0].review(sol.fields) if reached.steps == self.problem.steps else {}
        return sol


def next_row(p: Problem, step: int) -> int:
    """The number of the first row saved at a step or later."""
    return -(-step // p.save_every)
