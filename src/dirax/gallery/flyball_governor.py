"""The flyball governor of Watt: two arms on a spindle that turns, whose balls rise with the speed, and a collar on a spring.

Each arm holds a rod, whose other end slides with the collar: two closed loops. The spindle turns freely, so that the angular
momentum about it is constant. After the IFToMM library's benchmark, with rods in place of its springs. SI units.
"""

import numpy as np

from dirax.bodies import Body, Damper, Model, Spring, prismatic, revolute
from dirax.gallery.machine import machine

ARM, HALF, THIN = 1.0, 0.5, 0.02
Y = (0.0, 1.0, 0.0)


def side(name: str, sign: float) -> tuple[list, list]:
    """The bodies and joints of one side: an arm with a ball at its end, and the rod from its middle to the collar."""
    arm, rod = f"{name} arm", f"{name} rod"
    bodies = [
        Body(arm, 5.0, (THIN, THIN, THIN), centre=(sign * ARM, 0.0, 0.0)),
        Body(rod, 0.2, (THIN, THIN, THIN), centre=(-sign * HALF / 2, 0.0, 0.0)),
    ]
    joints = [
        revolute("spindle", arm, Y),
        revolute(arm, rod, Y, at=(sign * HALF, 0.0, 0.0)),
        revolute(rod, "collar", Y, f"{name} hinge of the collar", at=(-sign * HALF, 0.0, 0.0), closes=True),
    ]
    return bodies, joints


RIGHT, LEFT = side("right", 1.0), side("left", -1.0)
MODEL = Model(
    bodies=[Body("spindle", 10.0, (0.1, 0.1, 0.2)), Body("collar", 1.0, (THIN, THIN, THIN)), *RIGHT[0], *LEFT[0]],
    joints=[revolute("ground", "spindle"), prismatic("spindle", "collar", (0, 0, 1)), *RIGHT[1], *LEFT[1]],
    forces=[
        Spring(2000.0, (("spindle", (0.0, 0.0, 0.0)), ("collar", (0.0, 0.0, 0.0))), length=0.5),
        Damper(20.0, coordinate="collar"),
    ],
)

EXAMPLE = machine(
    "flyball-governor",
    "Flyball governor",
    "after the IFToMM library of computational benchmark problems",
    MODEL,
    MODEL.state(
        {"right arm": np.pi / 6, "left arm": -np.pi / 6, "right rod": -np.pi / 3, "left rod": np.pi / 3},
        {"spindle": 2 * np.pi},
    ),
    step=1e-3,
    steps=5000,
    plane=(1, 2),
)
