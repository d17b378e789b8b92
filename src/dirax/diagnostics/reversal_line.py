"""The line of `dx.verify` on steps that are taken back: whether a step of −h returns to where the step of h came from."""

import numpy as np

from dirax.diagnostics.replay import CannotReplay, Replay
from dirax.diagnostics.replay_comparison import DISTURBANCE, OFTEN
from dirax.diagnostics.report import NOT_CHECKED, OK, Line
from dirax.diagnostics.verdicts import judged, of_lane, roundoff_limit, spread
from dirax.numerics.tolerances import SMALLEST
from dirax.program.evaluation.noise import Noise
from dirax.solution.solution import Solution

NAME = "steps taken back"

SAMPLED = 64
"""Rows of a run from which a step is taken and taken back."""


def taken_back(sol: Solution, tolerance: float | None) -> Line | None:
    """The largest difference of Φ_{−h}(Φ_h(x)) from x of any number of the state, relative to what rounding of every operation
    may do; None of steps that all have one length, where other lines say more. A scheme that does not say that it is
    self-adjoint is not blamed for not being it."""
    if not sol.has_own_times:
        return None
    try:
        replay = Replay.of(sol)
    except CannotReplay as reason:
        return Line(NAME, None, None, NOT_CHECKED, str(reason))
    lanes, rows = np.nonzero(np.arange(sol.rows)[None] < replay.ends[:, None])
    if "chart" in sol.fields:  # whoever takes a step back does not return to a chart that it left
        charts = np.asarray(sol.fields["chart"]).reshape(sol.batch or 1, sol.rows, -1)
        stays = np.all(charts[lanes, rows] == charts[lanes, rows + 1], axis=1)
        lanes, rows = lanes[stays], rows[stays]
    if not len(rows):
        return Line(NAME, None, None, NOT_CHECKED, "no step that stays in one chart was computed")
    some = spread(len(rows), SAMPLED)
    at, steps, h = replay.resumed(lanes[some], rows[some]), replay.steps, float(sol.step)
    guesses = steps.step(at.states, at.guesses, at.t, h, at.params).unknowns

    def back(noise: Noise | None) -> np.ndarray:
        there = steps.step(at.states, guesses, at.t, h, at.params, noise)
        made = steps.step(there.after, there.unknowns, at.t + h, -h, at.params, noise)
        return np.where((there.good & made.good)[:, None], made.after, np.nan)

    found = back(None)
    moved = np.max([np.abs(back(Noise(DISTURBANCE, seed)) - found) for seed in range(OFTEN)], axis=0) / DISTURBANCE
    ratio = np.abs(found - at.states) / np.maximum(moved, SMALLEST)
    ratio = np.where(np.abs(found - at.states) <= SMALLEST, 0.0, np.where(np.isfinite(ratio), ratio, np.inf))
    worst = int(np.argmax(np.max(ratio, axis=1)))
    per_trajectory = np.zeros(sol.batch or 1)
    np.maximum.at(per_trajectory, at.lanes, np.max(ratio, axis=1))
    lane, row = int(at.lanes[worst]), int(at.rows[worst])
    text = (
        f"Φ_(−h) after Φ_h, of {len(some)} steps, relative to its terms: the map of state, step density and time is reversible; "
        f"worst at t = {sol.time_of(row, lane):.6g}{of_lane(sol, lane)}"
    )
    line = judged(sol, NAME, per_trajectory, roundoff_limit(tolerance, 1), text)
    if line.verdict == OK:
        return line
    way = "for reversible steps compose it with its adjoint"
    try:
        if sol.scheme is not None and sol.scheme.adjoint(sol.system) == sol.scheme:
            return line
    except TypeError as none:
        way = str(none)
    return Line(NAME, line.value, None, NOT_CHECKED, f"the scheme is not self-adjoint: {way}")
