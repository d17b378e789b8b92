"""The size of the terms of a step's equations, to which a residual is relative."""

from functools import partial

import numpy as np

from dirax.diagnostics.replay import CannotReplay, Replay
from dirax.diagnostics.rows import LARGE, row_numbers
from dirax.diagnostics.verdicts import spread
from dirax.engines.contract import ALL_UNKNOWNS, FIXED_POINT
from dirax.program.graph import GraphTooLarge
from dirax.solution.solution import Solution
from dirax.solution.steps_again import begun_at

ROWS, ENTRIES = 4, (4096, 16)
"""Rows of each trajectory at which they are taken, at most, and of all trajectories, of small systems and of large ones."""


def residual_size(sol: Solution) -> float | None:
    """The size of the terms of the steps that leave saved rows, the largest, or of those that their unknowns are made of where
    the run measured the last changes of these; None where no step can be started from one, and for explicit schemes."""
    if sol.system is None or sol.equation is None or not any(stage.unknowns for stage, _ in sol.equation.stages):
        return None
    try:
        replay = Replay.of(sol)
        large = row_numbers(sol) > LARGE
        lanes = spread(sol.batch or 1, ENTRIES[large])
        rows = np.linspace(0, np.maximum(replay.ends[lanes], 0), max(1, min(ROWS, ENTRIES[large] // len(lanes))))
        rows, lanes = np.rint(rows).astype(int).ravel(), np.tile(lanes, len(rows))
        if large:
            states, guesses, t, _ = zip(*map(partial(begun_at, sol), lanes.tolist(), rows.tolist()), strict=True)
            at = np.stack(states), list(map(np.stack, zip(*guesses, strict=True))), np.array(t)
        else:
            begun = replay.resumed(lanes, rows)
            at = begun.states, begun.guesses, begun.t
        of_equations, of_unknowns = replay.steps.sizes(*at, float(sol.step), replay.params_of(lanes))
    except (CannotReplay, GraphTooLarge):
        return None
    iteration = sol.stats.get("iteration", "")
    kinds = [of_unknowns] if FIXED_POINT in iteration else [of_equations]
    if FIXED_POINT in iteration and ALL_UNKNOWNS in iteration:
        kinds = [of_unknowns, of_equations]
    return max(float(np.max(sizes, where=np.isfinite(sizes), initial=0.0)) for sizes in kinds) or None
