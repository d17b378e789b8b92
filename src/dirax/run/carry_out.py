"""A run carried out: by the plan for its kind where there is one, else discretize → start → engine; then its Solution."""

import time
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dirax.engines.contract import Outcome, Problem
from dirax.engines.lifted import lifted
from dirax.numerics.one_thread import one_thread
from dirax.program.captured import refuse_changed
from dirax.program.memo import Memo, patience
from dirax.program.user_functions import is_traced, values_matter
from dirax.run.composition_premise import refuse_leaving_final_manifold
from dirax.run.event_run import run_with_events
from dirax.run.final_manifold import (
    is_singular,
    needed_at,
    projected_onto_manifold,
    refuse_off_final_manifold,
    warn_of_leaving,
)
from dirax.run.own_equation import refuse_wrong_shapes, shape_of
from dirax.run.plan import AnyPlan, planned
from dirax.run.premises import bytes_of, check_premise
from dirax.run.progress import reported, reporting
from dirax.run.redundancy import redundant_constraints, without_redundant
from dirax.run.refused_start import SHORTER, refuse_bad_start
from dirax.run.result import solution_of, warn_of_last_rows
from dirax.run.settings import Settings, kind_of
from dirax.run.start import begun, completed
from dirax.run.streaming import Stream
from dirax.run.traced_run import Carried, carried_by_jax, moves
from dirax.run.validate import Case, refuse_clock_that_stands, refuse_more_than_memory
from dirax.schemes.step import Shape, make_step_equation
from dirax.solution.solution import Solution

STARTS = 16
"""Starts of runs of one kind that are kept, of the last ones that were found."""

LARGEST_START = 2**16
"""Numbers of an array of initial data up to which they are."""


@dataclass
class Kind:
    """Runs of one kind: the plan for them, once there is one, the engine that has found what it needs for them, and where runs
    from the same numbers began."""

    runs: int = 0
    plan: AnyPlan | None = None
    engine: Callable | None = None
    starts: dict[Hashable, "Begun"] = field(default_factory=dict)

    def again(self, numbers: Hashable, case: Case, steps: int, save_every: int, asked: int) -> "Begun | None":
        """The start of a run from the same numbers, of so many steps."""
        found = self.starts.get(numbers)
        if found is None:
            return None
        steps -= int(case.two_points)
        problem = found.problem.with_numbers(steps=steps, save_every=save_every, params=case.params)
        refuse_more_than_memory(problem)
        return found.with_numbers(case=case, problem=problem, save_every=asked)

    def keep(self, numbers: Hashable, case: Case, found: "Begun") -> None:
        """Keep a start for runs from the same numbers."""
        if numbers is None or found.case is not case:
            return
        while len(self.starts) >= STARTS:
            self.starts.pop(next(iter(tuple(self.starts))), None)
        self.starts[numbers] = found


def _numbers(case: Case) -> Hashable:
    """Equal for cases of one kind with the same numbers, bit by bit; None for what is large, and for batches, whose starts a plan
    finds in a small part of their steps."""
    if case.batch is not None or max([a.size for a in case.data.values()]) > LARGEST_START:
        return None
    return *[a.tobytes() for a in case.data.values()], *bytes_of(case.params), case.h, case.t0


_kinds: Memo[Kind] = Memo(128)


def kind_for(settings: Settings, case: Case) -> Kind | None:
    """The kind that a case belongs to, the same object for equal settings, a new one where they have no hash; None where
    values are traced."""
    if not case.plain:
        return None
    return _kinds.get((settings.key, kind_of(case)), Kind)


@dataclass
class Begun:
    """A problem, and what else is known of its beginning."""

    case: Case
    problem: Problem
    redundant: tuple[int, ...]
    row0: dict | None
    traced: bool
    singular: bool = field(default=False, kw_only=True)
    """Whether the Lagrangian is singular."""
    plain: bool = field(default=False, kw_only=True)
    """Whether nothing of it needs the general way: no constraint is redundant, and no Lagrangian singular."""
    rows: dict[str, np.ndarray] | None = field(default=None, kw_only=True)
    """Rows that were saved by the run that this one goes on with."""
    save_every: int = field(default=1, kw_only=True)
    """What was asked for, which may be more steps than there are."""
    plan: Callable[[], AnyPlan | None]
    """Makes the plan for others of its kind."""
    engine: Callable | None = field(default=None, kw_only=True)
    """The engine that ran it, where it is not that of its kind."""

    def with_numbers(self, **numbers: Any) -> "Begun":
        """The same beginning with other numbers."""
        begun = object.__new__(Begun)
        begun.__dict__ = {**self.__dict__, **numbers}
        return begun


