"""The double spherical pendulum on S² × S²: no angles, so that it swings through the poles.

q = (a, b), unit vectors from the pivot to the first mass and from the first to the second (units of the gallery: metres,
kilograms, seconds). L = m1 |l1 ȧ|²/2 + m2 |l1 ȧ + l2 ḃ|²/2 − m1 g l1 a_3 − m2 g (l1 a_3 + l2 b_3). In the angles of [RL] §7
the poles a_3 = ±1, b_3 = ±1 are singular; here the state is held in charts that follow the motion ([RL] §6).
"""

import jax.numpy as jnp
import numpy as np

from dirax.gallery.example import Coordinate, Example
from dirax.geometry.maps import RiemannianExp
from dirax.geometry.products import Product
from dirax.geometry.spaces import Sphere
from dirax.schemes.in_charts import InCharts
from dirax.show.scene import Scene, point, rod, sphere
from dirax.systems.manifold_lagrangian import ManifoldLagrangian

PARAMS = {"m1": 1.0, "m2": 1.5, "l1": 1.0, "l2": 0.8, "g": 9.8}
SPACE = Product(Sphere(3), Sphere(3))


def lagrangian(q, v, params):
    """L(q, v), a scalar."""
    first, second = params["l1"] * v[:3], params["l1"] * v[:3] + params["l2"] * v[3:]
    height = params["l1"] * q[2], params["l1"] * q[2] + params["l2"] * q[5]
    kinetic = params["m1"] * first @ first / 2 + params["m2"] * second @ second / 2
    return kinetic - params["g"] * (params["m1"] * height[0] + params["m2"] * height[1])


def turn(q):
    """The generator of turns of both arms about the vertical."""
    return jnp.array([-q[1], q[0], 0.0, -q[4], q[3], 0.0])


def scene() -> Scene:
    """Two rods and two bobs, and the sphere of the first."""
    first = lambda q, params: params["l1"] * q[:3]
    second = lambda q, params: params["l1"] * q[:3] + params["l2"] * q[3:]
    pivot = [0.0, 0.0, 0.0]
    bobs = (point(pivot, radius=0.03, colour="ink"), point(first, radius=0.07), point(second, radius=0.08, trail=True, colour=1))
    return Scene((sphere(radius=PARAMS["l1"]), rod(pivot, first), rod(first, second), *bobs))


EXAMPLE = Example(
    name="spherical-pendulums",
    title="Double spherical pendulum on S² × S²",
    source="Rodríguez Abella & Leok, §§6, 7",
    system=ManifoldLagrangian(lagrangian, SPACE),
    params=PARAMS,
    initial={
        "q": np.array([np.sin(0.5), 0.0, -np.cos(0.5), np.sin(1.0), 0.0, -np.cos(1.0)]),
        "v": np.array([2 * np.cos(0.5), 0.0, 2 * np.sin(0.5), np.cos(1.0), 0.0, np.sin(1.0)]),
    },
    scheme=InCharts(RiemannianExp(SPACE, 0.5)),
    step=0.01,
    steps=1000,
    coordinates=tuple(Coordinate(name) for name in ("a1", "a2", "a3", "b1", "b2", "b3")),
    plane=(0, 2),
    time_unit="s",
    energy_unit="J",
    symmetries={"angular momentum about the vertical": turn},
    scene=scene(),
)
