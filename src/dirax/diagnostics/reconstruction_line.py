"""Motions that were reconstructed from reduced ones: the fields that are made of rows of these, made once more."""

import math

import numpy as np

from dirax.diagnostics.report import Line
from dirax.diagnostics.verdicts import judged, of_lane, roundoff_limit, rows_apart
from dirax.solution.solution import Solution


def reconstruction(sol: Solution, tolerance: float | None) -> Line | None:
    """The line: how far the fields are from what is made of the reduced rows, relative to the largest number of each; None for
    other runs, and those whose steps make these fields."""
    if sol.lifted is None:
        return None
    before, lanes = sol.lifted.before, sol.batch or 1
    nodes = {field: np.asarray(a) for field, a in before.fields.items() if before.field_info[field].place == "node"}
    made = sol.lifted.at(nodes, (sol.rows,) if sol.batch is None else (sol.batch, sol.rows))
    expected = {field: a for field, a in before.fields.items() if field in sol.fields} | made
    off, where = np.zeros(lanes), ""
    for field, values in expected.items():
        width = math.prod(sol.field_info[field].shape)
        found, wanted = (np.asarray(a).reshape(lanes, -1, width) for a in (sol.fields[field], values))
        apart = rows_apart(found, wanted)
        lane, row = np.unravel_index(int(np.argmax(apart)), apart.shape)
        if apart[lane, row] >= np.max(off, initial=0.0):
            where = f"{field} at t = {sol.time_of(int(row), int(lane)):.6g}{of_lane(sol, int(lane))}"
        off = np.maximum(off, np.max(apart, axis=1))
    text = f"{', '.join(made)} as they are made of the reduced rows; worst {where}"
    return judged(sol, "reconstruction", off, roundoff_limit(tolerance, 1), text)
