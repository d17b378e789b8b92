"""The units in which a machine is judged: its coordinates that are lengths in that of its own lengths."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from dirax.bodies.contacts import Ellipsoid
from dirax.bodies.motion import Glide, Shift
from dirax.numerics.equilibration import power_of_two


def coordinate_units(model: Any, params: Any) -> np.ndarray:
    """(n,): of a length the power of two nearest to the largest length that the machine is stated with, of others 1."""
    largest = max((abs(float(params[x] if isinstance(x, str) else x)) for x in _lengths(model)), default=0.0)
    length = float(power_of_two(np.asarray(largest))) if largest > 0.0 else 1.0
    return np.array([length if quantity == "length" else 1.0 for quantity in model.quantities])


def _lengths(model: Any) -> Iterator[Any]:
    """The numbers of all points and sizes, parameters by their names."""
    for body in model.bodies:
        yield from body.centre
    for joint in model.joints:
        yield from (*joint.at, *joint.on)
        for motion in joint.motions:
            if isinstance(motion, Shift):
                yield from motion.by
            if isinstance(motion, Glide):
                yield motion.distance
    for contact in model.contacts:
        yield from (*contact.centre, *contact.ground)
        shape = contact.shape
        yield from shape.semi_axes if isinstance(shape, Ellipsoid) else (shape.radius, shape.tube)
    for force in model.forces:
        for _, at in getattr(force, "between", None) or ():
            yield from at
