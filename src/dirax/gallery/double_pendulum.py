"""The planar double pendulum: two point masses on massless rods, the simplest mechanism that moves chaotically.

    L = (m1 + m2) l1² θ̇1²/2 + m2 l2² θ̇2²/2 + m2 l1 l2 θ̇1 θ̇2 cos(θ1 − θ2) + (m1 + m2) g l1 cos θ1 + m2 g l2 cos θ2

Angles from the downward vertical in rad, lengths in m, masses in kg, time in s; energy in J.
Landau & Lifshitz, Mechanics, §5, problem 1.
"""

import jax.numpy as jnp
import numpy as np

from dirax.gallery.example import Coordinate, Example
from dirax.show.scene import Scene, point, rod
from dirax.systems.lagrange_dirac import LagrangeDirac

PARAMS = {"m1": 1.0, "m2": 1.0, "l1": 1.0, "l2": 1.0, "g": 9.81}


def lagrangian(q, v, params):
    """L(q, v) in J for angles q and angular velocities v of shape (2,)."""
    m1, m2, l1, l2, g = (params[name] for name in ("m1", "m2", "l1", "l2", "g"))
    own = (m1 + m2) * (l1 * v[0]) ** 2 / 2 + m2 * (l2 * v[1]) ** 2 / 2
    mixed = m2 * l1 * l2 * v[0] * v[1] * jnp.cos(q[0] - q[1])
    return own + mixed + (m1 + m2) * g * l1 * jnp.cos(q[0]) + m2 * g * l2 * jnp.cos(q[1])


def arms(q, params):
    """The two bobs, (2, 3): x to the right, z up."""
    lengths = jnp.stack([jnp.asarray(params["l1"], float), jnp.asarray(params["l2"], float)])
    places = jnp.cumsum(lengths[:, None] * jnp.stack([jnp.sin(q), jnp.zeros(2), -jnp.cos(q)], axis=1), axis=0)
    return places


def scene() -> Scene:
    """Two rods and two bobs."""
    first, second = (lambda q, params: arms(q, params)[0]), (lambda q, params: arms(q, params)[1])
    pivot = [0.0, 0.0, 0.0]
    bobs = (point(pivot, radius=0.03, colour="ink"), point(first, radius=0.07), point(second, radius=0.07, trail=True, colour=1))
    return Scene((rod(pivot, first), rod(first, second), *bobs), view="front")


EXAMPLE = Example(
    name="double-pendulum",
    title="Planar double pendulum",
    source="Landau & Lifshitz, Mechanics, §5",
    system=LagrangeDirac(lagrangian),
    params=PARAMS,
    initial={"q": np.array([2.0, 2.5]), "v": np.zeros(2)},
    step=2e-3,
    steps=10_000,
    coordinates=(Coordinate("θ1", "rad"), Coordinate("θ2", "rad")),
    time_unit="s",
    energy_unit="J",
    scene=scene(),
)
