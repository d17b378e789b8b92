"""Line of `dx.verify` on what a system presupposes all along its way, such as a matrix R that dissipates."""

import jax
import numpy as np

from dirax.diagnostics.report import VIOLATED, Line
from dirax.diagnostics.rows import LARGE
from dirax.diagnostics.verdicts import of_lane, spread
from dirax.solution.solution import Solution

ROWS = 64
"""Rows that are asked, of all trajectories together, evenly spread."""


def premise_line(sol: Solution) -> Line | None:
    """The first of the rows that are asked at which the premise of the system does not hold; None where it holds at all of them.
    Of large systems it is asked where a run begins alone."""
    fields = {k: np.asarray(a) for k, a in sol.fields.items() if sol.field_info[k].place == "node"}
    if sol.system is None or not sol.system.premise_everywhere or sum(a.shape[-1] for a in fields.values()) > LARGE:
        return None
    lanes = 1 if sol.batch is None else sol.batch
    for number in spread(lanes * sol.rows, ROWS).tolist():
        lane, row = divmod(number, sol.rows)
        at = row if sol.batch is None else (lane, row)
        data = {**{name: a[at] for name, a in fields.items()}, "t": np.asarray(sol.time_of(row, lane))}
        params = jax.tree.map(lambda leaf, lane=lane: leaf[lane], sol.given_params) if sol.batch_params else sol.given_params
        if not all(np.all(np.isfinite(a)) for a in data.values()):
            continue
        try:
            sol.system.check(data, params)
        except ValueError as refusal:
            words = str(refusal).replace(" at the initial point", "")
            return Line("premise", None, None, VIOLATED, f"at t = {sol.time_of(row, lane):.6g}{of_lane(sol, lane)}, {words}")
    return None
