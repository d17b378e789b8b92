"""tolerance= in place of step=: the step whose error over the first stretch of a run is the one that was asked for."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from dirax.run.settings import Settings
from dirax.run.validate import Case
from dirax.solution.solution import Solution

STRETCH = 8
"""Steps of the stretch over which the error is estimated: against twice as many of half the length."""

FIRST = 1e-3
"""The step that is tried first, in the user's unit of time: others follow from its error."""

ROOM = 4.0
"""The error may be so many times smaller than was asked for."""

SMALLEST, LARGEST = 1e-12, 1e-1
"""The tolerances between which there is something to estimate: above rounding, and below the motion itself."""

TRIALS = 60


def tolerable(tolerance: Any) -> float:
    """The tolerance. Raises `ValueError` for anything that is no number between SMALLEST and LARGEST."""
    number = isinstance(tolerance, int | float | np.number) and not isinstance(tolerance, bool)
    if not number or not SMALLEST <= tolerance <= LARGEST:
        raise ValueError(
            f"tolerance must be a number from {SMALLEST:g}, above rounding, to {LARGEST:g}, relative to the size of the motion, "
            f"but {tolerance!r:.80} was given."
        )
    return float(tolerance)


def step_for(run: Callable[..., Solution], settings: Settings, case: Case, tolerance: float) -> tuple[float, dict[str, Any]]:
    """The step of a case, and what is said of it in `stats`; `run(settings, case, steps, save_every, progress)` runs it.

    Raises `ValueError` for runs that JAX traces, that start from two points or have steps of lengths of their own, and where no
    step has this error: at rest, for a scheme that has none on the motion, below rounding.
    """
    if case.traced or case.two_points:
        what = "JAX traces its values" if case.traced else "q0= and q1= belong to one step"
        raise ValueError(f"tolerance= finds a step by running, which it cannot where {what}: give step=.")
    plain, trials = replace(settings, events=(), to=None), 0

    def error(h: float) -> float:
        """The largest difference of a row after steps of h from that after pairs of half the length, relative to the largest
        entry of each field over the stretch; infinite where a step fails."""
        nonlocal trials
        trials += 1
        coarse = run(plain, replace(case, h=h), STRETCH, 1, False)
        if coarse.has_own_times:
            raise ValueError(
                "tolerance= finds one step for the whole run, and variable steps have lengths of their own: give step=."
            )
        fine = run(plain, replace(case, h=h / 2.0), 2 * STRETCH, 2, False)
        if not (np.all(coarse.ok) and np.all(fine.ok)):
            return math.inf
        worst = 0.0
        for name in ("q", "x", "p"):
            if name in coarse.fields:
                a, b = np.asarray(coarse.fields[name]), np.asarray(fine.fields[name])
                size = np.max(np.abs(b), axis=(-2, -1))
                apart = np.max(np.abs(a - b), axis=(-2, -1))
                worst = max(worst, float(np.max(np.divide(apart, size, out=np.zeros_like(apart), where=size > 0))))
        return worst

    h, good, bad = FIRST, 0.0, math.inf
    while trials < TRIALS:
        found = error(h)
        if tolerance / ROOM <= found <= tolerance:
            return h, {"tolerance": tolerance, "tolerance_error": found, "tolerance_trials": trials}
        if found <= tolerance:
            good = h
        else:
            bad = h
        # an error of a stretch is about h^(p+1), and p ≥ 1: towards the middle of where it may be, never past what is known
        factor = (0.5 * tolerance / found) ** 0.25 if 0.0 < found < math.inf else 0.1 if found else 10.0
        h *= min(max(factor, 0.1), 10.0)
        if not good < h < bad:
            h = math.sqrt(good * bad) if good else bad / 2.0
        if good and bad / good < 1.0 + 1e-6:
            break
    where = f"{good:.3g} and {bad:.3g}" if good and bad < math.inf else f"{good or bad:.3g}"
    raise ValueError(
        f"no step was found whose error over the first {STRETCH} steps is {tolerance:g} of the motion's size (the last "
        f"steps tried were {where}): the motion is at rest there, or the scheme has no error on it, or the tolerance is below "
        "rounding; give step=."
    )
