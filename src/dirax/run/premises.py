"""What the plans of single runs and of batches ask alike, so that the general way need not be asked."""

import math
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from dirax.numerics.equilibration import equilibrated
from dirax.program.evaluation.functions import program_at
from dirax.program.evaluation.in_floats import Floats
from dirax.run.final_manifold import MOST, lanes_asked
from dirax.run.validate import Case
from dirax.schemes.abstract_step import AbstractStep
from dirax.schemes.step import Shape, nothing_to_check
from dirax.systems.system import AbstractSystem

SURELY_REGULAR = 1e6
"""Condition number of ∂²L/∂v², and of the matrix of the constraints, up to which there is no doubt of their rank."""

REMEMBERED = 256
"""Params and times for which it is remembered that the Lagrangian is regular."""


class Regular:
    """The params and first times for which ∂²L/∂v² is known to be regular, and the group of a reduced system to be a symmetry."""

    def __init__(self, case: Case):
        self._known = {self._key(case)}

    @staticmethod
    def _key(case: Case) -> tuple:
        return *bytes_of(case.params), case.t0

    def __contains__(self, case: Case) -> bool:
        return self._key(case) in self._known

    def learn(self, case: Case) -> None:
        """Note that it is so for this case."""
        if len(self._known) > REMEMBERED:
            self._known.clear()
        self._known.add(self._key(case))


def check_premise(system: AbstractSystem, case: Case) -> None:
    """Raise `ValueError` where the premise of the system does not hold in a trajectory of those that are asked."""
    for lane in lanes_asked(case.batch or 1).tolist():
        system.check(*case.begins(lane))


class KeptPremise:
    """The premise of a system for a plan: by a program in floats, and asked anew for other numbers only."""

    def __init__(self, system: AbstractSystem, case: Case):
        data, params = case.of(0)
        found = system.premise(data, params)
        self.premise, self.of_params = found, system.premise_of_params
        self.program: Floats | None = None
        self.known: tuple[float, ...] | None = None
        if found is None:
            return
        values = case.begins()
        program = program_at(found.numbers, values)
        numbers = jax.eval_shape(found.numbers, *values)
        leaves, self.structure = jax.tree.flatten(numbers)
        ends = np.cumsum([math.prod(leaf.shape) for leaf in leaves]).tolist()
        self.places = [(slice(end - math.prod(leaf.shape), end), leaf.shape) for end, leaf in zip(ends, leaves, strict=True)]
        self.program = None if program is None else program.in_floats

    def holds(self, case: Case, regular: Regular) -> bool:
        """Whether it holds; False where the general way is to say so. Raises `ValueError` where it does not hold."""
        if self.premise is None and not self.of_params:
            return True
        if self.of_params and (case.batch_params or case not in regular):
            return False
        return all([self._holds(case, lane) for lane in ([0] if case.batch is None else lanes_asked(case.batch).tolist())])

    def _holds(self, case: Case, lane: int) -> bool:
        if self.premise is None or self.program is None:
            return False
        try:
            found = self.program([x for leaf in jax.tree.leaves(case.begins(lane)) for x in leaf.ravel().tolist()])
        except (ArithmeticError, ValueError):  # what Python's floats do not have
            return False
        if found != self.known:
            arrays = [np.array(found[place]).reshape(shape) for place, shape in self.places]
            self.premise.refuse(jax.tree.unflatten(self.structure, arrays))
            self.known = found
        return True


def bytes_of(params: Any) -> tuple:
    """Equal for equal params of one kind."""
    return () if params is None else tuple([leaf.tobytes() for leaf in jax.tree.leaves(params)])


def checks_of(equation: Any) -> list[Callable]:
    """What the stages of an equation check of data, h and params themselves."""
    trivial = lambda check: check is nothing_to_check or getattr(check, "__func__", None) is AbstractStep.check
    return [check for check in dict.fromkeys(stage.check for stage, _ in equation.stages) if not trivial(check)]


def asks_hessian(system: AbstractSystem, shape: Shape, case: Case) -> bool:
    """Whether it has to be asked if ∂²L/∂v² is regular."""
    if system.metric_form() is not None or system.lagrangian_form() is None or system.final_relation(shape) is not None:
        return False
    return len(case.data) > 1 and "q" in case.data and case.data["q"].shape[-1] <= MOST


def scales_of(matrix: np.ndarray) -> np.ndarray:
    """What the entries of a matrix are to be multiplied by to be those of the equilibrated one."""
    scaled, units = equilibrated(matrix)
    row, column = np.arange(len(matrix)), np.argmax(np.abs(scaled), axis=1)
    with np.errstate(all="ignore"):
        return units * (scaled[row, column] / matrix[row, column] / units[0, column])[:, None]
