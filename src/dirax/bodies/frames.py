"""Frames: where a body is and how it moves, in the coordinates of the ground."""

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np

Number: TypeAlias = float | str
"""A number, or the name of one of the model's parameters."""

Vector: TypeAlias = Sequence[Number] | np.ndarray


def scalar(value: Number, params: Any) -> Any:
    """The number, or the parameter of that name."""
    return params[value] if isinstance(value, str) else value


def vector(values: Vector, params: Any) -> Any:
    """The array of such numbers."""
    if not any(isinstance(value, str) for value in values):
        return np.asarray(values, float)
    return jnp.stack([jnp.asarray(scalar(value, params), float) for value in values])


def unit(values: Vector) -> np.ndarray:
    """The direction of a vector, as a vector of length 1."""
    array = np.asarray(values, float)
    return array / np.linalg.norm(array)


def across(axis: Vector) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors that make a right-handed basis with the axis, of the coordinate axes where that can be."""
    a = unit(axis)
    first = np.eye(3)[(int(np.argmax(np.abs(a))) + 1) % 3]
    first = unit(first - (first @ a) * a)
    return first, np.cross(a, first)


def cross(a: Any, b: Any) -> Any:
    """a × b."""
    return jnp.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def turn_matrix(axis: np.ndarray, angle: Any) -> Any:
    """The rotation by `angle` about a unit vector (Rodrigues): (3, 3)."""
    x, y, z = axis
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    along = np.outer(axis, axis)
    return along + jnp.cos(angle) * (np.eye(3) - along) + jnp.sin(angle) * skew


def quaternion_matrix(q: Any) -> Any:
    """The rotation of a quaternion (w, x, y, z), of which only the direction matters: (3, 3)."""
    w, x, y, z = q
    rows = (
        (w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z),
    )
    return jnp.stack([jnp.stack(row) for row in rows]) / (q @ q)


def quaternion_spin(q: Any, v: Any) -> Any:
    """The angular velocity 2 Im(q̇ q̄)/|q|² in the frame that the quaternion turns from: (3,)."""
    return 2 * (q[0] * v[1:] - v[0] * q[1:] + cross(q[1:], v[1:])) / (q @ q)


class Frame(NamedTuple):
    """A frame: its rotation (3, 3) and origin (3,), its angular velocity (3,) and that of its origin (3,), all seen from the
    ground."""

    turn: Any
    at: Any
    spin: Any
    velocity: Any

    def point(self, x: Any) -> Any:
        """Where the point x of the frame is."""
        return self.at + self.turn @ x

    def velocity_of(self, x: Any) -> Any:
        """The velocity of the point x of the frame."""
        return self.velocity + cross(self.spin, self.turn @ x)

    def turning_energy(self, inertia: Any) -> Any:
        """ω·I ω/2 for the inertia (3, 3) in the axes of the frame."""
        spin = self.turn.T @ self.spin
        return spin @ (inertia @ spin) / 2

    def turning_momentum(self, inertia: Any) -> Any:
        """R I Rᵀ ω (3,)."""
        return self.turn @ (inertia @ (self.turn.T @ self.spin))


class Ray(NamedTuple):
    """Where a body is of which only the axis z is known: its direction (3,) with its rate, and the origin with its velocity.

    It has points on the axis alone, and the moment of inertia about what is across it. To what hangs on it, it is a frame that
    does not turn.
    """

    direction: Any
    rate: Any
    at: Any
    velocity: Any

    @property
    def turn(self) -> np.ndarray:
        """No rotation (3, 3)."""
        return np.eye(3)

    @property
    def spin(self) -> np.ndarray:
        """No angular velocity (3,)."""
        return np.zeros(3)

    def point(self, x: Any) -> Any:
        """Where the point x (3,) of the axis is."""
        return self.at + x[2] * self.direction

    def velocity_of(self, x: Any) -> Any:
        """The velocity of the point x (3,) of the axis."""
        return self.velocity + x[2] * self.rate

    def turning_energy(self, inertia: Any) -> Any:
        """I |u̇|²/2."""
        return inertia[0, 0] * (self.rate @ self.rate) / 2

    def turning_momentum(self, inertia: Any) -> Any:
        """I u × u̇ (3,)."""
        return inertia[0, 0] * cross(self.direction, self.rate)


AnyFrame: TypeAlias = Frame | Ray

GROUND = Frame(np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3))
