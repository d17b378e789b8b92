"""Bricard's mechanism: five rods and six hinges in space, a loop that moves although it has more constraints than coordinates.

The benchmark of the IFToMM library: rods of 1 m and 1 kg along the edges of a cube, at rest, under gravity along −y. Of the
five things that the last hinge demands one follows from the others. SI units.
"""

import numpy as np

from dirax.bodies import Body, Model, revolute
from dirax.gallery.example import Coordinate, Example
from dirax.schemes.lagrange_dirac import LagrangeDAlembert

EDGES = np.array([[1.0, 0, 0], [0, -1.0, 0], [0, 0, 1.0], [-1.0, 0, 0], [0, 1.0, 0]])
AXES = ((0, 1, 0), (0, 0, 1), (1, 0, 0), (0, 1, 0), (0, 0, 1))
RODS = [f"rod {k}" for k in range(1, 6)]

MODEL = Model(
    bodies=[Body(rod, 1.0, (1.0 - np.abs(edge)) / 12, centre=edge / 2) for rod, edge in zip(RODS, EDGES, strict=True)],
    joints=[
        revolute("ground", "rod 1", AXES[0]),
        *(revolute(RODS[k - 1], RODS[k], AXES[k], at=EDGES[k - 1]) for k in range(1, 5)),
        revolute("ground", "rod 5", (1, 0, 0), "last hinge", at=(0.0, 0.0, 1.0), on=EDGES[4], closes=True),
    ],
    gravity=(0.0, -9.81, 0.0),
)

EXAMPLE = Example(
    name="bricard",
    title="Bricard's mechanism",
    source="IFToMM library of computational benchmark problems: Bricard's mechanism",
    system=MODEL.system,
    initial=MODEL.state(),
    scheme=LagrangeDAlembert(),
    step=0.01,
    steps=1000,
    coordinates=tuple(Coordinate(name, "rad") for name in MODEL.coordinates),
    time_unit="s",
    energy_unit="J",
    scene=MODEL.scene(),
)
