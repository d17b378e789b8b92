"""How a measured value becomes a line with a verdict, and the places in a solution at which values are taken."""

from collections.abc import Callable

import equinox as eqx
import numpy as np

from dirax.diagnostics.report import OK, VIOLATED, Line
from dirax.diagnostics.rows import over_rows, times_at
from dirax.numerics.tolerances import EPSILON
from dirax.solution.solution import Solution

ROUNDINGS = 32
"""Roundings, each of half a unit in the last place, that the equations of one step are allowed, and their safety factor."""

SAMPLED_ROWS = 64
"""Rows at which natural scales are taken."""


def where_reached(values: np.ndarray, items: dict[str, np.ndarray]) -> np.ndarray:
    """The values (B, rows, …), 0 at rows whose items (…, rows, …) were not reached, and infinite where finite ones give no
    finite value."""
    finite = [np.all(np.isfinite(a).reshape(*values.shape[:2], -1), axis=-1) for a in items.values()]
    reached = np.logical_and.reduce(finite)[..., None]
    return np.where(reached, np.where(np.isfinite(values), values, np.inf), 0.0)


def judged(sol: Solution, name: str, per_trajectory: np.ndarray, limit: float, text: str) -> Line:
    """The line of a quantity whose worst trajectory must not exceed the limit."""
    worst = float(np.max(per_trajectory))
    details = {"per_trajectory": per_trajectory.tolist()} if sol.batch is not None else {}
    return Line(name, worst, limit, OK if worst <= limit else VIOLATED, text, details)


def roundoff_limit(tolerance: float | None, growth: float) -> float:
    """The tolerance that the user gave, or what roundoff may add up to."""
    return ROUNDINGS * EPSILON * growth if tolerance is None else float(tolerance)


def relative_changes(values: np.ndarray, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The largest change of values (B, rows, c) since the first row, (B,), and the same relative to a scale (B,)."""
    change = np.nanmax(np.abs(values - values[:, :1]), axis=(1, 2))
    return change, np.divide(change, scale, out=np.zeros_like(change), where=scale > 0)


def worst_place(values: np.ndarray) -> tuple[int, int]:
    """(trajectory, row) of the largest value; NaN, in rows that were not reached, does not count."""
    lane, row = np.unravel_index(int(np.argmax(np.where(np.isfinite(values), values, -1.0))), values.shape)
    return int(lane), int(row)


def spread(count: int, most: int) -> np.ndarray:
    """At most `most` different whole numbers from 0 to count − 1, evenly spread."""
    return np.unique(np.linspace(0, count - 1, most).astype(int)) if count > 0 else np.zeros(0, int)


def of_lane(sol: Solution, lane: int) -> str:
    """Which trajectory, in words; empty for a single one."""
    return "" if sol.batch is None else f" (trajectory {lane})"


def steps_of(sol: Solution) -> int:
    """The number of steps of the run, at least 1."""
    return max(1, round(float(sol.axis[-1] - sol.axis[0]) / float(sol.step)))


def sampled_terms(sol: Solution, terms: Callable) -> np.ndarray:
    """terms(system, row, params) at a few rows."""
    rows = spread(sol.rows, SAMPLED_ROWS)
    lead = (slice(None),) * (sol.batch is not None)
    nodes = {k: np.asarray(a)[(*lead, rows)] for k, a in sol.fields.items() if sol.field_info[k].place == "node"}
    return over_rows(eqx.Partial(terms, sol.system), sol, (times_at(sol, rows), nodes))
