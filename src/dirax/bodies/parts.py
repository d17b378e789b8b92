"""Body: what moves, with its mass and its inertia."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import jax.numpy as jnp
import numpy as np

from dirax.bodies.frames import AnyFrame, Number, Vector, scalar, vector

Inertia: TypeAlias = Sequence[Number] | Sequence[Sequence[Number]] | np.ndarray


@dataclass(frozen=True)
class Body:
    """A rigid body.

    - `mass`; `centre` (3,), the mass centre in the body's frame, its origin by default;
    - `inertia` about the mass centre, in the axes of the body's frame: three principal moments, or the matrix (3, 3);
      none is larger than the others together, but for (0, 0, J) of a body in a plane.

    The body's frame is where its joint puts it. Units are the user's.
    """

    name: str
    mass: Number = 0.0
    inertia: Inertia = (0.0, 0.0, 0.0)
    centre: Vector = (0.0, 0.0, 0.0)

    def inertia_matrix(self, params: Any) -> Any:
        """(3, 3)."""
        if np.ndim(self.inertia) == 1:
            return vector(self.inertia, params) * np.eye(3)  # type: ignore[arg-type]
        rows = [vector(row, params) for row in self.inertia]  # type: ignore[arg-type]
        matrix = np.stack(rows) if all(isinstance(row, np.ndarray) for row in rows) else jnp.stack(rows)
        return (matrix + matrix.T) / 2  # what was turned is symmetric to rounding alone

    def kinetic_energy(self, frame: AnyFrame, params: Any) -> Any:
        """m |ċ|²/2 + ω·I ω/2."""
        u = frame.velocity_of(vector(self.centre, params))
        return scalar(self.mass, params) * (u @ u) / 2 + frame.turning_energy(self.inertia_matrix(params))

    def momentum(self, frame: AnyFrame, params: Any) -> Any:
        """m ċ (3,)."""
        return scalar(self.mass, params) * frame.velocity_of(vector(self.centre, params))

    def angular_momentum(self, frame: AnyFrame, about: Any, params: Any) -> Any:
        """(c − about) × m ċ + R I Rᵀ ω (3,)."""
        arm = frame.point(vector(self.centre, params)) - about
        return jnp.cross(arm, self.momentum(frame, params)) + frame.turning_momentum(self.inertia_matrix(params))


def rod(name: str, end: Vector, mass: Number = 1.0) -> Body:
    """A thin uniform rod from the origin of the body's frame to `end` (3,): I = m (|e|² − e eᵀ)/12. A `mass` that is a parameter
    is no number to multiply with, hence raises `TypeError`."""
    if isinstance(mass, str):
        raise TypeError(f"the mass of rod {name!r} must be a number, but it is {mass!r}: state a Body with its inertia.")
    along = np.asarray(end, float)
    return Body(name, mass, mass * (along @ along * np.eye(3) - np.outer(along, along)) / 12, along / 2)
