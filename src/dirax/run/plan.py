"""Plan: the start of a run found once, so that another one of its kind begins in microseconds."""

import math
from collections.abc import Sequence
from operator import mul
from typing import Any, TypeAlias

import jax
import numpy as np

from dirax.engines.contract import Problem
from dirax.numerics.ranks import surely_independent
from dirax.numerics.tolerances import CONSTRAINT_DEFECT
from dirax.program.evaluation.functions import program_at
from dirax.program.evaluation.in_floats import Floats
from dirax.run.batch_plan import BatchPlan
from dirax.run.premises import SURELY_REGULAR, KeptPremise, Regular, asks_hessian, checks_of, scales_of
from dirax.run.settings import Settings
from dirax.run.start import (
    Initial,
    Start,
    begins_by_arrays,
    program_of_beginning,
    program_of_completion,
    program_of_first_step,
)
from dirax.run.validate import Case
from dirax.schemes.step import Shape


class Plan:
    """The way from a case of one kind to its problem in floats, with the bits of the general way.

    Every premise that the general way checks is checked, by numbers that leave no doubt; where they do, `begin` gives None and
    the general way decides, and says what is wrong. What it found for the first case is where a plan begins.
    """

    def __init__(self, settings: Settings, case: Case, shape: Shape, initial: Initial, start: Start, problem: Problem):
        self.settings, self.template = settings, problem
        equation = problem.equation
        self.checks, self.names = checks_of(equation), sorted(case.data)
        complete = program_of_completion(settings.system, case, settings.project)
        begun = program_of_beginning(equation, case, initial.data)
        self.complete: Any = complete and complete[0].in_floats
        self.begun: Any = begun and begun[0].in_floats
        self.first_step: Any = None
        self.data_size = sum(np.size(a) for a in jax.tree.leaves(initial.data))
        self.defects, self.has_lagrangian = np.size(initial.defect), initial.lagrangian is not None
        self.matrix: list[float] | None = None
        if initial.constraints is not None and np.size(initial.constraints):
            self.rows, self.matrix = len(initial.constraints), scales_of(np.asarray(initial.constraints)).ravel().tolist()
        self.state_size, self.guesses = len(start.state), [len(guess) for guess in start.guess]
        self.fraction, self.unknowns = equation.stages[0][1], equation.stages[0][0].unknowns
        if self.unknowns:
            self.first_step, self.moving = program_of_first_step(equation, case)
            self.jacobian = scales_of(np.asarray(start.jacobian)).ravel().tolist()
        self.asks_hessian = asks_hessian(settings.system, shape, case)
        self.hessian: Floats | None = None
        self.places = _places(initial.data)
        self.regular, self.premise = Regular(case), KeptPremise(settings.system, case)

    @property
    def whole(self) -> bool:
        """Whether it has all the programs that it needs."""
        return None not in (self.complete, self.begun, self.first_step if self.unknowns else True)

    def problem(self, case: Case, steps: int, save_every: int) -> Problem | None:
        """The problem of a case; None where a premise is in doubt."""
        if not self.premise.holds(case, self.regular):
            return None
        leaves = case.leaves
        data = [x for name in self.names for x in case.data[name].tolist()]
        last = [*(x for leaf in leaves for x in leaf.ravel().tolist()), case.h, case.t0]
        try:
            initial = self.complete((*data, *last))
            complete = initial[: self.data_size]
            start = self.begun((*complete, *last))
            if not (
                self._holds(initial) and self._steps(start, case, leaves) and self._has_regular_hessian(complete, case, last)
            ):
                return None
        except (ArithmeticError, ValueError):  # what Python's floats do not have
            return None
        for check in self.checks:
            check(case.begins()[0], case.h, case.params)
        guess, at = [], self.state_size
        for size in self.guesses:
            guess.append(np.array(start[at : at + size]))
            at += size
        return self.template.with_numbers(
            state=np.array(start[: self.state_size]),
            guess=tuple(guess),
            h=case.h,
            t0=case.t0,
            steps=steps,
            save_every=save_every,
            params=case.params,
        )

    def _holds(self, initial: Sequence[float]) -> bool:
        """Whether the data are on the constraints, and inside the domain of the functions, and no constraint is redundant."""
        first, at = self.data_size + self.defects, self.data_size + 2 * self.defects
        allowed = CONSTRAINT_DEFECT if self.settings.check_initial else math.inf
        for defect, size in zip(initial[self.data_size : first], initial[first:at], strict=True):
            if not (abs(defect) <= allowed * size and defect - defect == 0.0):
                return False
        if self.has_lagrangian and not math.isfinite(initial[at]):
            return False
        if self.matrix is None:
            return True
        scaled = list(map(mul, initial[at + self.has_lagrangian :], self.matrix))
        return surely_independent(scaled, self.rows, SURELY_REGULAR)

    def _steps(self, start: Sequence[float], case: Case, leaves: list[Any]) -> bool:
        """Whether the start is finite, and the first step has a unique solution."""
        k, s = self.unknowns, self.state_size
        if not math.isfinite(sum(start)):
            return False
        if not k:
            return True
        params = [x for leaf, moves in zip(leaves, self.moving, strict=True) if moves for x in leaf.ravel().tolist()]
        found = self.first_step((*start[s : s + k], *start[:s], case.t0, self.fraction * case.h, *params))
        return math.isfinite(sum(found[:k])) and surely_independent(list(map(mul, found[k:], self.jacobian)), k)

    def _has_regular_hessian(self, complete: Sequence[float], case: Case, last: Sequence[float]) -> bool:
        """Whether ∂²L/∂v² is regular; what is so once is not asked again for the same params and time."""
        if not self.asks_hessian or case in self.regular:
            return True
        q, v = (complete[self.places[name]] for name in ("q", "v"))
        if self.hessian is None:
            values = np.asarray(case.t0), np.array(q), np.array(v), case.params
            program = program_at(self.settings.system.velocity_hessian, values)
            self.hessian = None if program is None else program.in_floats
        if self.hessian is None:
            return False
        entries, n = self.hessian((case.t0, *q, *v, *last[:-2])), len(q)
        regular = surely_independent(entries, n, SURELY_REGULAR)
        if regular:
            self.learn(case)
        return regular

    def learn(self, case: Case) -> None:
        """Note that the Lagrangian is regular for the params and the time of this case."""
        self.regular.learn(case)


AnyPlan: TypeAlias = Plan | BatchPlan


def planned(settings: Settings, case: Case, shape: Shape, initial: Initial, start: Start, problem: Problem) -> AnyPlan | None:
    """The plan for cases like one that the general way took; None for those that always need it: two points, steps whose
    functions have no program or a large one, and compositions that might leave a final manifold."""
    equation, system = problem.equation, settings.system
    stages = equation.stages
    if case.two_points or begins_by_arrays(case) or (stages[0][0].unknowns and not isinstance(start.jacobian, np.ndarray)):
        return None
    fields = stages[0][0].fields
    if len(stages) > 1 and not system.constraints.any and "p" in fields and system.final_relation(shape) is not None:
        return None
    made = Plan if case.batch is None else BatchPlan
    _ = problem.fields, problem.row_size, problem.review  # found once: others are made of this one
    plan = made(settings, case, shape, initial, start, problem)
    return plan if plan.whole else None


def _places(data: dict[str, Any]) -> dict[str, slice]:
    """Where each of the complete data stands among their numbers."""
    found, at = {}, 0
    for name in sorted(data):
        found[name] = slice(at, at + np.size(data[name]))
        at += np.size(data[name])
    return found
