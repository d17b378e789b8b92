"""From what an engine gives back to a Solution: rows, times, messages, and what is reported of the run."""

import functools
import warnings
from typing import Any

import jax.numpy as jnp
import numpy as np

from dirax.engines.contract import Outcome, Problem, cut, saved_steps
from dirax.engines.sizes import sizes_of
from dirax.run.failure_messages import explain, in_few_words
from dirax.run.validate import Case
from dirax.schemes.step import AbstractScheme
from dirax.solution.solution import Solution
from dirax.solution.trajectory import COUNTS
from dirax.systems.system import AbstractSystem

EXPLAINED = 32
"""Trajectories of a batch whose failed step is computed again, to say where it breaks."""


def solution_of(
    system: AbstractSystem,
    scheme: AbstractScheme,
    case: Case,
    problem: Problem,
    outcome: Outcome,
    row0: dict[str, Any] | None,
    traced: bool,
    said: list[str] | None = None,
) -> Solution:
    """The Solution of a run; `row0` is the given row 0 of a two-point start, `said` why trajectories ended, where it is known."""
    p, fields, numbers = problem, outcome.fields, saved_steps(problem)
    message: Any = ""
    if traced or p.batch is not None:
        ok = outcome.completed == p.steps
        ok = ok if p.batch is not None else ok[0]
        message = message if traced else messages(p, outcome, numbers, said)
    elif not (ok := bool(outcome.completed[0] == p.steps)):
        message = messages(p, outcome, numbers, said)[0]
        numbers, fields = cut(p, outcome)
    if row0 is not None:
        join = jnp.concatenate if traced else np.concatenate
        lead = lambda a: a if p.batch is not None else a[None]
        for name in list(fields):  # one after the other, so that only one array is in memory twice
            first = lead(row0[name])[:, None]
            fields[name] = join([first if traced else np.asarray(first), fields.pop(name)], axis=1)
        numbers = np.concatenate([[-1.0], numbers])
    alone = p.batch is None
    fields = {name: fields[name][0] if alone else fields[name] for name in p.fields}
    found = Solution(
        t=times_of(p, numbers, traced),
        fields=fields,
        field_info=p.fields,
        step=p.h,
        save_every=p.save_every,
        stats=stats_of(p, outcome, traced) | ({} if traced else p.review(fields)),
        ok=ok,
        message=message,
        system=system,
        scheme=scheme,
        equation=p.equation,
        params=p.params,
        batch_params=p.batch_params,
        initial=dict(case.data),
    )
    if not alone and not traced:
        found.counts = dict(zip(COUNTS, (outcome.iterations, outcome.max_residual), strict=True))
    return found


def messages(p: Problem, outcome: Outcome, numbers: np.ndarray, said: list[str] | None) -> list[str]:
    """Why each trajectory ended, "" where it did not."""
    good = np.asarray(outcome.completed)
    kept = good if p.batch is None else numbers[np.searchsorted(numbers, good, side="right") - 1]
    found, sizes = [""] * len(good), functools.cache(lambda: sizes_of(p))
    for which, lane in enumerate(np.flatnonzero(good < p.steps).tolist()):
        explained = explain if which < EXPLAINED else in_few_words
        found[lane] = (said[lane] if said else "") or explained(p, outcome, lane, int(kept[lane]), sizes)
    return found


def warn_of_last_rows(p: Problem, outcome: Outcome) -> None:
    """Warn of trajectories that have ended well, the last rows of which are made of steps without solutions."""
    if outcome.unsaid is None or not np.any(bad := outcome.unsaid & (outcome.completed == p.steps)):
        return
    which = f" of trajectory {int(np.argmax(bad))}" if p.batch is not None else ""
    warnings.warn(
        f"the last row{which} is made of the step after it, as a momentum between two steps is, and no solution of that step was "
        "found: what it says of momenta and multipliers is not to be trusted. End the run a row before, or take smaller steps.",
        RuntimeWarning,
        stacklevel=5,
    )


def times_of(p: Problem, numbers: np.ndarray, traced: bool):
    """The times of the steps of the given numbers, in the same array where nothing that is traced can hold it."""
    if traced:
        return p.t0 + (numbers + p.first_step) * p.h
    if p.first_step:
        numbers += p.first_step
    numbers *= p.h
    if p.t0:
        numbers += p.t0
    return numbers


def stats_of(p: Problem, outcome: Outcome, traced: bool) -> dict[str, Any]:
    """What `Solution.stats` say of what an engine gave back."""
    one = len(outcome.iterations) == 1
    total = outcome.iterations[0] if one else outcome.iterations.sum()
    worst = outcome.max_residual[0] if one else outcome.max_residual.max()
    return {
        "engine": outcome.engine,
        "steps": p.steps + p.first_step,
        "newton_iterations": total if traced else int(total),
        "max_residual": worst if traced else float(worst),
        "compile_seconds": outcome.compile_seconds,
        "run_seconds": outcome.run_seconds,
        **outcome.notes,
    }
