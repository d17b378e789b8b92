"""Euler's disk: a thin disc that rolls on a plane while its point of contact runs round, the middle at rest.

Where its plane is inclined by α against the ground, the contact runs round with Ω² = 4 g/(R sin α) (Moffatt 2000): a relative
equilibrium. Coordinates: point of contact, yaw of the heading, roll (π/2 − α against upright), spin about the axle. SI units.
"""

import math

import jax.numpy as jnp
import numpy as np

from dirax.bodies import Body, Model, rolling_wheel, wheel
from dirax.gallery.machine import machine

RADIUS, MASS, GRAVITY = 0.0375, 0.4499, 9.81
MODEL = Model(
    bodies=[Body("disc", MASS, MASS * RADIUS**2 * np.array([0.25, 0.5, 0.25]))],
    joints=[rolling_wheel("ground", "disc", RADIUS)],
    contacts=[wheel("disc", RADIUS)],
    gravity=(0.0, 0.0, -GRAVITY),
)


def steady(inclination: float) -> dict[str, np.ndarray]:
    """The steady motion at an inclination (rad) of the disc's plane, the middle above the origin."""
    rate, lean = math.sqrt(4 * GRAVITY / (RADIUS * math.sin(inclination))), math.pi / 2 - inclination
    start = {"disc.y": RADIUS * math.sin(lean), "disc.roll": lean}
    return MODEL.state(start, {"disc.yaw": rate, "disc.roll": 0.0, "disc.spin": -rate * math.sin(lean)})


SYMMETRIES = {
    "turns about the vertical": lambda q: jnp.stack([-q[1], q[0], jnp.ones(()), jnp.zeros(()), jnp.zeros(())]),
    "x": lambda q: jnp.eye(5)[0],
    "y": lambda q: jnp.eye(5)[1],
    "spin": lambda q: jnp.eye(5)[4],
}
"""Infinitesimal generators."""

EXAMPLE = machine(
    "euler-disk",
    "Euler's disk, rolling without slipping",
    "Moffatt, Nature 404 (2000): Ω² sin α = 4 g/R",
    MODEL,
    MODEL.state({"disc.roll": 1.2}, {"disc.yaw": 30.0, "disc.roll": 1.0, "disc.spin": -25.0}),
    step=5e-4,
    steps=2000,
)
