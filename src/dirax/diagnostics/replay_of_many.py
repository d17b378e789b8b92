"""Rows of a large system, or far apart, once more, each by the engine of the run from the row before it: a sample, of which all
is compared.

A row need not hold the whole state of a run: where it holds the mean momentum at a node, the force of the constraints there is a
share short. So what a step says of itself is compared in the step after it, which begins at what was computed.
"""

from typing import Any

import numpy as np

from dirax.diagnostics.replay import steps_before, times_of
from dirax.diagnostics.report import NOT_CHECKED, Line
from dirax.diagnostics.rows import row_numbers
from dirax.diagnostics.verdicts import judged, of_lane, roundoff_limit, spread
from dirax.engines.contract import Outcome, Problem
from dirax.engines.policy import engine_of
from dirax.numerics.tolerances import TINY
from dirax.solution.solution import Solution
from dirax.solution.steps_again import begun_at

CONSTRAINT = "constraint"
"""The field of what a step leaves of its constraints, which has a line of its own."""

ROUGHLY = 1e-12
"""Relative differences below this are roundoff."""

ROWS, MOST_NUMBERS = 6, 2**19
"""Rows that are taken again, unless all their steps have more numbers than this: then as many as have, and one at least."""

DISTURBANCES = 2.0**-30, 2.0**-51, 2.0**-51
"""By how much, relatively, all numbers of a state are changed, to see how far rounding moves what comes out: far above rounding,
and as little as rounding does, which shows what differences of rounded numbers, and very many steps, make of that."""


def replayed_of_many(sol: Solution, name: str, tolerance: float | None) -> Line:
    """The line: the difference of a saved number from what it should be, relative to how far it moves where the row before moves,
    no less than the median of its field, and no less than itself. Roundings of many steps add up."""
    first = int("q0" in sol.initial)
    count = sol.rows - 1 - first
    if sol.impacts is not None or "engine" not in sol.stats:
        why = "of large systems and of rows far apart, steps that walls divide are not taken again"
        return Line(name, None, None, NOT_CHECKED, why)
    numbers, times = steps_before(sol), np.abs(np.asarray(sol.axis) - times_of(sol)) / (np.max(np.abs(sol.axis)) + sol.step)
    most = max(1, min(ROWS, int(MOST_NUMBERS / row_numbers(sol) / sol.save_every)))
    rows, lanes, limit = first + spread(count, most), spread(sol.batch or 1, 2), roundoff_limit(tolerance, sol.save_every)
    nodes = [name for name, info in sol.field_info.items() if info.place == "node"]
    engine, worst, off, told = engine_of(sol.stats["engine"]), np.full(sol.batch or 1, np.max(times)), 0.0, False
    where, rng = f"t in row {int(np.argmax(times))}", np.random.default_rng(0)
    for lane in lanes.tolist():
        lead = () if sol.batch is None else (lane,)
        for row in rows.tolist():
            read = lambda name, row, lead=lead: np.asarray(sol.fields[name][(*lead, row)])
            if not all(np.all(np.isfinite(read(name, row + 1))) for name in nodes):
                continue
            (state, guess, t, params), last = begun_at(sol, lane, row), min(row + 2, sol.rows - 1)
            to_next, to_last = (int(numbers[at] - numbers[row]) for at in (row + 1, last))
            problem = Problem(sol.equation, state, guess, float(sol.step), t, to_last, to_next, params=params)
            found = _taken(engine, problem)
            if found is None:
                return Line(name, None, None, NOT_CHECKED, f"the step from t = {t:.6g} has no solution from its saved row")
            out, again = found
            end = begun_at(sol, lane, last, {k: out.closing[k][0] for k in nodes}, t + to_last * float(sol.step))[0]
            whole = _equal(end, out.last_state[0])
            moved = {k: np.zeros_like(a) for k, a in again.items()}
            for size in DISTURBANCES:
                signs = rng.choice([-1.0, 1.0], problem.state.shape)
                other = (_taken(engine, problem.with_numbers(state=problem.state * (1.0 + size * signs))) or found)[1]
                moved = {k: np.maximum(a, np.abs(other[k] - again[k]) / size) for k, a in moved.items()}
            for (k, after), a in again.items():
                if not a.size or k == CONSTRAINT or sol.field_info[k].chosen or not (after or whole):
                    continue
                scale = np.maximum(np.maximum(moved[k, after], np.median(moved[k, after])), np.maximum(np.abs(a), TINY))
                missed, told = np.abs(read(k, row + after) - a), told or np.min(limit * scale) < np.max(np.abs(a))
                at = np.unravel_index(int(np.argmax(missed / scale)), missed.shape)
                if missed[at] / scale[at] >= worst[lane]:
                    worst[lane], off = missed[at] / scale[at], missed[at]
                    where = f"{k}{list(map(int, at))} at t = {float(sol.axis[row + after]):.6g}{of_lane(sol, lane)}"
    if not told:
        why = f"in the {sol.save_every} steps from one row to the next, roundoff grows to the size of what is saved"
        return Line(name, None, None, NOT_CHECKED, why)
    text = f"{len(rows) * len(lanes)} of {count * (sol.batch or 1)} rows, each by the engine from the one before"
    text += f" by {sol.save_every} steps" if sol.save_every > 1 else ""
    return judged(sol, name, worst, limit, f"{text}; worst {where}, off by {off:.2g}")


def _equal(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether these are the same numbers, but for roundoff."""
    return np.allclose(one, other, rtol=ROUGHLY, atol=ROUGHLY * np.max(np.abs(other), initial=0.0))


def _taken(engine: Any, problem: Problem) -> tuple[Outcome, dict[tuple[str, int], np.ndarray]] | None:
    """A run, and what the row that it leaves should hold of the step there, and the next one, by the name of a field and 0 or 1;
    None where there is none. Of the fields of steps, the second is said where another row as far away was reached."""
    out = engine.run(problem)
    done, every = int(out.completed[0]), problem.save_every
    if done < every:
        return None
    of_steps = [k for k in out.fields if not problem.is_node(k)]
    said = {(k, i): np.asarray(out.fields[k][0, i]) for k in of_steps for i in range(1 + (done == 2 * every))}
    at_next = {k: out.closing[k][0] if done == every else out.fields[k][0, 1] for k in out.fields if problem.is_node(k)}
    return out, said | {(k, 1): np.asarray(a) for k, a in at_next.items()}
