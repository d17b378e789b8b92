"""The line of `dx.verify` on every saved number: each row is what the step from the row before it makes of that."""

from dataclasses import replace

import numpy as np

from dirax.diagnostics.flights import longest_flight
from dirax.diagnostics.other_solutions import OtherSolutions
from dirax.diagnostics.replay import CannotReplay, Replay
from dirax.diagnostics.replay_comparison import DISTURBANCE, Comparison, neighbours, ratio_to
from dirax.diagnostics.replay_of_many import replayed_of_many
from dirax.diagnostics.report import NOT_CHECKED, Line
from dirax.diagnostics.rows import LARGE, row_numbers
from dirax.diagnostics.verdicts import judged, of_lane, roundoff_limit, spread
from dirax.solution.solution import Solution

NAME = "steps replayed"

SMALL = 2.0**-47
"""Others, hardly above it: many steps make of the larger ones all that a motion can differ by before they do so of rounding."""

SAMPLED = 48
"""Steps of a run at which that is seen, besides those in doubt."""


def replayed(sol: Solution, tolerance: float | None) -> Line:
    """The line: the difference of a saved number from what it should be, relative to its terms, the largest of all."""
    if row_numbers(sol) > LARGE and sol.system is not None and sol.equation is not None and sol.rows > 2:
        return replayed_of_many(longest_flight(sol)[0], NAME, tolerance)
    try:
        replay = Replay.of(sol)
        if replay.too_long:
            return replayed_of_many(longest_flight(sol)[0], NAME, tolerance)
        at = replay.begun(*replay.chosen())
    except CannotReplay as reason:
        return Line(NAME, None, None, NOT_CHECKED, str(reason))
    limit = roundoff_limit(tolerance, 1)
    found = Comparison(replay, at)
    if np.all(found.next < 0):
        return Line(NAME, None, None, NOT_CHECKED, "walls divide every step, or all of those that were chosen")
    ratio = _ratios(found, limit)
    entry, number = np.unravel_index(int(np.argmax(ratio)), ratio.shape)
    lane, row = int(at.lanes[entry]), int(at.rows[entry])
    where = f"{found.name(int(number))} at t = {sol.time_of(row, lane):.6g}{of_lane(sol, lane)}"
    per_trajectory = np.zeros(sol.batch or 1)
    np.maximum.at(per_trajectory, at.lanes, np.max(ratio, axis=1))
    return judged(sol, NAME, per_trajectory, limit, f"{found.told()}; worst {where}, off by {found.missed[entry, number]:.2g}")


def moved_numbers(sol: Solution, *names: str) -> list[np.ndarray]:
    """How far the numbers (…) of saved fields move in a typical step, in units of what every operation is off; 0 where steps
    cannot be taken again."""
    shapes = [sol.field_info[name].shape for name in names]
    try:
        replay = Replay.of(sol)
        lanes, rows = replay.chosen()
        some = _sampled(neighbours(lanes, rows, sol.rows)[0])
        at = replay.begun(lanes[some], rows[some])
        found = Comparison(replay, replace(at, steps=np.ones_like(at.steps)))
    except CannotReplay:
        return [np.zeros(shape) for shape in shapes]
    usual, places = found.usual(np.arange(len(some))), [(found.starts[name], found.sizes[name]) for name in names]
    return [usual[first : first + size].reshape(shape) for (first, size), shape in zip(places, shapes, strict=True)]


def _sampled(after: np.ndarray) -> np.ndarray:
    """The entries, of which a row follows, that tell how far numbers move in a typical one."""
    several = np.flatnonzero(after >= 0)
    return several[spread(len(several), SAMPLED)]


def _ratios(found: Comparison, limit: float) -> np.ndarray:
    """What is missed, relative to the terms of each number: those of a typical row, and in a row in doubt its own."""
    usual = found.usual(_sampled(found.next))
    ratio = found.ratio(usual)
    doubted = found.worst(ratio, limit)
    if not len(doubted):
        return ratio
    OtherSolutions(found, usual, limit).look_for(doubted)
    ratio = found.ratio(usual)
    doubted = found.worst(ratio, limit)
    if len(doubted):
        before = found.previous[doubted]
        for size in (DISTURBANCE, SMALL):
            said_before = np.where((before >= 0)[:, None], found.scales_at(np.maximum(before, 0), size)[1], 0.0)
            usual = np.maximum(usual, np.maximum(found.scales_at(doubted, size)[0], said_before))
        ratio[doubted] = ratio_to(found.missed[doubted], usual)
    return ratio
