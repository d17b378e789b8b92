"""The double spherical pendulum in the angles of [RL] §7.2; the same pendulum on S² × S² is `spherical-pendulums`.

q = (ϑ1, φ1, ϑ2, φ2): the links have azimuths θ1 = ϑ1 − ϑ2 and θ2 = ϑ1 + ϑ2 and angles φ1, φ2 from the upward vertical.
With r1 and r2 the positions of the masses,

    L = m1 |ṙ1|²/2 + m2 |ṙ2|²/2 − m1 g r1_3 − m2 g r2_3

ϑ1 is cyclic: turns of both links about the vertical. SI units and data of the paper. The angles end at the poles
φ = 0, π, where the action is not free either ([RL] Remark 7.1).
"""

import jax.numpy as jnp
import numpy as np

from dirax.gallery.example import Coordinate, Example
from dirax.schemes.lagrange_dirac import PlusLagrangeDirac
from dirax.show.scene import Scene, point, rod
from dirax.systems.lagrange_dirac import LagrangeDirac

PARAMS = {"m1": 20.0, "m2": 35.0, "l1": 500.0, "l2": 800.0, "g": 9.8}


def lagrangian(q, v, params):
    """L(q, v), a scalar; the kinetic energy as the paper writes it."""
    (m1, m2), (l1, l2) = (params["m1"], params["m2"]), (params["l1"], params["l2"])
    s1, c1, s2, c2 = jnp.sin(q[1]), jnp.cos(q[1]), jnp.sin(q[3]), jnp.cos(q[3])
    apart = 2 * q[2]  # θ2 − θ1
    azimuth1, azimuth2 = (v[0] - v[2]) * s1, (v[0] + v[2]) * s2
    first = l1**2 * (v[1] ** 2 + azimuth1**2)
    second = l2**2 * (v[3] ** 2 + azimuth2**2)
    across = (c1 * c2 * v[1] * v[3] + azimuth1 * azimuth2) * jnp.cos(apart) + s1 * s2 * v[1] * v[3]
    turned = (azimuth1 * c2 * v[3] - azimuth2 * c1 * v[1]) * jnp.sin(apart)
    kinetic = (m1 + m2) * first / 2 + m2 * (second / 2 + l1 * l2 * (across + turned))
    return kinetic - params["g"] * ((m1 + m2) * l1 * c1 + m2 * l2 * c2)


def turn(q):
    """The generator of turns of both links about the vertical, ∂/∂ϑ1."""
    return jnp.array([1.0, 0.0, 0.0, 0.0])


def bobs(q, params):
    """The two masses, (2, 3), z up."""
    azimuths, angles = jnp.stack([q[0] - q[2], q[0] + q[2]]), jnp.stack([q[1], q[3]])
    lengths = jnp.stack([jnp.asarray(params["l1"], float), jnp.asarray(params["l2"], float)])
    level = jnp.sin(angles)
    arms = jnp.stack([level * jnp.cos(azimuths), level * jnp.sin(azimuths), jnp.cos(angles)], axis=1)
    return jnp.cumsum(lengths[:, None] * arms, axis=0)


def scene() -> Scene:
    """Two rods and two bobs."""
    first, second = (lambda q, params: bobs(q, params)[0]), (lambda q, params: bobs(q, params)[1])
    pivot = [0.0, 0.0, 0.0]
    parts = (point(pivot, colour="ink"), point(first), point(second, trail=True, colour=1))
    return Scene((rod(pivot, first), rod(first, second), *parts))


EXAMPLE = Example(
    name="double-spherical-pendulum",
    title="Double spherical pendulum in angles",
    source="Rodríguez Abella & Leok, §7.2",
    system=LagrangeDirac(lagrangian),
    params=PARAMS,
    initial={"q": np.array([0.0, 9 / 4, 2.0, 3.0]), "p": np.array([0.0, 0.0, 1.0, 1.0])},
    scheme=PlusLagrangeDirac("midpoint"),
    step=0.01,
    steps=10_000,
    coordinates=(Coordinate("ϑ1", "rad"), Coordinate("φ1", "rad"), Coordinate("ϑ2", "rad"), Coordinate("φ2", "rad")),
    plane=(1, 3),
    time_unit="s",
    energy_unit="J",
    symmetries={"angular momentum about the vertical": turn},
    scene=scene(),
)
