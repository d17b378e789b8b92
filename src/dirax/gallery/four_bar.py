"""A four-bar linkage: a parallelogram of equal rods that swings, its loop closed by a hinge.

The coupler stays level, so that the angle is that of a pendulum: (5/3) l θ̈ = −2 g sin θ for rods of one mass. Stated in
space, where the hinge that closes the loop demands three things too many: they are met by the other hinges. SI units.
"""

from dirax.bodies import Body, Model, revolute
from dirax.gallery.example import Coordinate, Example
from dirax.schemes.lagrange_dirac import LagrangeDAlembert

LENGTH, MASS = 1.0, 1.0
ACROSS = MASS * LENGTH**2 / 12
HANGING = {"mass": MASS, "inertia": (ACROSS, ACROSS, 0.0), "centre": (0.0, 0.0, -LENGTH / 2)}
END, AXIS = (0.0, 0.0, -LENGTH), (0.0, 1.0, 0.0)

MODEL = Model(
    bodies=[
        Body("left", **HANGING),
        Body("coupler", MASS, (0.0, ACROSS, ACROSS), centre=(LENGTH / 2, 0.0, 0.0)),
        Body("right", **HANGING),
    ],
    joints=[
        revolute("ground", "left", AXIS),
        revolute("left", "coupler", AXIS, at=END),
        revolute("ground", "right", AXIS, at=(LENGTH, 0.0, 0.0)),
        revolute("coupler", "right", AXIS, "closing hinge", at=(LENGTH, 0.0, 0.0), on=END, closes=True),
    ],
)

EXAMPLE = Example(
    name="four-bar",
    title="Four-bar linkage",
    source="a parallelogram: the closed equation of a pendulum",
    system=MODEL.system,
    initial=MODEL.state({"left": 0.8, "coupler": -0.8}),
    scheme=LagrangeDAlembert(),
    step=0.01,
    steps=1000,
    coordinates=tuple(Coordinate(name, "rad") for name in MODEL.coordinates),
    time_unit="s",
    energy_unit="J",
    scene=MODEL.scene(view="front"),
)