def carried_out(
    settings: Settings, case: Case, steps: int, save_every: int, progress: Any, kind: Kind | None = None, entered: float = 0.0
) -> Solution:
    """The Solution of a run. Raises `ValueError` for data that a premise excludes."""
    if settings.events:
        refuse_changed(settings.reads)  # walls begin runs of their own
        return run_with_events(carried_out, _begun, settings, case, steps, save_every, progress, kind, entered)
    began, progress = time.perf_counter(), reported(progress)
    every = _checked_times(case, steps, save_every)
    kind = None if settings.to is not None else kind or kind_for(settings, case)
    refuse_changed(settings.reads)
    if kind is None and case.traced:
        case = without_redundant(settings.system, case, settings.project)
        problem, outcome, row0 = carried_by_jax(_by_jax(settings, steps, every), settings, case, steps, every)
        return solution_of(settings.system, settings.scheme, case, problem, outcome, row0, True)
    numbers = _numbers(case) if kind is not None else None
    if kind is not None and (again := kind.again(numbers, case, steps, every, save_every)):
        return _run(settings, kind, again, steps, progress, entered, began)
    if kind is not None and kind.plan is not None:
        problem = kind.plan.problem(case, steps, every)
        if problem is not None:
            refuse_more_than_memory(problem)
            found = Begun(case, problem, (), None, False, _no_plan, save_every=save_every)
            kind.keep(numbers, case, found)
            return _run(settings, kind, found, steps, progress, entered, began)
    found = _begun(settings, case, steps, every, save_every)
    if kind is not None and not found.traced:
        kind.keep(numbers, case, found)
        if kind.plan is not None and found.plain:
            kind.plan.learn(case)
        kind.runs += 1
        if kind.runs == 2:
            kind.plan = found.plan()
    with patience():
        return _run(settings, kind, found, steps, progress, entered, began)


def _by_jax(settings: Settings, steps: int, every: int) -> Callable[[Case], Carried]:
    """What is compiled of a run with traced values."""

    def carried(case: Case) -> Carried:
        found = _begun(settings, case, steps, every, every)
        return found.problem, settings.engine.run_traced(found.problem), found.row0

    return carried


def prepared(settings: Settings, case: Case, steps: int, save_every: int) -> Kind | None:
    """The kind of a case with its plan made and its engine ready. Raises `ValueError` for data that a premise excludes."""
    save_every = _checked_times(case, steps, save_every)
    kind = kind_for(settings, case)
    if kind is None or (kind.plan is not None and kind.engine is not None and kind.plan.problem(case, steps, save_every)):
        return kind
    found = _begun(settings, case, steps, save_every, save_every)
    if not found.traced and not found.redundant:
        kind.plan = kind.plan or found.plan()
        kind.engine = kind.engine or settings.engine.prepared(found.problem.with_numbers(often=True))
    return kind


def _checked_times(case: Case, steps: int, save_every: int) -> int:
    """How often rows are saved, no later than at the last step. Raises `ValueError` for times that floats do not tell apart."""
    refuse_clock_that_stands(case.t0, case.h, steps)
    return min(save_every, max(1, steps - int(case.two_points)))


def _no_plan() -> None:
    return None


@patience()
@one_thread()
@np.errstate(all="ignore")  # what is not finite is looked for and said, whatever a program has NumPy raise
def _begun(settings: Settings, case: Case, steps: int, save_every: int, asked: int) -> Begun:
    """The general way from a case to its problem; `asked`: the `save_every` that was asked for."""
    system, scheme, by_jax = settings.system, settings.scheme, settings.engine.compiles_start(case.traced)
    given, check_initial = case, settings.check_initial
    data, own = case.first
    # discretize: constraints that follow from others at the completed data are left out of the equation
    with values_matter() as by_values:
        shape, redundant, singular = shape_of(system, data, own), case.redundant, False
    if not case.traced:
        check_premise(system, case)
    initial = completed(system, case, settings.project, by_jax)
    if not (traced := case.traced or is_traced(initial)):
        redundant = redundant_constraints(system, initial.constraints, data, own, case.t0)
        if (
            (singular := is_singular(system, shape, case, initial))
            and settings.project
            and (moved := projected_onto_manifold(system, case, initial))
        ):
            case, initial = moved, completed(system, moved, False, by_jax)
    shape = Shape(shape.n, shape.m, shape.c, redundant=redundant) if redundant else shape
    equation = make_step_equation(scheme, system, shape)
    # start
    if not traced:
        complete = {name: a if case.batch is None else a[0] for name, a in initial.data.items()}
        refuse_wrong_shapes(system, equation, {**complete, "t": np.asarray(case.t0)}, case.h, own)
    equation = lifted(equation, case.params, case.batch_params)
    start = begun(equation, case, initial, by_jax)
    # user functions that close over a traced value make the start traced although nothing that was passed is
    if not (traced := traced or is_traced(start)):
        first = case.begins()[0]
        for check in dict.fromkeys(stage.check for stage, _ in equation.stages):
            check(first, case.h, own)
        needed = partial(needed_at, system, case, initial) if singular else None
        labels = equation.stages[0][0].labels
        shorter = lambda: begun(equation, replace(case, h=SHORTER * case.h), initial, by_jax)
        refuse_bad_start(system, initial, start, labels, check_initial, settings.project, needed, case, shorter)
        if check_initial and singular:
            refuse_off_final_manifold(system, case, initial)
        if check_initial:
            refuse_leaving_final_manifold(system, equation, shape, case, initial, start, singular)
    problem = Problem(
        equation=equation,
        state=start.state,
        guess=start.guess,
        h=case.h,
        t0=case.t0,
        steps=steps - int(case.two_points),
        save_every=save_every,
        first_step=int(case.two_points),
        params=jax.tree.map(lambda leaf: jnp.asarray(leaf) if moves(leaf) else leaf, case.params) if traced else case.params,
        batch=case.batch,
        batch_params=case.batch_params,
        max_iterations=settings.max_iterations,
        compensated=settings.compensated,
    )
    if settings.to is None:
        refuse_more_than_memory(problem)
    plain = not (redundant or singular or by_values or by_jax)

    def plan() -> AnyPlan | None:
        return planned(settings, given, shape, initial, start, problem) if plain else None

    return Begun(case, problem, redundant, start.row0, traced, plan, singular=singular, plain=plain, save_every=asked)


