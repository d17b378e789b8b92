"""The Hénon–Heiles system: a star in the plane of a galaxy, regular or chaotic according to its energy.

    L = (ẋ² + ẏ²)/2 − (x² + y²)/2 − x² y + y³/3

M. Hénon, C. Heiles, The applicability of the third integral of motion, Astron. J. 69 (1964) 73–79. Below the energy 1/6
the motion is bounded; the data have energy 1/8, where regular and chaotic orbits live side by side.
"""

import numpy as np

from dirax.gallery.example import Coordinate, Example
from dirax.show.scene import Scene, plane, point
from dirax.systems.lagrange_dirac import LagrangeDirac

ENERGY = 1 / 8


def lagrangian(q, v):
    """L(q, v), a scalar, for q = (x, y)."""
    x, y = q
    return v @ v / 2 - (x**2 + y**2) / 2 - x**2 * y + y**3 / 3


def _velocity(y: float) -> float:
    """ẋ at (0, y) with ẏ = 0 on the energy surface."""
    return np.sqrt(2 * ENERGY - y**2 + 2 * y**3 / 3)


def scene() -> Scene:
    """The star in its plane."""
    return Scene((plane(), point(lambda q: q, trail=True)), view="tilted")


EXAMPLE = Example(
    name="henon-heiles",
    title="Hénon–Heiles system",
    source="Hénon & Heiles, Astron. J. 69 (1964) 73",
    system=LagrangeDirac(lagrangian),
    initial={"q": np.array([0.0, 0.1]), "v": np.array([_velocity(0.1), 0.0])},
    step=0.05,
    steps=10_000,
    coordinates=(Coordinate("x"), Coordinate("y")),
    scene=scene(),
)
