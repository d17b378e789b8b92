"""Contacts: a body that touches the ground, and rolls on it, skates or slides.

The contact is a holonomic constraint, that the gap be zero, and rolling the one-forms of the velocity of the material point
there, which are found by differentiation.
"""

from dataclasses import dataclass
from typing import Any, TypeAlias

import jax.numpy as jnp
import numpy as np

from dirax.bodies.frames import AnyFrame, Number, Vector, across, cross, scalar, unit, vector

ORIGIN = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Round:
    """A circle of this `radius` around `axis`, thickened by `tube`: a thin disc, a torus, and with radius 0 a ball."""

    radius: Number
    tube: Number
    axis: Vector

    def support(self, frame: AnyFrame, normal: Any, params: Any) -> Any:
        """From the middle to the lowest point (3,), as seen from the ground."""
        low = -scalar(self.tube, params) * normal
        if isinstance(self.radius, float | int) and self.radius == 0:
            return low
        axis = frame.turn @ unit(self.axis)
        up = normal - (normal @ axis) * axis
        return low - scalar(self.radius, params) * up / jnp.sqrt(up @ up)


@dataclass(frozen=True)
class Ellipsoid:
    """Of three semi-axes along those of the body's frame."""

    semi_axes: Vector

    def support(self, frame: AnyFrame, normal: Any, params: Any) -> Any:
        """From the middle to the lowest point (3,), as seen from the ground."""
        scaled = vector(self.semi_axes, params) * (frame.turn.T @ normal)
        return -(frame.turn @ (vector(self.semi_axes, params) * scaled)) / jnp.sqrt(scaled @ scaled)


Shape: TypeAlias = Round | Ellipsoid


@dataclass(frozen=True)
class Contact:
    """Where a body touches the ground, made by `wheel`, `ball_contact`, `ellipsoid`, `blade` and `tip`.

    - `motion`: "rolls" without slipping, "skates" along `along` (3,) of the body's frame, or "slides" freely;
    - `spins`: whether it may turn about the normal;
    - `drag`: force per speed of slipping, and `friction`: the coefficient of Coulomb's law, of what slides; below the speed
      `creep` it is proportional to the slipping: a thousandth of √(g ℓ), ℓ the largest length of the machine, unless given;
    - the ground is the plane through `ground` (3,) across `normal` (3,), or the surface over which its joint glides.
    """

    name: str
    body: str
    shape: Shape
    centre: Vector = ORIGIN
    motion: str = "rolls"
    spins: bool = True
    along: Vector = (1.0, 0.0, 0.0)
    drag: Number = 0.0
    friction: Number = 0.0
    creep: Number = 0.0
    normal: Vector = (0.0, 0.0, 1.0)
    ground: Vector = ORIGIN

    @property
    def rows(self) -> tuple[str, ...]:
        """The names of its one-forms."""
        found = {"rolls": ("rolls along", "rolls aside"), "skates": ("skates",), "slides": ()}[self.motion]
        return found if self.spins else (*found, "does not spin")

    @property
    def is_thin_wheel(self) -> bool:
        """Whether it is a thin disc of a radius in numbers that rolls on the plane z = 0 and may turn on the spot."""
        shape, level = self.shape, np.allclose(unit(self.normal), (0.0, 0.0, 1.0)) and not np.any(np.asarray(self.ground, float))
        thin = isinstance(shape, Round) and shape.tube == 0 and shape.radius != 0 and not isinstance(shape.radius, str)
        return level and thin and self.motion == "rolls" and self.spins

    def gap(self, frame: AnyFrame, params: Any) -> Any:
        """The height of its lowest point over the plane."""
        normal = unit(self.normal)
        low = frame.point(vector(self.centre, params)) + self.shape.support(frame, normal, params)
        return normal @ (low - np.asarray(self.ground, float))

    def slip(self, frame: AnyFrame, normal: Any, params: Any) -> Any:
        """The velocity (3,) of the material point that touches."""
        return frame.velocity_of(vector(self.centre, params)) + cross(frame.spin, self.shape.support(frame, normal, params))

    def tangents(self, normal: Any) -> tuple[Any, Any]:
        """Two directions (3,) along the ground."""
        if isinstance(normal, np.ndarray):
            return across(normal)
        return cross(np.array([0.0, 1.0, 0.0]), normal), cross(normal, np.array([1.0, 0.0, 0.0]))

    def rates(self, frame: AnyFrame, normal: Any, params: Any) -> list[Any]:
        """What is zero where it rolls, skates or does not spin: linear in the velocities."""
        slip, found = self.slip(frame, normal, params), []
        if self.motion == "rolls":
            found += [t @ slip for t in self.tangents(normal)]
        if self.motion == "skates":
            found.append(cross(normal, frame.turn @ unit(self.along)) @ slip)
        return found if self.spins else [*found, normal @ frame.spin]

    def force(self, frame: AnyFrame, normal: Any, pressure: Any, creep: Any, params: Any) -> Any:
        """The force (3,) of drag and friction on what slides, under the normal force `pressure`."""
        slip = self.slip(frame, normal, params)
        slip = slip - (normal @ slip) * normal
        rate = scalar(self.drag, params)
        if self.rubs:
            rate += scalar(self.friction, params) * pressure / jnp.sqrt(slip @ slip + creep**2)
        return -rate * slip

    @property
    def resists(self) -> bool:
        """Whether sliding has a force."""
        return self.drag != 0 or self.rubs

    @property
    def rubs(self) -> bool:
        """Whether that force is of the normal force."""
        return self.friction != 0


def wheel(body: str, radius: Number, axis: Vector = (0.0, 1.0, 0.0), tube: Number = 0.0, name: str = "", **more: Any) -> Contact:
    """A wheel or disc around `axis` of the body's frame, thin, or with a rim of radius `tube` around the circle of `radius`.
    `more`: centre=, motion=, spins=, drag=, friction=, creep=, normal=, ground=, as of every contact here."""
    return Contact(name or body, body, Round(radius, tube, axis), **more)


def ball_contact(body: str, radius: Number, name: str = "", **more: Any) -> Contact:
    """A ball around `centre` of the body's frame."""
    return Contact(name or body, body, Round(0.0, radius, (0.0, 0.0, 1.0)), **more)


def ellipsoid(body: str, semi_axes: Vector, name: str = "", **more: Any) -> Contact:
    """An ellipsoid around `centre`, with semi-axes along those of the body's frame."""
    return Contact(name or body, body, Ellipsoid(tuple(semi_axes)), **more)


def blade(body: str, at: Vector = ORIGIN, along: Vector = (1.0, 0.0, 0.0), name: str = "", **more: Any) -> Contact:
    """A skate at the point `at` of the body's frame, which moves along `along` alone."""
    return Contact(name or body, body, Round(0.0, 0.0, (0.0, 0.0, 1.0)), centre=at, motion="skates", along=along, **more)


def tip(body: str, at: Vector = ORIGIN, name: str = "", **more: Any) -> Contact:
    """A point of the body that touches; with motion="slides" it slides."""
    return Contact(name or body, body, Round(0.0, 0.0, (0.0, 0.0, 1.0)), centre=at, **more)