def _run(
    settings: Settings, kind: Kind | None, found: Begun, steps: int, progress: Any, entered: float, began: float
) -> Solution:
    problem, traced, on = found.problem, found.traced, settings.engine
    started = time.perf_counter()
    if settings.to is not None and not traced:
        stream = Stream(settings, found.case, problem, found.row0, on.prepared(problem), settings.to, steps, found.save_every)
        solution = stream.solution(progress)
        solution.continuation = StreamedOn(settings, found.case, steps, found.save_every)
        return solution
    if traced:
        outcome = on.run_traced(problem)
        ready = started
    else:
        holder = found if found.redundant or kind is None else kind
        run = holder.engine = holder.engine or on.prepared(problem)
        ready = time.perf_counter()
        outcome = _outcome(run, problem, steps, progress)
    for name, rows in (found.rows or {}).items():
        outcome.fields[name][:, : rows.shape[1]] = rows
    if found.redundant:
        outcome.notes["redundant_constraints"] = list(found.redundant)
    solution = solution_of(settings.system, settings.scheme, found.case, problem, outcome, found.row0, traced)
    if found.singular and not traced:
        warn_of_leaving(solution)
    warn_of_last_rows(problem, outcome)
    if not traced:
        solution.continuation = Continuation(settings, kind, found, outcome.record, steps)
        getting_ready, compiling = ready - started, outcome.compile_seconds  # an engine may compile when it runs, too
        solution.stats |= {
            "validate_seconds": began - entered if entered else 0.0,
            "start_seconds": started - began,
            "trace_seconds": max(0.0, getting_ready - compiling),
            "result_seconds": max(0.0, time.perf_counter() - ready - outcome.run_seconds - max(0.0, compiling - getting_ready)),
        }
    return solution


class Continuation(NamedTuple):
    """What goes on with a run: `sol.extend` calls it."""

    settings: Settings
    kind: Kind | None
    begun: Begun
    record: Any
    steps: int
    """Those of the run, with the one between two given points."""

    def __call__(self, sol: Solution, more: int, progress: Any) -> Solution:
        """The solution of the whole run of so many more steps, bit by bit."""
        began, old, progress = time.perf_counter(), self.begun.problem, reported(progress)
        after = old.steps if self.record is not None else 0
        every = min(self.begun.save_every, old.steps + more)
        problem = old.with_numbers(steps=old.steps + more, save_every=every, after=after, record=self.record)
        refuse_more_than_memory(problem)
        before = _rows_before(sol, problem)
        found = self.begun.with_numbers(problem=problem, rows=before)
        longer = _run(self.settings, self.kind, found, self.steps + more, progress, 0.0, began)
        longer.metadata, longer.example = sol.metadata, sol.example
        return longer


@dataclass(frozen=True)
class StreamedOn:
    """What goes on with a run whose rows are in a store."""

    settings: Settings
    case: Case
    steps: int
    save_every: int

    def __call__(self, sol: Solution, more: int, progress: Any) -> Solution:
        """The solution of the whole run of so many more steps, from where the store ends."""
        return carried_out(self.settings, self.case, self.steps + more, self.save_every, progress)


def _rows_before(sol: Solution, problem: Problem) -> dict[str, np.ndarray]:
    """The saved rows of the steps that are done, (B, rows, …), without the last one, which may not be among those of the longer
    run, and without the given row 0 of two points."""
    lead = 1 if sol.batch is None else sol.batch
    good = sol.rows - 1 - problem.first_step if sol.batch is None else problem.steps
    count = min(-(-problem.after // problem.save_every), good)
    found = {}
    for name, values in sol.fields.items():
        rows = values.reshape(lead, -1, *sol.field_info[name].shape) if sol.batch is None else values
        found[name] = rows[:, problem.first_step : problem.first_step + count]
    return found


def _outcome(run: Callable, problem: Problem, steps: int, progress: Any) -> Outcome:
    if not progress:
        return run(problem, None)
    with reporting(progress, steps) as report:
        return run(problem, report)
