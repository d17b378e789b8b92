"""The tippe-top: a ball with its mass centre below its middle, which slides on a plane with friction and turns upside down.

Jellett's integral, the angular momentum about the mass centre along the line from the point of contact, is constant whatever
the force at the contact is (Jellett 1872). Data near Cohen, Am. J. Phys. 45 (1977). SI units.
"""

import jax.numpy as jnp
import numpy as np

from dirax.bodies import Body, Model, ball_contact, free
from dirax.gallery.machine import machine

RADIUS, BELOW, MASS = 0.02, 0.002, 0.015
MODEL = Model(
    bodies=[Body("top", MASS, 0.4 * MASS * RADIUS**2 * np.array([1.0, 1.0, 0.95]), centre=(0.0, 0.0, -BELOW))],
    joints=[free("ground", "top")],
    contacts=[ball_contact("top", RADIUS, motion="slides", friction=0.1)],
)


def jellett(q, v):
    """Jellett's integral: −L·(from the mass centre to the contact), a scalar."""
    centre = MODEL.frames(q, v)["top"].point(np.array([0.0, 0.0, -BELOW]))
    contact = q[:3] - jnp.array([0.0, 0.0, RADIUS])
    return -MODEL.angular_momentum(q, v, about=centre) @ (contact - centre)


EXAMPLE = machine(
    "tippe-top",
    "Tippe-top with Coulomb friction",
    "Cohen, Am. J. Phys. 45 (1977); Jellett 1872 for its integral",
    MODEL,
    MODEL.state({"top.z": RADIUS, "top.qx": 0.05}, {"top.qz": 75.0, "top.qx": 0.0, "top.x": 0.0, "top.y": 0.0}),
    step=2e-4,
    steps=20_000,
    plane=(4, 5),
)
