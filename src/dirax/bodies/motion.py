"""Motions: the elementary ways in which a joint moves a frame, each with its own coordinates."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, TypeAlias

import jax.numpy as jnp

from dirax.bodies.frames import Frame, Ray, Vector, cross, quaternion_matrix, quaternion_spin, turn_matrix, unit, vector
from dirax.geometry.lie_groups import SO3
from dirax.geometry.maps import AbstractDiscretizationMap, LieGroupExp, SphereProjection
from dirax.program.tracing import along, gradient


@dataclass(frozen=True)
class Shift:
    """By a vector (3,) of the frame, once and for all."""

    measures: ClassVar[str] = ""
    by: Vector
    names: tuple[str, ...] = ()

    def move(self, frame: Frame, q: Any, v: Any, params: Any) -> Frame:
        """The frame moved, for the coordinates q and their rates v."""
        by = vector(self.by, params)
        return frame._replace(at=frame.point(by), velocity=frame.velocity_of(by))


@dataclass(frozen=True)
class TurnBy:
    """By a fixed angle (rad) about an axis (3,), once and for all."""

    measures: ClassVar[str] = ""
    axis: Vector
    angle: float
    names: tuple[str, ...] = ()

    def move(self, frame: Frame, q: Any, v: Any, params: Any) -> Frame:
        """The frame moved, for the coordinates q and their rates v."""
        return frame._replace(turn=frame.turn @ turn_matrix(unit(self.axis), jnp.asarray(self.angle)))


@dataclass(frozen=True)
class Slide:
    """Along an axis (3,) of the frame, by a length that is the coordinate."""

    measures: ClassVar[str] = "length"
    axis: Vector
    names: tuple[str, ...]

    def move(self, frame: Frame, q: Any, v: Any, params: Any) -> Frame:
        """The frame moved, for the coordinates q and their rates v."""
        axis = frame.turn @ unit(self.axis)
        by = axis * q[0]
        return frame._replace(at=frame.at + by, velocity=frame.velocity + cross(frame.spin, by) + axis * v[0])


@dataclass(frozen=True)
class Turn:
    """About an axis (3,) of the frame, by an angle (rad) that is the coordinate."""

    measures: ClassVar[str] = "angle"
    axis: Vector
    names: tuple[str, ...]

    def move(self, frame: Frame, q: Any, v: Any, params: Any) -> Frame:
        """The frame moved, for the coordinates q and their rates v."""
        axis = unit(self.axis)
        return frame._replace(turn=frame.turn @ turn_matrix(axis, q[0]), spin=frame.spin + (frame.turn @ axis) * v[0])


@dataclass(frozen=True)
class Quaternion:
    """By a unit quaternion (w, x, y, z), whose four numbers are coordinates, with |Q| = 1 as a holonomic constraint: from the
    frame, or `from_ground`, whatever the frame's own rotation is."""

    measures: ClassVar[str] = ""
    norm: ClassVar[str] = "|Q| = 1"
    rest: ClassVar[tuple[float, ...]] = (1.0, 0.0, 0.0, 0.0)
    names: tuple[str, ...]
    from_ground: bool = False

    def discretization_map(self) -> AbstractDiscretizationMap:
        """The middle of the one-parameter subgroup between two rotations."""
        return LieGroupExp(SO3())

    def move(self, frame: Frame, q: Any, v: Any, params: Any) -> Frame:
        """The frame moved, for the coordinates q and their rates v."""
        if self.from_ground:
            return Frame(quaternion_matrix(q), frame.at, quaternion_spin(q, v), frame.velocity)
        spin = frame.spin + frame.turn @ quaternion_spin(q, v)
        return frame._replace(turn=frame.turn @ quaternion_matrix(q), spin=spin)


@dataclass(frozen=True)
class Direct:
    """Of an axis z to a direction, a unit vector as seen from the ground, whose three numbers are coordinates, with |u| = 1 as a
    holonomic constraint. Nothing is said of turns about the axis."""

    measures: ClassVar[str] = ""
    norm: ClassVar[str] = "|u| = 1"
    rest: ClassVar[tuple[float, ...]] = (0.0, 0.0, 1.0)
    names: tuple[str, ...]

    def discretization_map(self) -> AbstractDiscretizationMap:
        """The middle of the arc between two directions."""
        return SphereProjection()

    def move(self, frame: Frame, q: Any, v: Any, params: Any) -> Ray:
        """The axis at the frame's origin, for the coordinates q and their rates v."""
        return Ray(q, v, frame.at, frame.velocity)


@dataclass(frozen=True)
class Glide:
    """Over the surface z = height(x, y) of the frame, at a distance from it along its normal; x and y of the point below are
    the coordinates. The frame does not turn, or where it `leans` its z turns to the normal and its x stays over the x axis."""

    measures: ClassVar[str] = "length"
    height: Callable
    distance: float
    names: tuple[str, ...]
    leans: bool = False

    def below(self, q: Any) -> Any:
        """The point of the surface (3,)."""
        return jnp.stack([q[0], q[1], self.height(q[0], q[1])])

    def _slope(self, q: Any) -> Any:
        return gradient(lambda xy: self.height(xy[0], xy[1]))(jnp.stack([q[0], q[1]]))

    def normal(self, q: Any) -> Any:
        """The unit normal there, upwards (3,)."""
        slope = self._slope(q)
        return jnp.stack([-slope[0], -slope[1], jnp.ones(())]) / jnp.sqrt(1.0 + slope @ slope)

    def _lean(self, q: Any) -> tuple[Any, Any, Any]:
        """The axes that lean, each (3,)."""
        slope, normal = self._slope(q)[0], self.normal(q)
        first = jnp.stack([jnp.ones(()), jnp.zeros(()), slope]) / jnp.sqrt(1.0 + slope**2)
        return first, cross(normal, first), normal

    def move(self, frame: Frame, q: Any, v: Any, params: Any) -> Frame:
        """The frame moved, for the coordinates q and their rates v."""
        place = lambda q: self.below(q) + self.distance * self.normal(q)
        by = frame.turn @ place(q)
        rate = frame.turn @ along(place, (q,), (v,))
        moved = frame._replace(at=frame.at + by, velocity=frame.velocity + cross(frame.spin, by) + rate)
        if not self.leans:
            return moved
        lean = lambda q: jnp.stack(self._lean(q))
        axes, rates = lean(q), along(lean, (q,), (v,))
        spin = sum(cross(axis, rate) for axis, rate in zip(axes, rates, strict=True)) / 2
        return moved._replace(turn=frame.turn @ axes.T, spin=frame.spin + frame.turn @ spin)


Motion: TypeAlias = Shift | TurnBy | Slide | Turn | Quaternion | Direct | Glide
