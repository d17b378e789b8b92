"""Runs with impacts: the longest flight between two of them, whose steps are those of the scheme alone."""

import numpy as np

from dirax.diagnostics.report import NOT_CHECKED, Line
from dirax.solution.solution import Solution


def longest_flight(sol: Solution) -> tuple[Solution, Line | None]:
    """The rows of the longest flight of any trajectory, with a line that says so; the solution itself without impacts.

    It begins a step after the row that a divided step leads to, whose momentum and multipliers are those of both steps.
    """
    if sol.impacts is None or not len(sol.impacts) or sol.save_every != 1:
        return sol, None
    hits, best = sol.impacts, (0, 0, 0)
    for lane in range(sol.batch or 1):
        own = sol if sol.batch is None else sol[lane]
        ends = np.searchsorted(sol.times[lane], hits.t[hits.lane == lane], side="right")  # the first rows after the impacts
        stops = np.concatenate([ends, [own.rows]])
        starts = np.concatenate([[0], np.minimum(ends + 1, stops[1:] - 1)])
        longest = int(np.argmax(stops - starts))
        best = max(best, (int((stops - starts)[longest]), lane, int(starts[longest])))
    count, lane, start = best
    part = (sol if sol.batch is None else sol[lane])[start : start + count]
    about = (
        f"walls divide {len(hits)} steps, in which the structure is another one; what follows of steps is measured in the "
        f"longest flight, from t = {float(part.t[0]):.6g} to {float(part.t[-1]):.6g}"
    )
    return part, Line("impacts", float(len(hits)), None, NOT_CHECKED, about)
