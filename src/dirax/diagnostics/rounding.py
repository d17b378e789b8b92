"""How far rounding moves a judged number, where it misses its tolerance: the sizes of terms do not show what cancels inside
of them, nor what a system of equations makes of it."""

import equinox as eqx
import jax
import numpy as np

from dirax.diagnostics.rows import CHUNK, over_rows
from dirax.program.evaluation.noise import Noise
from dirax.solution.solution import Solution

DISTURBANCE = 2.0**-44
"""What every operation is off: 256 roundings, and less than what changes the rank of one-forms."""

OFTEN = 4
"""Times that a row is disturbed."""


def beyond_rounding(values: np.ndarray, limit: float, function: eqx.Partial, sol: Solution, items: tuple) -> np.ndarray:
    """The values (B, rows, parts) that `over_rows` gives of `function`, relative to sizes; where some are above the limit, those
    at the worst rows relative to how far rounding moves them, if that is more."""
    most = np.max(values, axis=(0, 2), initial=0.0)
    if not np.any(most > limit):
        return values
    rows = np.argsort(-most)[: max(1, CHUNK // len(values))]  # in an array for which the function is compiled already
    some = jax.tree.map(lambda a: np.take(a, rows, axis=int(sol.batch is not None)), items)
    judged = values.copy()
    judged[:, rows] /= np.maximum(np.max(np.abs(moved_by_rounding(values[:, rows], function, sol, some)), axis=0), 1.0)
    return judged


def moved_by_rounding(values: np.ndarray, function: eqx.Partial, sol: Solution, items: tuple) -> np.ndarray:
    """By how much rounding moves the values of `function` at the items, OFTEN times at random (OFTEN, B, rows, …), in units of
    what an operation is off; 0 where one is not finite."""
    many = np.stack([over_rows(function, sol, items, noise=Noise(DISTURBANCE, seed)) for seed in range(OFTEN)])
    with np.errstate(invalid="ignore"):
        return np.nan_to_num((many - values) / DISTURBANCE, nan=0.0, posinf=0.0, neginf=0.0)
