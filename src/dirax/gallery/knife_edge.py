"""A knife edge (a skate) on an inclined plane, with its closed solution.

q = (x, y, φ): contact point, x downhill, and heading. L = m (ẋ² + ẏ²)/2 + I φ̇²/2 + m g x sin α, sin φ ẋ = cos φ ẏ. From
rest at φ = 0 with φ̇ = ω it does not slide down but moves across, on a cycloid:

    x = (g sin α/2ω²) sin² ωt,   y = (g sin α/2ω²)(ωt − ½ sin 2ωt),   φ = ωt.
"""

import jax.numpy as jnp
import numpy as np

from dirax.gallery.example import Coordinate, Example
from dirax.schemes.discrete_dirac import DiscreteDirac
from dirax.show.scene import Scene, blade, plane, turn
from dirax.systems.nonholonomic import NonholonomicMechanics

PARAMS = {"m": 1.0, "I": 1.0, "g": 1.0}
"""`g` is g sin α."""


def metric(q, params):
    """diag(m, m, I)."""
    return jnp.diag(jnp.stack([jnp.asarray(params[name], float) for name in ("m", "m", "I")]))


def potential(q, params):
    """−m g sin α x, a scalar."""
    return -params["m"] * params["g"] * q[0]


def one_forms(q, params):
    """sin φ dx − cos φ dy, shape (1, 3)."""
    return jnp.stack([jnp.sin(q[2]), -jnp.cos(q[2]), jnp.zeros(())])[None]


def exact(t, q, v, params=None) -> np.ndarray:
    """The solution at times `t` (rows,), shape (rows, 3), from any position and admissible velocity with φ̇ ≠ 0."""
    p = {**PARAMS, **(params or {})}
    t, (x0, y0, heading), turn = np.atleast_1d(np.asarray(t, float)), np.asarray(q, float), float(v[2])
    speed, phi = np.cos(heading) * v[0] + np.sin(heading) * v[1], heading + turn * t
    slide = p["g"] / turn
    c = speed - slide * np.sin(heading)  # the speed along the edge is c + (g sin α/ω) sin φ
    x = (c * np.sin(phi) + slide * np.sin(phi) ** 2 / 2) / turn
    y = (-c * np.cos(phi) + slide * (phi - np.sin(2 * phi) / 2) / 2) / turn
    first = (c * np.sin(heading) + slide * np.sin(heading) ** 2 / 2) / turn
    second = (-c * np.cos(heading) + slide * (heading - np.sin(2 * heading) / 2) / 2) / turn
    return np.stack([x0 + x - first, y0 + y - second, phi], axis=1)


def scene() -> Scene:
    """The skate on its plane, x downhill."""
    return Scene((plane(), blade(lambda q: q[:2], lambda q: turn([0, 0, 1], q[2]), trail=True)))


EXAMPLE = Example(
    name="knife-edge",
    title="Knife edge on an inclined plane",
    source="nonholonomic mechanics of [BLM] §8; closed solution",
    system=NonholonomicMechanics(metric, potential, one_forms),
    params=PARAMS,
    initial={"q": np.zeros(3), "v": np.array([0.0, 0.0, 1.0])},
    scheme=DiscreteDirac(constraints="resolve"),
    step=0.05,
    steps=1000,
    coordinates=(Coordinate("x"), Coordinate("y"), Coordinate("φ", "rad")),
    exact=exact,
    scene=scene(),
)
