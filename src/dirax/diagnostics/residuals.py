"""The size of the terms of a step's equations, to which a residual is relative."""

import numpy as np

from dirax.diagnostics.replay import CannotReplay, Replay
from dirax.diagnostics.verdicts import spread
from dirax.engines.contract import ALL_UNKNOWNS, FIXED_POINT
from dirax.solution.solution import Solution

ROWS = 4
"""Rows of the first trajectory at which they are taken."""


def residual_size(sol: Solution) -> float | None:
    """The largest size of the terms of the first part of a step that leaves a saved row, or of those that its unknowns are made
    of where the run measured their last changes; None where no step can be started from one, and for explicit schemes."""
    if sol.system is None or sol.equation is None or not sol.equation.stages[0][0].unknowns:
        return None
    try:
        replay = Replay.of(sol)
        rows = spread(int(replay.ends[0]) + 1, ROWS)
        at = replay.resumed(np.zeros_like(rows), rows)
    except CannotReplay:
        return None
    of_equations, of_unknowns = replay.steps.sizes(at.states, at.guesses, at.t, float(sol.step), at.params)
    iteration = sol.stats.get("iteration", "")
    kinds = [of_unknowns] if FIXED_POINT in iteration else [of_equations]
    if FIXED_POINT in iteration and ALL_UNKNOWNS in iteration:
        kinds = [of_unknowns, of_equations]
    return max(float(np.max(sizes, where=np.isfinite(sizes), initial=0.0)) for sizes in kinds) or None
