"""The engine "auto": native for small systems on a CPU, sparse for large ones that are sparse, xla for everything else."""

from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import numpy as np

from dirax.engines import policy
from dirax.engines.contract import TOO_LARGE, Outcome, Problem, Progress
from dirax.engines.engine import AbstractEngine
from dirax.engines.walk import AbstractWalk, WalkByRuns
from dirax.engines.xla import Xla
from dirax.program.interpreter import UnsupportedPrimitive

T = TypeVar("T")

Notes = dict[str, str]
"""Why engines do not take a problem, by the names that `stats` have for it."""


class Auto(AbstractEngine):
    """Takes the engine that is the quickest, by the numbers in `policy.py`; `stats["not_native"]` says why not the native engine,
    and `stats["not_sparse"]` why a large system is not taken as a sparse one."""

    name = "auto"

    def supports(self, problem: Problem) -> str | None:
        """The xla engine takes what the others do not."""
        return None

    def run(self, problem: Problem, progress: Progress | None = None) -> Outcome:
        """By the engine that takes the problem."""
        return self.prepared(problem)(problem, progress)

    def prepared(self, problem: Problem) -> Callable[[Problem, Progress | None], Outcome]:
        """`run` of the engine that takes the problem."""

        def made(engine: AbstractEngine, notes: Notes) -> Callable[[Problem, Progress | None], Outcome]:
            run = _with_notes(engine.prepared(problem), notes)
            return run if notes or problem.equation.stages[0][0].collocation is None else _by_another_where_stiff(run)

        return _first(problem, made)

    def walks(self, problem: Problem) -> Callable[[Problem], AbstractWalk]:
        """By the native engine, or by runs of that which takes the problem."""

        def made(engine: AbstractEngine, notes: Notes) -> Callable[[Problem], AbstractWalk]:
            run = _with_notes(engine.prepared(problem), notes)
            return (lambda problem: WalkByRuns(problem, run)) if notes else engine.walks(problem)

        return _first(problem, made)

    def run_traced(self, problem: Problem) -> Outcome:
        """The same."""
        return _first(problem, lambda engine, notes: _with_notes(engine.run_traced, notes)(problem), traced=True)


def _by_another_where_stiff(run: Callable[..., Outcome]) -> Callable[..., Outcome]:
    """A run by the native engine, or by the next one where its first step is too stiff for a fixed point and too large for
    another iteration."""

    def either(problem: Problem, progress: Progress | None = None) -> Outcome:
        outcome = run(problem, progress)
        tried = outcome.notes.get("iteration", "")
        if TOO_LARGE not in tried or outcome.interrupted or np.any(outcome.completed):
            return outcome
        notes: Notes = {}
        engine = next(engine for engine in in_turn(problem, notes) if engine.name != "native")
        return _with_notes(engine.run, notes | {"not_native": tried})(problem, progress)

    return either


def _with_notes(run: Callable[..., Outcome], notes: Notes) -> Callable[..., Outcome]:
    def noted(*arguments: Any) -> Outcome:
        outcome = run(*arguments)
        outcome.notes |= notes
        return outcome

    return noted if notes else run


def _first(problem: Problem, act: Callable[[AbstractEngine, Notes], T], traced: bool = False) -> T:
    """What is done with the first engine that takes the problem, and with why the others do not where that is not the native
    one."""
    notes: Notes = {}
    for engine in in_turn(problem, notes, traced):
        if engine.name != "native":
            break
        try:
            return act(engine, {})
        except UnsupportedPrimitive as error:  # its Jacobian or its elimination has too many operations
            notes["not_native"] = str(error)
    return act(engine, notes)


def in_turn(problem: Problem, notes: Notes, traced: bool = False) -> Iterator[AbstractEngine]:
    """The engines that take the problem, the quickest first; `notes` gain why others do not. Raises `ValueError` for dense steps
    that are too large."""
    yield from _native(problem, notes, traced)
    if problem.size >= policy.FEWEST_SPARSE:
        yield from _asked("sparse", problem, notes, only_quicker=True)
        yield from _native(problem, notes, traced, not_sparse=True)
        unknowns = max(stage.unknowns for stage, _ in problem.equation.stages)
        if unknowns > policy.LARGEST_DENSE:
            raise ValueError(
                f"a step of {unknowns} unknowns that is not sparse takes a matrix of {8e-9 * unknowns**2:.3g} GB: "
                f"{notes['not_sparse']}. Take a scheme whose equations have few unknowns each (mean-value gradients have all; "
                "dx.DiscreteDirac is the midpoint rule), write the system's functions as sums over neighbours, or ask for "
                'engine="xla".'
            )
    yield Xla()


def _native(problem: Problem, notes: Notes, traced: bool, not_sparse: bool = False) -> Iterator[AbstractEngine]:
    reason = policy.kept_from_native(problem, traced, not_sparse)
    if reason is None:
        yield from _asked("native", problem, notes, most_operations=policy.most_operations(problem, not_sparse))
    else:
        notes["not_native"] = reason


def _asked(name: str, problem: Problem, notes: Notes, **options: Any) -> Iterator[AbstractEngine]:
    """The engine of that name, if it takes the problem; else the note why it does not."""
    try:
        engine = policy.engine_of(name, **options)
        reason = engine.supports(problem)
    except ImportError as error:
        notes[f"not_{name}"] = str(error)
        return
    if reason is None:
        yield engine
    else:
        notes[f"not_{name}"] = reason
