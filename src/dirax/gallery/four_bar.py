"""A four-bar linkage: a parallelogram of equal rods that swings, its loop closed by a hinge.

The coupler stays level, so that the angle is that of a pendulum: (5/3) l θ̈ = −2 g sin θ for rods of one mass. Stated in
space, where the hinge that closes the loop demands three things too many: they are met by the other hinges. SI units.
"""

from dirax.bodies import Model, revolute, rod
from dirax.gallery.machine import machine

END, AHEAD, AXIS = (0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)

MODEL = Model(
    bodies=[rod("left", END), rod("coupler", AHEAD), rod("right", END)],
    joints=[
        revolute("ground", "left", AXIS),
        revolute("left", "coupler", AXIS, at=END),
        revolute("ground", "right", AXIS, at=AHEAD),
        revolute("coupler", "right", AXIS, "closing hinge", at=AHEAD, on=END, closes=True),
    ],
)

EXAMPLE = machine(
    "four-bar",
    "Four-bar linkage",
    "a parallelogram: the closed equation of a pendulum",
    MODEL,
    MODEL.state({"left": 0.8, "coupler": -0.8}),
    step=0.01,
    steps=1000,
    view="front",
)
