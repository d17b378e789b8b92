"""BatchPlan: the start of a batch found once, so that another one of its kind begins in the time of its arithmetic."""

import math
from typing import Any

import jax
import numpy as np

from dirax.engines.contract import Problem
from dirax.engines.step_program import linearized
from dirax.numerics.ranks import all_surely_independent
from dirax.numerics.tolerances import CONSTRAINT_DEFECT
from dirax.program.evaluation.functions import program_at
from dirax.program.scalar_program import ScalarProgram
from dirax.run.final_manifold import lanes_asked
from dirax.run.premises import SURELY_REGULAR, KeptPremise, Regular, asks_hessian, checks_of, scales_of
from dirax.run.settings import Settings
from dirax.run.start import Initial, Start, program_of_beginning, program_of_completion
from dirax.run.validate import Case
from dirax.schemes.step import Shape


class BatchPlan:
    """What `Plan` is for one trajectory, for a batch: by the programs of the general way in NumPy, which give its bits."""

    def __init__(self, settings: Settings, case: Case, shape: Shape, initial: Initial, start: Start, problem: Problem):
        self.settings, self.template = settings, problem.with_numbers(state=None, guess=None, params=None)
        equation = problem.equation
        self.checks = checks_of(equation)
        self.complete: Any = program_of_completion(settings.system, case, settings.project)
        self.begun: Any = program_of_beginning(equation, case, initial.data)
        self.matrix: np.ndarray | None = None
        if initial.constraints is not None and np.size(initial.constraints):
            self.matrix = _scales(initial.constraints)
        self.fraction, self.unknowns = equation.stages[0][1], equation.stages[0][0].unknowns
        self.jacobian = _scales(start.jacobian) if self.unknowns else None
        self.asks_hessian = asks_hessian(settings.system, shape, case)
        self.hessian: ScalarProgram | None = None
        self.regular, self.premise = Regular(case), KeptPremise(settings.system, case)

    @property
    def whole(self) -> bool:
        """Whether it has all the programs that it needs."""
        return None not in (self.complete, self.begun)

    def problem(self, case: Case, steps: int, save_every: int) -> Problem | None:
        """The problem of a case; None where a premise is in doubt."""
        if not self.premise.holds(case, self.regular):
            return None
        size = case.batch or 1
        repeated = lambda leaf: np.broadcast_to(np.asarray(leaf), (size, *np.shape(leaf)))
        leaves = jax.tree.leaves(case.params)
        last = [*(leaves if case.batch_params else map(repeated, leaves)), repeated(case.h), repeated(case.t0)]
        data = [np.broadcast_to(case.data[name], (size, case.data[name].shape[-1])) for name in sorted(case.data)]
        initial: Initial = _evaluated(self.complete, [*data, *last])
        start: Start = _evaluated(self.begun, [*jax.tree.leaves(initial.data), *last])
        if not (self._holds(initial) and self._steps(start, case) and self._has_regular_hessian(initial, case, last[:-2])):
            return None
        first, own = case.begins() if self.checks else ({}, None)
        for check in self.checks:
            check(first, case.h, own)
        numbers = {"state": start.state, "guess": start.guess, "h": case.h, "t0": case.t0, "params": case.params}
        return self.template.with_numbers(**numbers, steps=steps, save_every=save_every)

    def _holds(self, initial: Initial) -> bool:
        """Whether the data are on the constraints, and inside the domain of the functions, and no constraint is redundant."""
        defect, allowed = np.abs(initial.defect), CONSTRAINT_DEFECT if self.settings.check_initial else math.inf
        size = initial.size[:, : defect.shape[1]]
        if not np.all((defect <= allowed * size) & np.isfinite(defect)):
            return False
        if initial.lagrangian is not None and not np.all(np.isfinite(initial.lagrangian)):
            return False
        return self.matrix is None or all_surely_independent(initial.constraints * self.matrix, SURELY_REGULAR)

    def _steps(self, start: Start, case: Case) -> bool:
        """Whether the first step has a unique solution."""
        if not self.unknowns:
            return True
        each = lambda number: np.broadcast_to(np.asarray(number), (case.batch or 1,))
        key = self.template.equation, case.params, case.batch_params
        found = linearized(*key, start.guess[0], start.state, each(case.t0), each(self.fraction * case.h))
        return found is not None and bool(np.all(np.isfinite(found[0]))) and all_surely_independent(found[1] * self.jacobian)

    def _has_regular_hessian(self, initial: Initial, case: Case, params: list[np.ndarray]) -> bool:
        """Whether ∂²L/∂v² is regular in the trajectories that the general way asks."""
        if not self.asks_hessian or (not case.batch_params and case in self.regular):
            return True
        lanes = lanes_asked(case.batch or 1)
        q, v = (initial.data[name][lanes] for name in ("q", "v"))
        own = jax.tree.unflatten(jax.tree.structure(case.params), [leaf[0] for leaf in params])
        if self.hessian is None:
            self.hessian = program_at(self.settings.system.velocity_hessian, (np.asarray(case.t0), q[0], v[0], own))
        if self.hessian is None:
            return False
        t = np.full(len(lanes), case.t0)
        regular = all_surely_independent(self.hessian.in_numpy([t, q, v, *(leaf[lanes] for leaf in params)])[0], SURELY_REGULAR)
        if regular:
            self.learn(case)
        return regular

    def learn(self, case: Case) -> None:
        """Note that the Lagrangian is regular for the params and the time of this case; those of a batch are others each time."""
        if not case.batch_params:
            self.regular.learn(case)


def _evaluated(program: tuple[ScalarProgram, Any], leaves: list[np.ndarray]) -> Any:
    return jax.tree.unflatten(program[1], program[0].in_numpy(leaves))


def _scales(matrices: Any) -> np.ndarray:
    """What brings all of these matrices (B, k, l) to entries of about one size; any scaling by rows and columns is a right
    one."""
    return scales_of(np.max(np.abs(np.asarray(matrices)), axis=0))
