"""The rattleback: half an ellipsoid that rolls on a plane, its principal axes of inertia turned against those of its shape.

Spun one way it begins to rattle and turns round. Data: Kane and Levinson, Int. J. Non-Linear Mech. 17 (1982). SI units.
"""

from dirax.bodies import Body, Model, ellipsoid, free
from dirax.gallery.machine import machine

CENTRE = (0.0, 0.0, -0.01)
"""The mass centre, below the middle of the ellipsoid."""

MODEL = Model(
    bodies=[Body("stone", 1.0, ((2e-4, -2e-5, 0.0), (-2e-5, 1.6e-3, 0.0), (0.0, 0.0, 1.7e-3)), centre=CENTRE)],
    joints=[free("ground", "stone", "zxy")],
    contacts=[ellipsoid("stone", (0.2, 0.03, 0.02))],
    gravity=(0.0, 0.0, -9.81),
)

EXAMPLE = machine(
    "rattleback",
    "Rattleback",
    "Kane & Levinson, Int. J. Non-Linear Mech. 17 (1982) 175–186",
    MODEL,
    MODEL.state({"stone.roll": 0.01, "stone.pitch": 0.01}, {"stone.yaw": -5.0}),
    step=1e-3,
    steps=20_000,
    plane=(3, 4),
)
