"""Rows of a large system once more, each by the engine of the run from the row before it: a sample, of which all is compared."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.diagnostics.report import NOT_CHECKED, Line
from dirax.diagnostics.verdicts import judged, of_lane, roundoff_limit, spread
from dirax.engines.contract import Problem
from dirax.engines.policy import engine_of
from dirax.solution.solution import Solution
from dirax.solution.steps_again import begun

ROWS = 6
"""Rows that are taken again."""

DISTURBANCE, OFTEN = 2.0**-30, 2
"""By how much, relatively, and how often all numbers of a state are changed, to see how far rounding moves what comes out."""


def replayed_of_many(sol: Solution, name: str, tolerance: float | None) -> Line:
    """The line: the difference of a saved number from what it should be, relative to how far it moves where the row before moves,
    and no less than the median of its field."""
    first = int("q0" in sol.initial)
    if sol.has_own_times or sol.impacts is not None or "engine" not in sol.stats:
        return Line(name, None, None, NOT_CHECKED, "of a large system, only runs of equal steps are taken again")
    rows, lanes = first + spread(sol.rows - 1 - first, ROWS), spread(sol.batch or 1, 2)
    engine, worst, where, off = engine_of(sol.stats["engine"]), np.zeros(sol.batch or 1), "", 0.0
    rng = np.random.default_rng(0)
    for lane in lanes.tolist():
        lead = () if sol.batch is None else (lane,)
        params = jax.tree.map(lambda leaf, at=lane: leaf[at], sol.params) if sol.batch_params else sol.params
        for row in rows.tolist():
            read = lambda at, lead=lead: {k: np.asarray(sol.fields[k][(*lead, at)]) for k in sol.fields}
            there, after = read(row), {k: np.asarray(sol.fields[k][(*lead, row + 1)]) for k in _nodes(sol)}
            if not all(np.all(np.isfinite(a)) for a in after.values()):
                continue
            t = float(sol.axis[row])
            state, guess = begun(sol.equation, sol.system, {k: jnp.asarray(a) for k, a in there.items()}, t, sol.step, params)
            span = round((float(sol.axis[row + 1]) - t) / float(sol.step))
            problem = Problem(
                sol.equation, np.asarray(state), tuple(map(np.asarray, guess)), float(sol.step), t, span, span, params=params
            )
            saved = after | {k: there[k] for k in sol.fields if k not in after}
            again = _taken(engine, problem)
            if again is None:
                return Line(name, None, None, NOT_CHECKED, f"the step from t = {t:.6g} has no solution from its saved row")
            moved = {k: np.zeros_like(a) for k, a in again.items()}
            for _ in range(OFTEN):
                signs = rng.choice([-1.0, 1.0], problem.state.shape)
                other = _taken(engine, problem.with_numbers(state=problem.state * (1.0 + DISTURBANCE * signs))) or again
                moved = {k: np.maximum(a, np.abs(other[k] - again[k]) / DISTURBANCE) for k, a in moved.items()}
            for k, a in again.items():
                if not a.size or sol.field_info[k].chosen:
                    continue
                scale = np.maximum(np.maximum(moved[k], np.median(moved[k])), np.finfo(float).tiny)
                ratio = np.abs(saved[k] - a) / scale
                at = np.unravel_index(int(np.argmax(ratio)), ratio.shape)
                if ratio[at] >= worst[lane]:
                    worst[lane], off = ratio[at], abs(float(saved[k][at] - a[at]))
                    where = f"{k}{list(map(int, at))} at t = {t:.6g}{of_lane(sol, lane)}"
    text = f"{len(rows) * len(lanes)} of {(sol.rows - 1 - first) * (sol.batch or 1)} rows, each by the engine from the one before"
    return judged(sol, name, worst, roundoff_limit(tolerance, 1), f"{text}; worst {where}, off by {off:.2g}")


def _nodes(sol: Solution) -> list[str]:
    return [name for name, info in sol.field_info.items() if info.place == "node"]


def _taken(engine: Any, problem: Problem) -> dict[str, np.ndarray] | None:
    """What the next row, and the step to it, should hold; None where it has no solution."""
    out = engine.run(problem)
    if int(out.completed[0]) < problem.steps:
        return None
    return {k: np.asarray(out.closing[k][0] if problem.is_node(k) else a[0, 0]) for k, a in out.fields.items()}
