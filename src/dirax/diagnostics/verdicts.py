"""How a measured value becomes a line with a verdict, and the places in a solution at which values are taken."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dirax.diagnostics.report import OK, VIOLATED, Line
from dirax.diagnostics.rows import LARGE, over_rows, row_numbers, sampled_rows
from dirax.numerics.tolerances import EPSILON, TINY
from dirax.solution.solution import Solution

ROUNDINGS = 32
"""Roundings, each of half a unit in the last place, that the equations of one step are allowed, and their safety factor."""

SAMPLED_ROWS = 64
"""Rows at which natural scales are taken, of small systems and few trajectories."""

SAMPLED_ENTRIES, SAMPLED_NUMBERS = 2**13, 2**17
"""Rows, each with one of its numbers changed, that are evaluated for a scale, and the numbers in them, unless four of each
trajectory are more."""

DISTURBANCE = 2.0**-26
"""By how much, relatively, a number is changed for a scale."""

KNOWN = ("t", "about")
"""What a row says besides its numbers."""

PROBES, MANY = 32, 100
"""Times that all numbers of a row are changed, in rows of more than so many."""


def where_reached(values: np.ndarray, items: dict[str, np.ndarray]) -> np.ndarray:
    """The values (B, rows, …), 0 at rows whose items (…, rows, …) were not reached, and infinite where finite ones give no
    finite value."""
    finite = [np.all(np.isfinite(a).reshape(*values.shape[:2], -1), axis=-1) for a in items.values()]
    reached = np.logical_and.reduce(finite).reshape(*values.shape[:2], *(1,) * (values.ndim - 2))
    return np.where(reached, np.where(np.isfinite(values), values, np.inf), 0.0)


def judged(sol: Solution, name: str, per_trajectory: np.ndarray, limit: float, text: str) -> Line:
    """The line of a quantity whose worst trajectory must not exceed the limit."""
    worst = float(np.max(per_trajectory))
    details = {"per_trajectory": per_trajectory.tolist()} if sol.batch is not None else {}
    return Line(name, worst, limit, OK if worst <= limit else VIOLATED, text, details)


def roundoff_limit(tolerance: float | None, growth: float) -> float:
    """The tolerance that the user gave, or what roundoff may add up to."""
    return ROUNDINGS * EPSILON * growth if tolerance is None else float(tolerance)


def rows_apart(found: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """How far apart rows (…, numbers) are, relative to the largest number of all that are wanted; infinite where one alone of two
    numbers is NaN."""
    size = np.max(np.abs(wanted), initial=0.0, where=np.isfinite(wanted)) or 1.0
    off = np.where((found == wanted) | (np.isnan(found) & np.isnan(wanted)), 0.0, np.abs(found - wanted) / size)
    return np.max(np.nan_to_num(off, nan=np.inf), axis=-1, initial=0.0)


def relative_changes(values: np.ndarray, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The largest change of values (B, rows, c) since the first row, (B,), and the same relative to a scale (B,)."""
    change = np.nanmax(np.abs(values - values[:, :1]), axis=(1, 2))
    return change, np.divide(change, scale, out=np.zeros_like(change), where=scale > 0)


def relative_to(missed: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """missed/sizes, 0 where nothing is missed, of things at rest too, whose terms are all zero."""
    return np.divide(missed, np.maximum(sizes, TINY), out=np.zeros_like(missed), where=missed != 0.0)


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


def sampled(sol: Solution, function: eqx.Partial) -> np.ndarray:
    """`function`(row, params) at a few rows, (B, rows, …)."""
    rows = spread(sol.rows, SAMPLED_ROWS)
    rows = np.intersect1d(rows, sampled_rows(sol, sol.rows))
    lead = (slice(None),) * int(sol.batch is not None)
    return over_rows(function, sol, ({k: np.asarray(a[(*lead, rows)]) for k, a in _nodes(sol).items()},))


def sampled_terms(sol: Solution, function: eqx.Partial) -> np.ndarray:
    """Σ |∂f/∂x_i| |x_i| of each entry of f = `function`(row, params) over the numbers x_i of a row, at a few rows (B, rows, …):
    what roundings of the rows do to f, in units of ε.

    By differences, which a scale is content with: f needs no derivative, and what is known of f at all rows is enough. In rows of
    many numbers all are changed at once, each up or down at random, PROBES times: the largest change of an entry that
    few numbers have to do with is that sum; of one that all have to do with, it is from derivatives.
    """
    nodes = _nodes(sol)
    if row_numbers(sol) > MANY:
        return _terms_of_many(sol, nodes, function)
    axis, count = int(sol.batch is not None), 1 + row_numbers(sol)
    most = min(SAMPLED_ENTRIES, SAMPLED_NUMBERS // count) // (count * (sol.batch or 1))
    rows = spread(sol.rows, min(SAMPLED_ROWS, max(4, most)))
    items, first = {}, 1
    for name, values in nodes.items():
        items[name] = many = np.repeat(np.take(values, rows, axis=axis), count, axis=axis).astype(float)
        if name in KNOWN:
            continue
        many = many.reshape(*many.shape[:axis], len(rows), count, math.prod(values.shape[axis + 1 :]))
        for i in range(many.shape[-1]):
            many[..., first + i, i] *= 1.0 + DISTURBANCE
        first += many.shape[-1]
        items[name] = many.reshape(*many.shape[:axis], len(rows) * count, *values.shape[axis + 1 :])
    found = over_rows(function, sol, (items,))
    found = found.reshape(len(found), len(rows), count, -1)
    return np.sum(np.abs(found[:, :, 1:] - found[:, :, :1]), axis=2) / DISTURBANCE


def _terms_of_many(sol: Solution, nodes: dict[str, Any], function: eqx.Partial) -> np.ndarray:
    few = min(SAMPLED_ROWS, max(4, SAMPLED_ENTRIES // (PROBES * row_numbers(sol))))
    rows, axis, rng = spread(sol.rows, few), int(sol.batch is not None), np.random.default_rng(0)
    plain = {k: np.asarray(a[(*(slice(None),) * axis, rows)], float) for k, a in nodes.items()}
    with_slope = eqx.Partial(_with_slope, function.func, *function.args)  # what is traced once, being made of the same
    whole = over_rows(with_slope, sol, (plain,))
    if whole.shape[2:] == (2,):
        return whole[..., 1:]
    found = np.zeros_like(whole)
    for _ in range(PROBES):
        changed = lambda a: a * (1.0 + DISTURBANCE * rng.choice([-1.0, 1.0], np.shape(a)))
        moved = {name: a if name in KNOWN else changed(a) for name, a in plain.items()}
        found = np.maximum(found, np.abs(over_rows(with_slope, sol, (moved,)) - whole) / DISTURBANCE)
    return found


def _with_slope(*of: Any):
    """The value of a function of other arguments, a row and params; of a single number also Σ |∂f/∂x_i| |x_i|."""
    *function, row, params = of
    function = eqx.Partial(*function)
    if math.prod(jax.eval_shape(function, row, params).shape) != 1:
        return jnp.ravel(function(row, params))
    known = {name: a for name, a in row.items() if name in KNOWN}
    x = {name: a for name, a in row.items() if name not in KNOWN}
    value, slope = jax.value_and_grad(lambda x: jnp.sum(function({**x, **known}, params)))(x)
    return jnp.stack([value, sum(jnp.sum(jnp.abs(slope[name] * x[name])) for name in x)])


def _nodes(sol: Solution) -> dict[str, Any]:
    return {k: a if row_numbers(sol) > LARGE else np.asarray(a) for k, a in sol.row_fields.items()}
