"""The planar double pendulum in Cartesian coordinates: two point masses and two rods as holonomic constraints.

q = (x1, y1, x2, y2), y upwards, the pivot at the origin:

    L = m1 |q̇1|²/2 + m2 |q̇2|²/2 − m1 g y1 − m2 g y2,   (|q1|² − l1²)/2 = 0,   (|q2 − q1|² − l2²)/2 = 0.

With these constraints the multipliers of a step, divided by h, are the tensions of the rods over their lengths. The
motion is that of `double_pendulum` in angles. Lengths in m, masses in kg, time in s; energy in J.
"""

import jax.numpy as jnp
import numpy as np

from dirax.gallery import double_pendulum
from dirax.gallery.example import Coordinate, Example
from dirax.show.scene import Scene, point, rod
from dirax.systems.lagrange_dirac import LagrangeDirac

PARAMS = double_pendulum.PARAMS


def lagrangian(q, v, params):
    """L(q, v) in J for positions q and velocities v of shape (4,)."""
    m1, m2, g = (params[name] for name in ("m1", "m2", "g"))
    return m1 * v[:2] @ v[:2] / 2 + m2 * v[2:] @ v[2:] / 2 - g * (m1 * q[1] + m2 * q[3])


def rods(q, params):
    """(|q1|² − l1²)/2 and (|q2 − q1|² − l2²)/2 in m², shape (2,)."""
    arm = q[2:] - q[:2]
    return jnp.stack([q[:2] @ q[:2] - params["l1"] ** 2, arm @ arm - params["l2"] ** 2]) / 2


def from_angles(angles, rates, params=PARAMS) -> dict[str, np.ndarray]:
    """Initial data q and v for angles from the downward vertical and their rates, each of shape (2,)."""
    lengths = np.array([params["l1"], params["l2"]])[:, None]
    angles, rates = np.asarray(angles, float), np.asarray(rates, float)
    arms = lengths * np.stack([np.sin(angles), -np.cos(angles)], axis=1)
    speeds = rates[:, None] * lengths * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return {"q": np.cumsum(arms, axis=0).ravel(), "v": np.cumsum(speeds, axis=0).ravel()}


def scene() -> Scene:
    """Two rods and two bobs: y upwards."""
    upright = lambda x, y: jnp.stack([x, jnp.zeros(()), y])
    first, second, pivot = (lambda q: upright(q[0], q[1])), (lambda q: upright(q[2], q[3])), [0.0, 0.0, 0.0]
    bobs = (point(pivot, radius=0.03, colour="ink"), point(first, radius=0.07), point(second, radius=0.07, trail=True, colour=1))
    return Scene((rod(pivot, first), rod(first, second), *bobs), view="front")


EXAMPLE = Example(
    name="cartesian-double-pendulum",
    title="Double pendulum in Cartesian coordinates",
    source="Landau & Lifshitz, Mechanics, §5, with the rods as constraints",
    system=LagrangeDirac(lagrangian, holonomic=rods),
    params=PARAMS,
    initial=from_angles(double_pendulum.EXAMPLE.initial["q"], double_pendulum.EXAMPLE.initial["v"]),
    step=2e-3,
    steps=10_000,
    coordinates=tuple(Coordinate(name, "m") for name in ("x1", "y1", "x2", "y2")),
    plane=(2, 3),
    time_unit="s",
    energy_unit="J",
    scene=scene(),
)
