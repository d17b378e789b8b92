"""Parts of a Solution: trajectories of a batch, rows, stretches of time."""

from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from dirax.program.user_functions import is_traced
from dirax.solution.each_row import each_row
from dirax.solution.trajectory import COUNTS, ROWS_BEFORE, Some, Trajectory
from dirax.text.representation import shortened

SLACK = 1e-6
"""Part of a step by which a saved time may lie outside of a stretch of time and still belong to it."""


def select(sol: Some, which: Any) -> Some:
    """A part of the solution, as a solution.

    - `sol[t0:t1]` with a float in it: the rows with t0 ≤ t ≤ t1, both ends included, of every trajectory. A bound that is
      left out is the end of the run. Saved times are compared to a millionth of a step.
    - `sol[i]`, `sol[i:j]`, `sol[[i, j]]`, `sol[sol.ok]` of a batch: the trajectory i, without batch axis and without the
      rows after its last good one; several trajectories, as a batch.
    - `sol[i:j]` of one trajectory: its rows from i to before j.

    Step fields keep the steps between the rows that are left, events are those between them. `initial` is the first row where
    that is another one.

    Raises `TypeError` for anything else (a row is `sol.q[i]`), `IndexError` for a trajectory that there is not, `ValueError`
    where no row is left and inside `jax.grad`, `jit` or `vmap` for stretches of time.
    """
    if isinstance(which, slice):
        bounds = (which.start, which.stop)
        if any(isinstance(bound, float | np.floating) for bound in bounds):
            return rows_of(sol, _between(sol, which))
        if any(bound is not None and not isinstance(bound, int | np.integer) for bound in bounds):
            raise TypeError(f"a slice of a solution takes two floats (times) or two whole numbers, but {which!r} was given.")
        if sol.batch is None:
            if which.step not in (None, 1):
                raise TypeError("rows of one trajectory are taken without a stride: simulate with save_every= for fewer rows.")
            return rows_of(sol, range(*which.indices(sol.rows)))
    if sol.batch is None:
        raise TypeError(
            f"this solution is one trajectory, but sol[{shortened(which)}] was asked for: sol[t0:t1] with floats is a stretch of "
            f"time, sol[i:j] are rows, and sol.{next(iter(sol.fields))}[i] is a row."
        )
    index = np.arange(sol.batch)[which if isinstance(which, slice) else _numbers(which, sol.batch)]
    return _trajectory(sol, int(index)) if np.ndim(index) == 0 else _trajectories(sol, index)


def _numbers(which: Any, batch: int) -> np.ndarray:
    """Numbers of trajectories, or which of them. Raises `TypeError` and `IndexError`."""
    chosen = np.asarray(which) if not isinstance(which, tuple) else np.empty((0, 0))
    if chosen.dtype.kind in "iu" and chosen.ndim <= 1:
        if np.any(outside := (chosen < -batch) | (chosen >= batch)):
            raise IndexError(f"the trajectories have the numbers 0 to {batch - 1}, but {chosen[outside].flat[0]} was asked for.")
    elif not (chosen.dtype == bool and chosen.shape == (batch,)):
        raise TypeError(
            f"sol[i], sol[i:j], sol[[i, j]] and sol[mask] with one truth value for each of the {batch} trajectories take some of "
            f"them, and sol[t0:t1] with floats a stretch of time, but sol[{shortened(which)}] was asked for."
        )
    return chosen


def count(sol: Trajectory) -> int:
    """The number of trajectories of a batch, of saved rows of one trajectory."""
    return sol.rows if sol.batch is None else sol.batch


def each(sol: Some) -> Iterator[Some]:
    """The trajectories of a batch, one after the other; `TypeError` for one trajectory."""
    if sol.batch is None:
        raise TypeError(
            "this solution is one trajectory, not a batch to go through: its rows are those of sol.t, sol.q and so on."
        )
    return (_trajectory(sol, lane) for lane in range(sol.batch))


def _between(sol: Trajectory, stretch: slice) -> range:
    if stretch.step is not None:
        raise TypeError("a stretch of time has no stride: simulate with save_every= for fewer rows.")
    if is_traced(sol.t):
        raise ValueError("times are traced here: choose rows by whole numbers, or outside of jax.grad, jit and vmap.")
    t, slack = np.asarray(sol.t), 0.0 if sol.has_own_times else SLACK * float(sol.step)
    if t.ndim > 1:
        raise ValueError("the trajectories of this batch have times of their own: take one of them first, sol[i][t0:t1].")
    first = 0 if stretch.start is None else int(np.searchsorted(t, stretch.start - slack, side="left"))
    last = len(t) if stretch.stop is None else int(np.searchsorted(t, stretch.stop + slack, side="right"))
    if first >= last:
        raise ValueError(f"no saved time lies in sol[{stretch.start}:{stretch.stop}]: they go from {t[0]:.6g} to {t[-1]:.6g}.")
    return range(first, last)


