"""Springs, dampers and motors, between points of two bodies or at a coordinate."""

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import jax.numpy as jnp

from dirax.bodies.frames import AnyFrame, Number, Vector, scalar, vector
from dirax.text.representation import error_text

Points: TypeAlias = tuple[tuple[str, Vector], tuple[str, Vector]]
"""Two points, each of a body (or of "ground") in its frame."""


@dataclass(frozen=True)
class Spring:
    """A potential k (l − l₀)²/2 of the distance l of two points, or of a coordinate. Force per length, or torque per rad."""

    stiffness: Number
    between: Points | None = None
    coordinate: str = ""
    length: Number = 0.0
    name: str = "spring"

    def energy(self, frames: Mapping[str, AnyFrame], q: Mapping[str, Any], params: Any) -> Any:
        """The potential energy."""
        if self.between is None:
            extended = q[self.coordinate]
        else:
            apart = apart_of(self.between, frames, params)
            if not isinstance(self.length, str) and self.length == 0:
                return scalar(self.stiffness, params) * (apart @ apart) / 2
            extended = jnp.sqrt(apart @ apart)
        return scalar(self.stiffness, params) * (extended - scalar(self.length, params)) ** 2 / 2


@dataclass(frozen=True)
class Damper:
    """A force −c l̇ along the line of two points, or a force or torque −c q̇ at a coordinate."""

    rate: Number
    between: Points | None = None
    coordinate: str = ""
    name: str = "damper"

    def power(self, frames: Any, moved: Any, t: Any, q: Any, v: Any, w: Any, params: Any) -> Any:
        """The power of its force at (q, v) along the velocities w, of which `moved` are the frames."""
        if self.between is None:
            return -scalar(self.rate, params) * v[self.coordinate] * w[self.coordinate]
        apart = apart_of(self.between, frames, params)
        along = apart / jnp.sqrt(apart @ apart)
        first, second = self.between
        speed = lambda of: along @ (velocity_of(second, of, params) - velocity_of(first, of, params))
        return -scalar(self.rate, params) * speed(frames) * speed(moved)


@dataclass(frozen=True)
class Motor:
    """A force or torque `push` at a coordinate: a number, or a function (t, q, v) or (t, q, v, params) of the time and of the
    coordinates and velocities by their names."""

    coordinate: str
    push: Number | Callable
    name: str = "motor"

    def power(self, frames: Any, moved: Any, t: Any, q: Any, v: Any, w: Any, params: Any) -> Any:
        """As of a damper."""
        push: Any = self.push
        if not callable(push):
            return scalar(push, params) * w[self.coordinate]
        more = (params,) if len(inspect.signature(push).parameters) > 3 else ()
        try:
            found = jnp.asarray(push(t, q, v, *more))
        except Exception as error:
            raise TypeError(
                f"the push of {self.name!r} at {self.coordinate!r} could not be traced by JAX: {error_text(error)}"
            ) from error
        if found.shape != ():
            raise ValueError(f"the push of {self.name!r} must be one number, but its shape is {found.shape}.")
        return found * w[self.coordinate]


def apart_of(between: Points, frames: Mapping[str, AnyFrame], params: Any) -> Any:
    """From the first point to the second one (3,)."""
    (first, a), (second, b) = between
    return frames[second].point(vector(b, params)) - frames[first].point(vector(a, params))


def velocity_of(point: tuple[str, Vector], frames: Mapping[str, AnyFrame], params: Any) -> Any:
    """The velocity of a point of a body (3,)."""
    return frames[point[0]].velocity_of(vector(point[1], params))
