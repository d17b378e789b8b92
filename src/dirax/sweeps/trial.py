"""A short run of some points before a sweep: the shapes of what is kept, how `case` and `keep` are to be called, the engine,
and the time that a trajectory takes."""

import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from dirax.engines.threads import at_most
from dirax.run.simulate import simulate
from dirax.solution.fingerprint import of_steps
from dirax.solution.solution import Solution
from dirax.sweeps.axes import Axes, described
from dirax.sweeps.case import Case, Values
from dirax.sweeps.keep import Keep

POINTS = 64
"""Trajectories of the trial, spread over the points."""

SINGLE = 6
"""Points at which `case` is compared with calls for single points, and about as many for `keep`."""

SECONDS = 0.03
"""Least time of the trial's last run, from which the time of a step is known."""

CHECKED_SECONDS = 1.0
"""How long points are checked before the first task."""

CHECKED = 2**14
"""Points that are checked together."""


@dataclass(frozen=True)
class Trial:
    """`sol`: a few trajectories with as many rows as a long run has; `case` and `keep` as they are to be called; the `engine`
    that runs them; the `seconds` of one thread that a trajectory takes."""

    sol: Solution
    case: Case
    keep: Keep
    engine: str
    seconds: float


def tried(system: Any, scheme: Any, axes: Axes, case: Case, keep: Keep, options: dict[str, Any], params: Any) -> Trial:
    """The trial of a sweep. Raises `PointError` where `case` or `keep` is wrong, naming the point, and what `simulate` raises
    where it refuses all of the points."""
    few = _spread(axes.size, SINGLE)
    case = case.chosen(axes.at(few))
    numbers = _spread(axes.size, POINTS)
    token = at_most.set(1)
    try:
        run = lambda numbers, steps: _run(system, scheme, axes.at(numbers), case, {**options, "steps": steps}, params)
        numbers, sol, steps = _first(run, axes, numbers, few, options["steps"])
        while steps < options["steps"] and sol.stats["run_seconds"] < SECONDS:
            steps = min(options["steps"], 8 * steps)
            sol = run(numbers, steps)
        seconds = sol.stats["run_seconds"] / (steps * len(numbers)) * options["steps"]
        if sol.stats["engine"] == "native":
            seconds += _overhead(run, numbers)
    finally:
        at_most.reset(token)
    sol = _lengthened(sol, options)
    shown = np.arange(_unlike_shapes(sol)) % len(numbers)
    sol = sol[shown]
    keep = keep.chosen(sol, axes.at(numbers[shown]))
    return Trial(sol, case, keep, sol.stats["engine"], seconds)


def check_points(axes: Axes, case: Case) -> None:
    """Raise `PointError` for a point at which `case` is wrong, as far as they can be looked through in a second."""
    end = time.perf_counter() + CHECKED_SECONDS
    size = CHECKED if case.mode != "points" else 64
    for low in range(0, axes.size, size):
        case.at(axes.at(np.arange(low, min(low + size, axes.size))))
        if time.perf_counter() > end:
            return


def program_of(sol: Solution, options: dict[str, Any]) -> str:
    """The digest of the system's functions as the scheme uses them."""
    data = {name: np.asarray(a[0] if a.ndim == 2 else a) for name, a in sol.initial.items()}
    return of_steps(sol.system, sol.equation, data, sol.params_of_one, options["step"], options["t0"], options["project"])


def _spread(size: int, most: int) -> np.ndarray:
    """So many numbers of points, from the first to the last."""
    return np.unique(np.linspace(0, size - 1, min(size, most)).astype(int))


def _run(system: Any, scheme: Any, values: Values, case: Case, options: dict[str, Any], params: Any) -> Solution:
    data, own = case.at(values)
    batched = own is not None
    rest: dict[str, Any] = {**options, "save_every": max(1, options["steps"] // 2)}
    return simulate(system, scheme, **data, params=own if batched else params, batch_params=batched, **rest)


def _first(run: Callable, axes: Axes, numbers: np.ndarray, few: np.ndarray, steps: int) -> tuple[np.ndarray, Solution, int]:
    """A first short run of points that are not refused."""
    steps = min(steps, 16)
    try:
        return numbers, run(numbers, steps), steps
    except ValueError as refusal:
        reason = refusal
    good = []
    for number in few:
        try:
            run(np.array([number]), steps)
            good.append(number)
        except ValueError as refusal:
            reason = reason if good else refusal
    if good:
        return np.array(good), run(np.array(good), steps), steps
    raise ValueError(f"all points that were tried are refused, the last one, {described(axes.at(few[-1:]))}, with: {reason}")


def _unlike_shapes(sol: Solution) -> int:
    """A number of trajectories that is none of the sizes of one, so that no function takes an axis for another."""
    shapes = [np.shape(array)[1:] for array in sol.fields.values()] + list(map(np.shape, jax.tree.leaves(sol.params_of_one)))
    sizes = {sol.rows}.union(*shapes)
    return next(number for number in itertools.count(SINGLE) if number not in sizes)


def _overhead(run: Callable, numbers: np.ndarray) -> float:
    """Seconds that a trajectory takes besides its steps."""
    many = np.tile(numbers, 16)
    started = time.perf_counter()
    run(numbers, 1)
    between = time.perf_counter()
    run(many, 1)
    both = (time.perf_counter() - between) - (between - started)
    return max(0.0, both / (len(many) - len(numbers)))


def _lengthened(sol: Solution, options: dict[str, Any]) -> Solution:
    """The same with as many rows as a run of all steps has, the last one repeated."""
    two_points = int("q0" in sol.initial)
    steps, every = options["steps"] - two_points, options["save_every"]
    numbers = np.arange(-(-steps // every) + 1, dtype=float) * every
    numbers[-1] = steps
    numbers = np.concatenate([[-1.0], numbers]) if two_points else numbers
    t = (numbers + two_points) * options["step"] + options["t0"]
    fields = {}
    for name, array in sol.fields.items():
        rows = len(t) - (sol.field_info[name].place == "step")
        fields[name] = array[:, np.minimum(np.arange(rows), array.shape[1] - 1)]
    return sol.replace(t=t, fields=fields, save_every=every)
