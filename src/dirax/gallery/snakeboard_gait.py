"""The snakeboard of Ostrowski and Burdick, ridden: the axles swing to and fro, the rotor with the same frequency ("drive" gait).

Four bodies in the plane, two skates that turn on the board, and motors that follow the gait. Nothing pushes against the ground
but the skates, and the board gathers speed: Lewis, Ostrowski, Murray and Burdick, ICRA 1994. Units of the snakeboard.
"""

import jax.numpy as jnp

from dirax.bodies import Body, Model, Motor, blade, planar, revolute
from dirax.gallery.machine import machine

HALF, FREQUENCY, STIFF, DAMPED = 0.2, 1.0, 20.0, 3.0


def follows(joint: str, size: float, sign: float = 1.0) -> Motor:
    """A motor that pulls its joint after sign · size · sin ω t."""

    def push(t, q, v):
        return STIFF * (sign * size * jnp.sin(FREQUENCY * t) - q[joint]) - DAMPED * v[joint]

    return Motor(joint, push, name=f"motor of {joint}")


MODEL = Model(
    bodies=[
        Body("board", 6.0, (0.016, 0.016, 0.016)),
        Body("rotor", 1.0, (0.072, 0.072, 0.072)),
        Body("back axle", 0.5, (0.0013, 0.0013, 0.0013)),
        Body("front axle", 0.5, (0.0013, 0.0013, 0.0013)),
    ],
    joints=[
        planar("ground", "board"),
        revolute("board", "rotor"),
        revolute("board", "back axle", at=(-HALF, 0.0, 0.0)),
        revolute("board", "front axle", at=(HALF, 0.0, 0.0)),
    ],
    contacts=[blade("back axle"), blade("front axle")],
    forces=[follows("rotor", 0.7), follows("back axle", 0.3, -1.0), follows("front axle", 0.3)],
)

EXAMPLE = machine(
    "snakeboard-gait",
    "Snakeboard in its drive gait",
    "Lewis, Ostrowski, Murray, Burdick, ICRA 1994",
    MODEL,
    MODEL.state(),
    step=0.02,
    steps=2000,
    units=False,
    view="above",
    trail="board",
)
