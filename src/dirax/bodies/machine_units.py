"""The units in which a machine is judged: its coordinates that are lengths in that of its own lengths."""

from collections.abc import Iterator
from functools import reduce
from typing import Any

import jax.numpy as jnp
import numpy as np

from dirax.bodies.contacts import Contact, Ellipsoid
from dirax.bodies.frames import scalar, vector
from dirax.bodies.motion import Glide, Shift
from dirax.numerics.equilibration import power_of_two

CREEP = 1e-3
"""Speed of slipping below which Coulomb friction is proportional to it, as a part of √(g ℓ), where nothing else is said."""


def coordinate_units(model: Any, params: Any) -> np.ndarray:
    """(n,): of a length the power of two nearest to the largest length that the machine is stated with, of others 1."""
    largest = float(largest_length(model, params))
    length = float(power_of_two(np.asarray(largest))) if largest > 0.0 else 1.0
    return np.array([length if quantity == "length" else 1.0 for quantity in model.quantities])


def largest_length(model: Any, params: Any) -> Any:
    """Of those that the machine is stated with; 0 where there is none."""
    lengths = list(_lengths(model))
    stated = max((abs(float(x)) for x in lengths if not isinstance(x, str)), default=0.0)
    return reduce(jnp.maximum, (jnp.abs(params[x]) for x in lengths if isinstance(x, str)), stated)


def creep(model: Any, contact: Contact, params: Any) -> Any:
    """The speed of slipping below which the friction of a contact is proportional to it."""
    if contact.creep != 0:
        return scalar(contact.creep, params)
    gravity = vector(model.gravity, params)
    return CREEP * jnp.sqrt(jnp.sqrt(gravity @ gravity) * largest_length(model, params))


def has_creep(model: Any, contact: Contact) -> bool:
    """Whether there is such a speed: it is given, or there are gravity and a length."""
    some = lambda numbers: any(isinstance(x, str) or x != 0 for x in numbers)
    return contact.creep != 0 or (some(model.gravity) and some(_lengths(model)))


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
