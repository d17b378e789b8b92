"""A homogeneous ball that rolls on an inclined plane without slipping.

q = (x, y, ψ, θ, φ): the centre, x downhill, and Euler angles (z–x–z) of the ball. With the angular velocity in space
ω = (θ̇ cos ψ + φ̇ sin θ sin ψ, θ̇ sin ψ − φ̇ sin θ cos ψ, ψ̇ + φ̇ cos θ):

    L = ½ m (ẋ² + ẏ²) + ½ I |ω|² + m g x sin α,   ẋ = r ω_y,   ẏ = −r ω_x.

The centre falls with g sin α/(1 + I/mr²), 5/7 of it for a full ball, and ω_z is constant.
"""

import jax.numpy as jnp
import numpy as np

from dirax.gallery.example import Coordinate, Example
from dirax.schemes.discrete_dirac import DiscreteDirac
from dirax.show.scene import Scene, after, ball, plane, turn
from dirax.systems.nonholonomic import NonholonomicMechanics

PARAMS = {"m": 1.0, "r": 1.0, "I": 0.4, "g": 0.1}
"""`g` is g sin α."""


def angular_velocity(q, params):
    """The matrix (3, 5) that takes q̇ to ω."""
    zero, one = jnp.zeros(()), jnp.ones(())
    sin_psi, cos_psi, sin_theta, cos_theta = jnp.sin(q[2]), jnp.cos(q[2]), jnp.sin(q[3]), jnp.cos(q[3])
    return jnp.stack(
        [
            jnp.stack([zero, zero, zero, cos_psi, sin_theta * sin_psi]),
            jnp.stack([zero, zero, zero, sin_psi, -sin_theta * cos_psi]),
            jnp.stack([zero, zero, one, zero, cos_theta]),
        ]
    )


def metric(q, params):
    """g(q) of L, shape (5, 5)."""
    turn = angular_velocity(q, params)
    return params["m"] * jnp.diag(jnp.array([1.0, 1.0, 0.0, 0.0, 0.0])) + params["I"] * turn.T @ turn


def potential(q, params):
    """−m g sin α x, a scalar."""
    return -params["m"] * params["g"] * q[0]


def one_forms(q, params):
    """dx − r ω_y and dy + r ω_x, shape (2, 5)."""
    turn = angular_velocity(q, params)
    return jnp.eye(5)[:2] + params["r"] * jnp.stack([-turn[1], turn[0]])


def exact(t, q, v, params=None) -> np.ndarray:
    """The centre at times `t` (rows,), shape (rows, 2)."""
    p = {**PARAMS, **(params or {})}
    t = np.atleast_1d(np.asarray(t, float))
    fall = p["g"] / (1 + p["I"] / (p["m"] * p["r"] ** 2))
    return np.stack([q[0] + v[0] * t + fall * t**2 / 2, q[1] + v[1] * t], axis=1)


def attitude(q):
    """The ball's rotation as a quaternion, from Euler angles z–x–z."""
    return after(turn([0, 0, 1], q[2]), turn([1, 0, 0], q[3]), turn([0, 0, 1], q[4]))


def scene() -> Scene:
    """The ball on the plane, x downhill."""
    centre = lambda q, params: jnp.stack([q[0], q[1], jnp.asarray(params["r"])])
    return Scene((plane(), ball(centre, attitude, radius=PARAMS["r"], trail=True)))


EXAMPLE = Example(
    name="rolling-ball",
    title="Ball rolling on an inclined plane",
    source="nonholonomic mechanics of [BLM] §8; the centre's closed solution",
    system=NonholonomicMechanics(metric, potential, one_forms),
    params=PARAMS,
    initial={"q": np.array([0.0, 0.0, 0.2, 1.2, 0.0]), "v": np.array([0.0, 0.3, 0.1, 0.0, 0.0]), "project": True},
    scheme=DiscreteDirac(constraints="resolve"),
    step=0.01,
    steps=500,
    coordinates=tuple(Coordinate(name, unit) for name, unit in zip("xyψθφ", ("", "", "rad", "rad", "rad"), strict=True)),
    scene=scene(),
)
