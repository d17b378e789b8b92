"""Runs with impacts: the run once more, with its walls; and the longest flight between two impacts, whose steps are those of the
scheme alone."""

import numpy as np

from dirax.diagnostics.replay import steps_before
from dirax.diagnostics.report import NOT_CHECKED, OK, VIOLATED, Line
from dirax.diagnostics.verdicts import of_lane, rows_apart
from dirax.solution.events import Events
from dirax.solution.solution import Solution
from dirax.solution.trajectory import BESIDE_ROW

LONGEST = 2.0
"""Seconds that a run took which is run once more as a whole; of a longer one the first part."""

SAME = 1e-11
"""Relative difference in the first row that differs up to which it is roundoff, of another engine or machine: walls amplify it
from there on."""


def longest_flight(sol: Solution) -> tuple[Solution, Line | None]:
    """The rows of the longest flight of any trajectory, with a line that says so; the solution itself without impacts.

    It begins a step after the row that a divided step leads to, whose momentum and multipliers are those of both steps, and ends
    before a row at which an impact is.
    """
    if sol.impacts is None or not len(sol.impacts) or sol.save_every != 1:
        return sol, None
    hits, best, near = sol.impacts, (0, 0, 0), BESIDE_ROW * float(sol.step)
    for lane in range(sol.batch or 1):
        own = sol if sol.batch is None else sol[lane]
        t = hits.t[hits.lane == lane]
        stops = np.append(np.searchsorted(sol.times[lane], t - near, side="left"), own.rows)
        after = np.searchsorted(sol.times[lane], t + near, side="right")
        starts = np.append(0, np.minimum(after + 1, stops[1:] - 1))
        longest = int(np.argmax(stops - starts))
        best = max(best, (int((stops - starts)[longest]), lane, int(starts[longest])))
    count, lane, start = best
    part = (sol if sol.batch is None else sol[lane])[start : start + count]
    about = (
        f"walls divide {len(hits)} steps, in which the structure is another one; what follows of steps is measured in the "
        f"longest flight, from t = {float(part.t[0]):.6g} to {float(part.t[-1]):.6g}"
    )
    return part, Line("impacts", float(len(hits)), None, NOT_CHECKED, about)


def run_again(sol: Solution) -> Line | None:
    """The rows and impacts of the run once more, from its beginning and with its walls, each trajectory up to the first row that
    differs; None for a run that hits no wall."""
    name, hits = "run once more", sol.impacts
    if hits is None or not len(hits):
        return None
    if sol.again is None:
        about = "only what dx.simulate has returned knows its walls: verify that, before a part of it is taken or it is saved"
        return Line(name, None, None, NOT_CHECKED, about)
    steps, seconds, counts = int(sol.stats["steps"]), float(sol.stats["run_seconds"]), steps_before(sol).astype(int)
    part = steps if seconds <= LONGEST else max(1, int(steps * LONGEST / seconds))
    rows = np.flatnonzero(counts < part if part < steps else counts <= steps)  # a row is also made of the step that leaves it
    other, lanes = sol.again(part), sol.batch or 1
    differing, worst, where = [], 0.0, ""
    walls = np.union1d(hits.index, other.impacts.index)
    pairs = [(found, other.impacts) for found in (hits, sol.events) if found is not None]
    for lane in range(lanes):
        one, two = (run if run.batch is None else run[lane] for run in (sol, other))
        difference, field, row = _first_difference(one, two, rows, counts)
        until = sol.time_of(min(row, int(rows[-1]), one.rows - 1), lane)
        what = f"another {field} at t = {until:.6g}"
        off = max(_apart(*(_before(found, walls, lane, until) for found in pair)) for pair in pairs)
        if off > max(difference, SAME):
            difference, what = off, f"other impacts before t = {until:.6g}"
        if difference > 0.0:
            differing.append(lane)
        if difference > worst:
            worst, where = difference, f"{what}{of_lane(sol, lane)}"
    whole = "all rows and impacts" if part == steps else f"the rows and impacts up to t = {sol.time_of(int(rows[-1])):.6g}"
    if not differing:
        return Line(name, 0.0, SAME, OK, f"from its beginning, with its walls: {whole} are the same, bit by bit")
    if worst <= SAME:
        about = f"from its beginning, with its walls: {whole} but for roundoff, which gives {where}"
        return Line(name, worst, SAME, OK, about)
    return Line(name, worst, SAME, VIOLATED, f"from its beginning, with its walls, it has {where}")


def _first_difference(one: Solution, two: Solution, rows: np.ndarray, counts: np.ndarray) -> tuple[float, str, int]:
    """How far apart two trajectories are in the first of the rows where they are, relative to all of them, in which field, and
    that row."""
    apart = np.zeros(len(rows))
    fields = np.full(len(rows), "", object)
    for name, values in one.fields.items():
        node = one.field_info[name].place == "node"
        mine, theirs = np.asarray(values), np.asarray(two.fields[name])
        some = rows[(rows < len(mine)) & (counts[rows] < len(theirs))]
        some = some if node or not len(some) else some[some < rows[-1]]
        a, b = (x.reshape(len(x), -1) for x in (mine[some], theirs[counts[some]]))
        off = rows_apart(a, b)
        place = np.searchsorted(rows, some)
        larger = off > apart[place]
        apart[place[larger]], fields[place[larger]] = off[larger], name
    if not np.any(apart):
        return 0.0, "", int(rows[-1]) + 1
    first = int(np.flatnonzero(apart)[0])
    return float(apart[first]), fields[first], int(rows[first])


def _before(found: Events, walls: np.ndarray, lane: int, until: float) -> Events:
    """The impacts of a trajectory up to a time."""
    return found[np.isin(found.index, walls) & (found.lane == lane) & (found.t < until)]


def _apart(one: Events, two: Events) -> float:
    """How far apart impacts are, relative to all of them; infinite where they are not the same ones."""
    if not np.array_equal(one.index, two.index):
        return np.inf
    pairs = [(one.t, two.t), *((values, two.fields[name]) for name, values in one.fields.items())]
    sizes = (np.max(np.abs(b), initial=0.0) or 1.0 for _, b in pairs)
    return max(float(np.max(np.abs(a - b), initial=0.0)) / size for (a, b), size in zip(pairs, sizes, strict=True))
