"""The premise of steps by a discretization map of one's own: that it is one, asked at initial data."""

import dataclasses

import jax.numpy as jnp
import numpy as np

from dirax.geometry.cotangent_lift import CotangentLift
from dirax.geometry.map_report import defects_at, refuse_other_shapes
from dirax.geometry.maps import AbstractDiscretizationMap
from dirax.schemes.step import StepEquation

KEPT = 1e-6
"""How far (D1), relative to the point, (D2) and the inverse may fail."""


def by_a_discretization_map(map: AbstractDiscretizationMap, equation: StepEquation, of_relation: bool, size: int) -> StepEquation:
    """The equation of steps by a map on the points of a relation form, or on Q, of this size, which refuses initial data where
    the map is not known to be one and is none. Raises `ValueError` for one that returns no such points."""
    if map.is_known:
        return equation
    lifted = isinstance(map, CotangentLift)
    own, size = map.map if lifted else map, size // 2 if lifted and of_relation else size
    refuse_other_shapes(own, size)

    def check(data, h, params):
        equation.check(data, h, params)
        names = ("x",) if "x" in data else ("q", "p") if of_relation else ("q0",) if "q0" in data else ("q",)
        x = np.concatenate([np.asarray(data[name], dtype=float) for name in names])[:size]
        own.manifold(len(x)).check_point(jnp.asarray(x), "the initial point")
        found = defects_at(own, x)
        failed = {
            "(D1) R_d(x, 0) = (x, x)": found.point_defect / (np.max(np.abs(x)) or 1.0),
            "(D2) D_v R_d²(x, 0) − D_v R_d¹(x, 0) = id": found.derivative_defect,
            "R_d⁻¹(R_d(x, 0)) = (x, 0)": found.inverse_defect / (np.max(np.abs(x)) or 1.0),
        }
        missed = [f"{law} fails by {float(off):.2g}" for law, off in failed.items() if float(off) > KEPT]
        if missed:
            raise ValueError(
                f"{type(own).__name__} is not a discretization map at the initial point: {', '.join(missed)}. With one that is "
                "none the steps are those of another system; dx.check_discretization_map(map, x, v) says how far it is off."
            )

    return dataclasses.replace(equation, check=check)
