"""What the plans of single runs and of batches ask alike, so that the general way need not be asked."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from dirax.numerics.equilibration import equilibrated
from dirax.run.final_manifold import MOST
from dirax.run.validate import Case
from dirax.schemes.abstract_step import AbstractStep
from dirax.schemes.step import Shape, nothing_to_check
from dirax.systems.system import AbstractSystem

SURELY_REGULAR = 1e6
"""Condition number of ∂²L/∂v², and of the matrix of the constraints, up to which there is no doubt of their rank."""

REMEMBERED = 256
"""Params for which it is remembered that the Lagrangian is regular."""


class Regular:
    """The params for which ∂²L/∂v² is known to be regular."""

    def __init__(self, params: Any):
        self._known = {bytes_of(params)}

    def __contains__(self, params: Any) -> bool:
        return bytes_of(params) in self._known

    def learn(self, params: Any) -> None:
        """Note that it is regular for these params."""
        if len(self._known) > REMEMBERED:
            self._known.clear()
        self._known.add(bytes_of(params))


def bytes_of(params: Any) -> tuple:
    """Equal for equal params of one kind."""
    return tuple([leaf.tobytes() for leaf in jax.tree.leaves(params)])


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
