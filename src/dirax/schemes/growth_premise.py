"""The premise of Method 1 off the midpoint: what is off a constraint is multiplied by no more than 1 in a step."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

from dirax.numerics.tolerances import TINY
from dirax.program.tracing import jacobian
from dirax.program.user_functions import evaluated
from dirax.schemes.step import StepEquation
from dirax.systems.system import AbstractSystem

SHORT = 1e-6
"""The part of a step in which the motion itself grows by nothing that counts, and what is off a constraint as in a whole one."""

GROWTH = 1e-4
"""Factors up to 1 + GROWTH are those of the motion in such a step."""

BOUNDLESS = 1e6
"""Factors from which on one is that of a division by zero."""

WAY_OUT = 'Take dx.Midpoint(), a map with the base point on its other side, or constraints="resolve".'


class NothingGrows:
    """The check of an equation, called with (data, h, params), which refuses one with a mode that no step h is too short for.

    A base point at the fraction θ of a step has the momentum (1 − θ)p_k + θp_{k+1}, or the coordinates x of another space
    (1 − θ)x_k + θx_{k+1}, where a constraint at the base point says what it is: p_{k+1} = … − (1 − θ)/θ p_k, whatever h.
    With `inverse` it is the check of the adjoint; `at_end` says that a constraint at the base point restricts p_k alone.
    """

    def __init__(self, system: AbstractSystem, equation: StepEquation, at_end: bool = False, inverse: bool = False):
        self.system, self.equation, self.at_end, self.inverse = system, equation, at_end, inverse
        self.slopes = _slopes_of(system, equation)

    @property
    def of_adjoint(self) -> "NothingGrows":
        """The check of the adjoint of the equation, which has the inverse factors."""
        return NothingGrows(self.system, self.equation, self.at_end, not self.inverse)

    def __call__(self, data: dict[str, Any], h: Any, params: Any) -> None:
        self.equation.check(data, h, params)
        if "q0" in data:
            return
        of_system = f"the constraints of this {type(self.system).__name__}"
        if self.at_end and not self.inverse:
            raise ValueError(
                f"a step of this scheme has the forces of {of_system} after its base point alone, which is its end with the "
                f"momentum of its beginning: the constraints there restrict that one and leave the forces free. {WAY_OUT}"
            )
        data = {name: np.asarray(a) for name, a in data.items()}
        whole = np.asarray(evaluated(self.slopes, data, np.asarray(float(h)), params))
        factor = self._largest(whole)
        if factor > 1.0 + GROWTH:
            by = f"by −{factor:.3g}" if factor < BOUNDLESS else "without bound"
            raise ValueError(
                f"a step of this scheme multiplies what is off {of_system} {by}, whatever its size: their forces are those of a "
                f"base point that is not in the middle of the step. {WAY_OUT}"
            )

    def _largest(self, whole: np.ndarray) -> float:
        """The largest factor by which a state is multiplied in a short step."""
        k = self.equation.unknowns
        by_u, by_x, then_u, then_x = whole[:k, :k], whole[:k, k:], whole[k:, :k], whole[k:, k:]
        if not np.all(np.isfinite(whole)):
            return 0.0  # outside the domain, which the first step tells
        try:
            step = then_x - then_u @ np.linalg.solve(by_u, by_x)
        except np.linalg.LinAlgError:  # a singular step is refused as such
            return 0.0
        if not np.all(np.isfinite(step)):
            return 0.0
        sizes = np.abs(np.linalg.eigvals(step))
        return float(1.0 / max(np.min(sizes), TINY) if self.inverse else np.max(sizes))


def _slopes_of(system: AbstractSystem, equation: StepEquation):
    """(data, h, params) ↦ ∂(r, a)/∂(u, x) of residual and advance in a short step from the data."""

    def slopes(data, h, params):
        data = {"t": jnp.zeros(()), **data}
        state, u = equation.start(system.complete(data, params, False), h, params)
        k, short = equation.unknowns, SHORT * h

        def both(z):
            at = z[:k], z[k:], data["t"], short, params
            return jnp.concatenate([equation.residual(*at), equation.advance(*at)])

        return jacobian(both)(jnp.concatenate([u, state]))

    return slopes


def nothing_grows(system: AbstractSystem, equation: StepEquation, at_end: bool) -> StepEquation:
    """The equation, which refuses initial data at which a step multiplies what is off a constraint by more than 1, and any
    where its forces are `at_end` of it."""
    return dataclasses.replace(equation, check=NothingGrows(system, equation, at_end))
