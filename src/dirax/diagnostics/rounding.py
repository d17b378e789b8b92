"""How far rounding moves a judged number, where it misses its tolerance: the sizes of terms do not show what cancels inside
of them, nor what a system of equations makes of it."""

from collections.abc import Callable

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


def with_rounding(terms: np.ndarray, most: np.ndarray, function: eqx.Partial, sol: Solution, items: tuple) -> np.ndarray:
    """The terms (B, rows, 2, numbers) that `over_rows` gives of `function`, what is missed and sizes, with sizes no less than how
    far rounding moves what is missed, at the rows at which `most` (rows,) is largest."""
    return _no_less(terms, most, sol, items, lambda some, noise: over_rows(function, sol, some, noise=noise))


def with_moved_rows(
    terms: np.ndarray, most: np.ndarray, function: eqx.Partial, sol: Solution, items: tuple, moved: dict[str, np.ndarray]
) -> np.ndarray:
    """The same, by how far the rows themselves have `moved`, in units of what an operation is off: fields (…) by name."""

    def again(some: tuple, noise: Noise) -> np.ndarray:
        off = lambda name, a: a + moved[name] * (noise.off(np.ones_like(a)) - 1.0) if name in moved else a
        return over_rows(function, sol, ({name: off(name, np.asarray(a)) for name, a in some[0].items()}, *some[1:]))

    return _no_less(terms, most, sol, items, again)


def _no_less(
    terms: np.ndarray, most: np.ndarray, sol: Solution, items: tuple, again: Callable[[tuple, Noise], np.ndarray]
) -> np.ndarray:
    rows = np.argsort(-most)[: max(1, CHUNK // len(terms))]  # in an array for which the function is compiled already
    some = jax.tree.map(lambda a: np.take(a, rows, axis=int(sol.batch is not None)), items)
    moved = np.max(np.abs(differences_by_rounding(terms[:, rows], lambda noise: again(some, noise))), axis=0)[:, :, 0]
    found = terms.copy()
    found[:, rows, 1] = np.maximum(terms[:, rows, 1], moved)
    return found


def moved_by_rounding(values: np.ndarray, function: eqx.Partial, sol: Solution, items: tuple) -> np.ndarray:
    """By how much rounding moves the values of `function` at the items, OFTEN times at random (OFTEN, B, rows, …), in units of
    what an operation is off; 0 where one is not finite."""
    return differences_by_rounding(values, lambda noise: over_rows(function, sol, items, noise=noise))


def differences_by_rounding(values: np.ndarray, again: Callable[[Noise], np.ndarray]) -> np.ndarray:
    """The same of values that are computed `again` with noise."""
    many = np.stack([again(Noise(DISTURBANCE, seed)) for seed in range(OFTEN)])
    with np.errstate(invalid="ignore"):
        return np.nan_to_num((many - values) / DISTURBANCE, nan=0.0, posinf=0.0, neginf=0.0)
