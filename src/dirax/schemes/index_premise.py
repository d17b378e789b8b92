"""The premise of Method 1 of a relation of (x, ẋ): that its hidden constraints are of index 2 at most."""

import dataclasses
import warnings
from typing import Any

import jax.numpy as jnp
import numpy as np

from dirax.numerics.equilibration import balancing_scales, equilibrated
from dirax.program.memo import Memo, by_value
from dirax.program.tracing import jacobian
from dirax.program.user_functions import evaluated
from dirax.schemes.step import StepEquation
from dirax.systems.forms import RelationForm
from dirax.systems.system import AbstractSystem

SINGULAR = 1e-9
"""Singular values, relative to the largest one of rows and columns scaled to 1, that count as zero."""

LARGEST = 100
"""Numbers of a relation up to which it is asked."""

_asked: Memo[bool] = Memo(256)


def warned_of_index_three(system: AbstractSystem, form: RelationForm, size: int, equation: StepEquation) -> StepEquation:
    """The equation, which warns of constraints of index 3 or more: Method 1 keeps no constraint but those that are stated, its
    momenta do not converge and its multipliers grow like 1/h."""

    def check(data: Any, h: Any, params: Any) -> None:
        equation.check(data, h, params)
        if is_of_index_three(system, form, size, data, params):
            warnings.warn(
                f"the constraints of this {type(system).__name__} are of index 3 or more: Method 1 does not keep those that are "
                "hidden in it, its multipliers grow like 1/h, and what is off the final manifold may grow whatever the step. "
                "Simulate dx.constraint_algorithm(system, near=x).resolved() by dx.DiscreteDirac() instead.",
                RuntimeWarning,
                stacklevel=2,
            )

    return dataclasses.replace(equation, check=check)


def is_of_index_three(system: AbstractSystem, form: RelationForm, size: int, data: Any, params: Any) -> bool:
    """Whether the relation and the first derivatives of its constraints do not determine ẋ at initial data. Asked once of a
    system."""
    if not form.multipliers or size + form.multipliers > LARGEST:
        return False

    def slopes(data: Any, params: Any) -> Any:
        complete, t = system.complete(data, params, False), data["t"]
        x, u = complete["x"], complete.get("guess", jnp.zeros(form.multipliers))
        both = jnp.concatenate([complete["velocity"], u])
        of_rates = jacobian(lambda z: form.residual(x, z[:size], z[size:], t, params))(both)
        return of_rates, jacobian(lambda x: form.residual(x, both[:size], both[size:], t, params))(x)

    def ask() -> bool:
        of_rates, of_points = evaluated(slopes, {"t": np.zeros(()), **data}, params)
        return _leaves_rates_open(of_rates, of_points, size)

    return _asked.get(by_value(system), ask)


def _leaves_rates_open(of_rates: Any, of_points: Any, size: int) -> bool:
    """Whether r(x, z) = 0, z = (ẋ, u), and the derivatives along ẋ of the equations among them that have no z leave a part of ẋ
    open; `of_rates` and `of_points` are ∂r/∂z and ∂r/∂x."""
    a, b = np.asarray(of_rates, float), np.asarray(of_points, float)
    if not (np.all(np.isfinite(a)) and np.all(np.isfinite(b))):
        return False
    of_rows, of_columns = balancing_scales(np.abs(a))
    left, values, _ = np.linalg.svd(a / of_rows / of_columns)
    zero = values <= SINGULAR * values[0]
    if not np.any(zero):
        return False
    rows = (left[:, zero] / of_rows).T @ b
    if not np.all(np.max(np.abs(rows), axis=1) > SINGULAR * np.max(np.abs(b))):
        return False  # equations of no x at all, of which nothing is to be differentiated
    more = np.concatenate([a, np.pad(rows, ((0, 0), (0, a.shape[1] - size)))])
    scaled = equilibrated(more)[0]
    _, values, right = np.linalg.svd(scaled)
    null = right[np.append(values, np.zeros(len(right) - len(values))) <= SINGULAR * values[0]]
    return bool(np.max(np.abs(null[:, :size]), initial=0.0) > 1e-6)
