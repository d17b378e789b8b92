"""Rows of a large system once more, each by the engine of the run from the row before it: a sample, of which all is compared.

A row need not hold the whole state of a run: where it holds the mean momentum at a node, the force of the constraints there is a
share short. So what a step says of itself is compared in the step after it, which begins at what was computed.
"""

from typing import Any

import numpy as np

from dirax.diagnostics.report import NOT_CHECKED, Line
from dirax.diagnostics.verdicts import judged, of_lane, roundoff_limit, spread
from dirax.engines.contract import Problem
from dirax.engines.policy import engine_of
from dirax.solution.solution import Solution
from dirax.solution.steps_again import begun_at

CONSTRAINT = "constraint"
"""The field of what a step leaves of its constraints, which has a line of its own."""

ROUGHLY = 1e-12
"""Relative differences below this are roundoff."""

ROWS = 6
"""Rows that are taken again."""

DISTURBANCE, OFTEN = 2.0**-30, 2
"""By how much, relatively, and how often all numbers of a state are changed, to see how far rounding moves what comes out."""


def replayed_of_many(sol: Solution, name: str, tolerance: float | None) -> Line:
    """The line: the difference of a saved number from what it should be, relative to how far it moves where the row before moves,
    and no less than the median of its field."""
    first = int("q0" in sol.initial)
    count = sol.rows - 1 - first
    if sol.has_own_times or sol.impacts is not None or "engine" not in sol.stats:
        return Line(name, None, None, NOT_CHECKED, "of a large system, only runs of equal steps are taken again")
    rows, lanes = first + spread(count, ROWS), spread(sol.batch or 1, 2)
    nodes = [name for name, info in sol.field_info.items() if info.place == "node"]
    engine, worst, where, off = engine_of(sol.stats["engine"]), np.zeros(sol.batch or 1), "", 0.0
    rng = np.random.default_rng(0)
    for lane in lanes.tolist():
        lead = () if sol.batch is None else (lane,)
        for row in rows.tolist():
            read = lambda name, row, lead=lead: np.asarray(sol.fields[name][(*lead, row)])
            if not all(np.all(np.isfinite(read(name, row + 1))) for name in nodes):
                continue
            (state, guess, t, params), last = begun_at(sol, lane, row), min(row + 2, sol.rows - 1)
            to_next, to_last = (round((float(sol.axis[at]) - t) / float(sol.step)) for at in (row + 1, last))
            problem = Problem(
                sol.equation,
                np.asarray(state),
                tuple(map(np.asarray, guess)),
                float(sol.step),
                t,
                to_last,
                to_next,
                params=params,
            )
            again = _taken(engine, problem)
            if again is None:
                return Line(name, None, None, NOT_CHECKED, f"the step from t = {t:.6g} has no solution from its saved row")
            whole = all(_equal(again.pop((k, 0)), read(k, row)) for k in nodes)
            moved = {k: np.zeros_like(a) for k, a in again.items()}
            for _ in range(OFTEN):
                signs = rng.choice([-1.0, 1.0], problem.state.shape)
                other = _taken(engine, problem.with_numbers(state=problem.state * (1.0 + DISTURBANCE * signs))) or again
                moved = {k: np.maximum(a, np.abs(other[k] - again[k]) / DISTURBANCE) for k, a in moved.items()}
            for (k, after), a in again.items():
                if not a.size or k == CONSTRAINT or sol.field_info[k].chosen or not (after or whole):
                    continue
                scale = np.maximum(np.maximum(moved[k, after], np.median(moved[k, after])), np.finfo(float).tiny)
                missed = np.abs(read(k, row + after) - a)
                at = np.unravel_index(int(np.argmax(missed / scale)), missed.shape)
                if missed[at] / scale[at] >= worst[lane]:
                    worst[lane], off = missed[at] / scale[at], missed[at]
                    where = f"{k}{list(map(int, at))} at t = {float(sol.axis[row + after]):.6g}{of_lane(sol, lane)}"
    text = f"{len(rows) * len(lanes)} of {count * (sol.batch or 1)} rows, each by the engine from the one before"
    return judged(sol, name, worst, roundoff_limit(tolerance, 1), f"{text}; worst {where}, off by {off:.2g}")


def _equal(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether these are the same numbers, but for roundoff."""
    return np.allclose(one, other, rtol=ROUGHLY, atol=ROUGHLY * np.max(np.abs(other), initial=0.0))


def _taken(engine: Any, problem: Problem) -> dict[tuple[str, int], np.ndarray] | None:
    """What the row that a run leaves should hold, and the next one, by the name of a field and 0 or 1; None where there is none.
    Of the fields of steps, the second is said where another row as far away was reached."""
    out = engine.run(problem)
    done, every = int(out.completed[0]), problem.save_every
    if done < every:
        return None
    said = {
        (k, i): np.asarray(a[0, i]) for k, a in out.fields.items() for i in range(1 + (problem.is_node(k) or done == 2 * every))
    }
    return said | ({(k, 1): np.asarray(out.closing[k][0]) for k in out.fields if problem.is_node(k)} if done == every else {})
