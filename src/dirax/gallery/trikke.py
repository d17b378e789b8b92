"""The trikke: a scooter on three wheels that is ridden by swaying, with no pedal and no push against the ground.

A steered skate in front, and two arms behind that swing, each on a skate. Motors at the steering and at the arms follow a gait of
one frequency; the nonholonomic constraints turn what they swing into motion ahead. After Chitta, Cheng, Frazzoli and Kumar,
RoboTrikke (ICRA 2005), in the plane. SI units.
"""

import jax.numpy as jnp

from dirax.bodies import Body, Model, Motor, blade, planar, revolute
from dirax.gallery.machine import machine

AHEAD, ARM, FREQUENCY, STIFF, DAMPED = 0.5, 0.7, 4.0, 40.0, 8.0


def gait(joint: str, size: float, phase: float) -> Motor:
    """A motor that pulls its joint after size · sin(ω t + phase)."""

    def push(t, q, v):
        wanted = size * jnp.sin(FREQUENCY * t + phase)
        return STIFF * (wanted - q[joint]) - DAMPED * v[joint]

    return Motor(joint, push, name=f"motor of {joint}")


MODEL = Model(
    bodies=[
        Body("deck", 10.0, (0.4, 0.4, 0.4)),
        Body("steer", 1.0, (0.02, 0.02, 0.02)),
        Body("left arm", 2.0, (0.08, 0.08, 0.08), centre=(-ARM / 2, 0.0, 0.0)),
        Body("right arm", 2.0, (0.08, 0.08, 0.08), centre=(-ARM / 2, 0.0, 0.0)),
    ],
    joints=[
        planar("ground", "deck"),
        revolute("deck", "steer", at=(AHEAD, 0.0, 0.0)),
        revolute("deck", "left arm", at=(0.0, 0.15, 0.0)),
        revolute("deck", "right arm", at=(0.0, -0.15, 0.0)),
    ],
    contacts=[blade("steer"), blade("left arm", at=(-ARM, 0.0, 0.0)), blade("right arm", at=(-ARM, 0.0, 0.0))],
    forces=[gait("steer", 0.4, 0.0), gait("left arm", 0.25, 1.2), gait("right arm", 0.25, 1.2)],
)

EXAMPLE = machine(
    "trikke",
    "Trikke",
    "after Chitta, Cheng, Frazzoli, Kumar, RoboTrikke, ICRA 2005",
    MODEL,
    MODEL.state({"left arm": -0.25, "right arm": 0.25}),
    step=0.01,
    steps=2000,
    view="above",
    trail="deck",
)
