"""The planar Kepler problem: one body on an ellipse about a fixed centre.

    L = |q̇|²/2 + μ/|q|

Units of length and time in which the semi-major axis and μ are 1, so that the period is 2π. The data are those of
Hairer, Lubich, Wanner, Geometric Numerical Integration, I.2.2, at the pericentre of an orbit of eccentricity .6.
Conserved: the energy −1/2 and the angular momentum x p_y − y p_x = .8.
"""

import jax.numpy as jnp
import numpy as np

from dirax.gallery.example import Coordinate, Example
from dirax.show.scene import Scene, path, plane, point
from dirax.systems.lagrange_dirac import LagrangeDirac

ECCENTRICITY = 0.6
PARAMS = {"mu": 1.0}


def lagrangian(q, v, params):
    """L(q, v), a scalar; q is not 0."""
    return v @ v / 2 + params["mu"] / jnp.sqrt(q @ q)


def exact(t, q, v, params=None) -> np.ndarray:
    """The elliptic orbit through (q, v) at times `t` (rows,), shape (rows, 2), by Kepler's equation M = E − e sin E.

    Raises `ValueError` for orbits that are not ellipses, or that pass through the centre.
    """
    mu = {**PARAMS, **(params or {})}["mu"]
    q, v, t = np.asarray(q, float), np.asarray(v, float), np.atleast_1d(np.asarray(t, float))
    energy, momentum = v @ v / 2 - mu / np.hypot(*q), q[0] * v[1] - q[1] * v[0]
    if energy >= 0 or momentum == 0:
        raise ValueError(
            f"the exact solution is written for ellipses, but the initial data have energy {energy:g} and angular momentum "
            f"{momentum:g}: give a slower velocity, not along the position."
        )
    a = -mu / (2 * energy)
    apsis = (v @ v / mu - 1 / np.hypot(*q)) * q - (q @ v) / mu * v  # the eccentricity vector
    e = float(np.hypot(*apsis))
    towards = apsis / e if e > 1e-15 else q / np.hypot(*q)
    across = np.sign(momentum) * np.array([-towards[1], towards[0]])
    rate = np.sqrt(mu / a**3)
    start = np.arctan2(q @ across / np.sqrt(1 - e * e), q @ towards + a * e)
    mean = start - e * np.sin(start) + rate * t
    anomaly = mean + e * np.sin(mean)
    for _ in range(60):
        anomaly = anomaly - (anomaly - e * np.sin(anomaly) - mean) / (1 - e * np.cos(anomaly))
    along, aside = a * (np.cos(anomaly) - e), a * np.sqrt(1 - e * e) * np.sin(anomaly)
    return along[:, None] * towards + aside[:, None] * across


def rotation(q):
    """The generator of rotations of the plane, (−y, x); its momentum is the angular momentum."""
    return jnp.array([-q[1], q[0]])


def scene() -> Scene:
    """The centre and the body that goes round it."""
    return Scene((plane(), point([0.0, 0.0], colour="ink"), path(lambda q: q), point(lambda q: q, trail=True)), view="tilted")


EXAMPLE = Example(
    name="kepler",
    title="Kepler problem",
    source="Hairer, Lubich & Wanner, Geometric Numerical Integration, I.2.2",
    system=LagrangeDirac(lagrangian),
    params=PARAMS,
    initial={
        "q": np.array([1 - ECCENTRICITY, 0.0]),
        "v": np.array([0.0, np.sqrt((1 + ECCENTRICITY) / (1 - ECCENTRICITY))]),
    },
    step=0.01,
    steps=10_000,
    coordinates=(Coordinate("x"), Coordinate("y")),
    exact=exact,
    symmetries={"angular momentum": rotation},
    scene=scene(),
)