def rows_of(sol: Some, rows: range) -> Some:
    """Some rows, with the steps between them."""
    if not rows:
        raise ValueError(f"no row is left: the solution has rows 0 to {sol.rows - 1}.")
    lead = (slice(None),) * (sol.batch is not None)
    nodes = (*lead, slice(rows.start, rows.stop))
    steps = (*lead, slice(rows.start, rows.stop - 1))
    fields = {k: a[nodes if sol.field_info[k].place == "node" else steps] for k, a in sol.fields.items()}
    of_rows = lambda a: np.shape(a)[len(lead)] == sol.rows
    changes: dict[str, Any] = {"derived": {k: a[nodes if of_rows(a) else steps] for k, a in sol.derived.items()}}
    if rows.start > 0:
        row = {k: a[(*lead, rows.start)] for k, a in sol.fields.items() if sol.field_info[k].place == "node"}
        changes["initial"] = _data_at(row, None if sol.system is None else sol.system.quotient_form())
        changes["stats"] = sol.stats | {ROWS_BEFORE: sol.stats.get(ROWS_BEFORE, 0) + rows.start}
    part = sol.replace(t=sol.axis[rows.start : rows.stop], fields=fields, **changes)
    part.events, part.impacts = (_between_rows(sol, found, rows) for found in (sol.events, sol.impacts))
    return part


def _data_at(row: dict[str, Any], quotient: Any) -> dict[str, Any]:
    """The initial data of a run that begins at a row, those on Q for a system on the quotient of it."""
    whole = row if quotient is None else each_row({name: row[name] for name in quotient.own_fields}, quotient.unreduced_row)
    return {name: whole[name] for name in (("q", "p") if "q" in whole else ("x",)) if name in whole}


def _between_rows(sol: Trajectory, found: Any, rows: range) -> Any:
    """Those of some events between these rows; at the ends of the run, all that are there."""
    if found is None or is_traced(found.t, sol.t):
        return found
    times, t, lanes = sol.times, found.t, found.lane
    inside = (rows.start == 0) | (t >= times[lanes, rows.start])
    return found[inside & ((rows.stop >= sol.rows) | (t <= times[lanes, rows.stop - 1]))]


def _trajectories(sol: Some, lanes: Any) -> Some:
    """Some trajectories of a batch, as a batch or without its axis."""
    of_batch = lambda a: a[lanes] if np.ndim(a) == 2 else a
    counts = None if sol.counts is None else {name: each[lanes] for name, each in sol.counts.items()}
    part = sol.replace(
        stats={name: value for name, value in sol.stats.items() if name not in COUNTS} | totals(counts or {}),
        fields={k: a[lanes] for k, a in sol.fields.items()},
        derived={k: a[lanes] for k, a in sol.derived.items()},
        ok=np.asarray(sol.ok)[lanes] if not is_traced(sol.ok) else sol.ok[lanes],
        message=[sol.message[lane] for lane in np.atleast_1d(lanes)] if sol.message else sol.message,
        params=jax.tree.map(lambda leaf: leaf[lanes], sol.given_params) if sol.batch_params else sol.given_params,
        initial={k: of_batch(a) for k, a in sol.initial.items()},
    )
    part.events = None if sol.events is None else sol.events.of_lanes(lanes)
    part.impacts = None if sol.impacts is None else sol.impacts.of_lanes(lanes)
    part.counts = counts if counts is not None and part.batch is not None else None
    return part


def totals(counts: dict[str, Any]) -> dict[str, Any]:
    """Of all trajectories together, what `stats` say."""
    return {name: COUNTS[name](each).item() for name, each in counts.items()}


def _trajectory(sol: Some, lane: int) -> Some:
    """One trajectory of a batch, which ends at its last good row as that of a single run does."""
    part = _trajectories(sol, lane)
    part.batch_params = False
    if is_traced(part.ok, part.fields):
        return part
    part.ok, part.message = bool(part.ok), part.message[0] if part.message else ""
    nodes = [a.reshape(len(a), -1) for k, a in part.fields.items() if part.field_info[k].place == "node"]
    good = np.flatnonzero(~np.all(np.isnan(np.concatenate(nodes, axis=1)), axis=1))
    if not len(good) or good[-1] == part.rows - 1:
        return part
    ended = rows_of(part, range(int(good[-1]) + 1))
    ended.events, ended.impacts = part.events, part.impacts  # one may have ended it
    return ended
