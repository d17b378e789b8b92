"""A homogeneous ball that rolls without slipping on a table that turns with the angular velocity Ω.

q = (x, y, ψ, θ, φ): the centre in space, from the table's axis, and Euler angles (z–x–z) of the ball, with ω as in
`rolling_ball`. The point of contact moves with the table, which makes the constraints affine:

    L = ½ m (ẋ² + ẏ²) + ½ I |ω|²,   ẋ − r ω_y + Ω y = 0,   ẏ + r ω_x − Ω x = 0.

The centre goes round a circle with the frequency Ω/(1 + m r²/I), 2/7 of the table's for a full ball, whatever its speed and
place, and ω_z is constant. Neither the energy nor the angular momentum is conserved: the table does work.
Neimark & Fufaev, Dynamics of Nonholonomic Systems, ch. II.
"""

import jax.numpy as jnp
import numpy as np

from dirax.gallery import rolling_ball
from dirax.gallery.example import Coordinate, Example
from dirax.show.scene import Scene, ball, disk, plane, turn
from dirax.systems.lagrange_dirac import LagrangeDirac

PARAMS = {"m": 1.0, "r": 1.0, "I": 0.4, "turn": 1.0}
"""`turn` is Ω."""


def lagrangian(q, v, params):
    """L(q, v), a scalar."""
    return v @ rolling_ball.metric(q, params) @ v / 2


def affine(q, params):
    """(Ω y, −Ω x), shape (2,)."""
    return params["turn"] * jnp.stack([q[1], -q[0]])


def exact(t, q, v, params=None) -> np.ndarray:
    """The centre at times `t` (rows,), shape (rows, 2)."""
    p = {**PARAMS, **(params or {})}
    rate = 1j * p["turn"] / (1 + p["m"] * p["r"] ** 2 / p["I"])
    z = q[0] + 1j * q[1] + (v[0] + 1j * v[1]) * np.expm1(rate * np.atleast_1d(np.asarray(t, float))) / rate
    return np.stack([z.real, z.imag], axis=1)


def rolling(q, centre, params=PARAMS) -> np.ndarray:
    """The velocity (5,) with which the ball rolls at q while its centre moves with the velocity `centre` (2,); ω_z = 0."""
    r, turn = params["r"], params["turn"]
    omega = np.array([(turn * q[0] - centre[1]) / r, (centre[0] + turn * q[1]) / r, 0.0])
    matrix = np.asarray(rolling_ball.angular_velocity(jnp.asarray(q), params))[:, 2:]
    return np.concatenate([centre, np.linalg.solve(matrix, omega)])


START = np.array([1.0, 0.0, 0.2, 1.2, 0.0])


def scene() -> Scene:
    """The ball on the table, which turns."""
    centre = lambda q, params: jnp.stack([q[0], q[1], jnp.asarray(params["r"])])
    turned = lambda t, params: turn([0, 0, 1], params["turn"] * t)
    parts = (plane(turn=turned), disk([0.0, 0.0, 0.0], turned, radius=0.3, thickness=0.02, colour="ink"))
    return Scene((*parts, ball(centre, rolling_ball.attitude, radius=PARAMS["r"], trail=True)))


EXAMPLE = Example(
    name="turntable",
    title="Ball on a turntable",
    source="Neimark & Fufaev, Dynamics of Nonholonomic Systems, ch. II; closed solution of the centre",
    system=LagrangeDirac(lagrangian, rolling_ball.one_forms, affine=affine),
    params=PARAMS,
    initial={"q": START, "v": rolling(START, np.array([0.0, 0.1]))},
    step=0.01,
    steps=2200,
    coordinates=tuple(Coordinate(name, unit) for name, unit in zip("xyψθφ", ("", "", "rad", "rad", "rad"), strict=True)),
    scene=scene(),
)
