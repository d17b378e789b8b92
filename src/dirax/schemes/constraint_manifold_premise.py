"""The premise of Method 2 by a projector of the user: the image of the projector is where the constraints hold ([BLM] §7.2)."""

import dataclasses
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np

from dirax.geometry.manifolds import AbstractManifold
from dirax.numerics.tolerances import CONSTRAINT_DEFECT
from dirax.program.tracing import jacobian
from dirax.program.user_functions import evaluated
from dirax.schemes.step import StepEquation
from dirax.systems.system import AbstractSystem


def where_the_constraints_hold(
    system: AbstractSystem, multipliers: int, manifold: AbstractManifold, make: Callable[[], StepEquation]
) -> StepEquation:
    """The equation that is made, which refuses a manifold whose codimension is not the number of multipliers, and one along
    which the constraints change at the initial data."""
    size = manifold.ambient_dimension
    if manifold.dimension != size - multipliers:
        raise ValueError(
            f"Method 2 by a projected map of a {type(system).__name__} with {multipliers} multipliers takes a projector onto its "
            f"constraint manifold, of dimension {size - multipliers} of {size}, but its image has dimension "
            f"{manifold.dimension}; where the constraints have to be differentiated more than once, simulate "
            "dx.constraint_algorithm(system, near=x).resolved()."
        )

    equation = make()

    def at(data, params):
        x, t = system.complete(data, params, False)["x"], data["t"]
        point = manifold.local_parametrization(x)
        constraints = lambda x: system.initial_defect(system.complete({"x": x, "t": t}, params, False), params)
        along = jacobian(lambda r: constraints(point(r)))(jnp.zeros(manifold.dimension))
        return point(jnp.zeros(manifold.dimension)) - x, along, jacobian(constraints)(x), x

    def check(data, h, params):
        equation.check(data, h, params)
        found = evaluated(at, {"t": np.zeros(()), **data}, params)
        off, along, slope, size = (float(np.max(np.abs(np.asarray(a)), initial=0.0)) for a in found)
        if off > CONSTRAINT_DEFECT * (1.0 + size):
            raise ValueError(
                f"the initial point is off the image of the projector by {off:.3g}: start from map.manifold({size}).nearest(x)."
            )
        if along > CONSTRAINT_DEFECT * slope:
            raise ValueError(
                f"the image of the projector is not the constraint manifold of this {type(system).__name__}: along it the "
                f"constraints change at the rate {along:.3g} (off it {slope:.3g}) at the initial point."
            )

    return dataclasses.replace(equation, check=check)
