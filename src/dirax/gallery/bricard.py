"""Bricard's mechanism: five rods and six hinges in space, a loop that moves although it has more constraints than coordinates.

The benchmark of the IFToMM library: rods of 1 m and 1 kg along the edges of a cube, at rest, under gravity along −y. Of the
five things that the last hinge demands one follows from the others. SI units.
"""

import numpy as np

from dirax.bodies import Model, revolute, rod
from dirax.gallery.machine import machine

EDGES = np.array([[1.0, 0, 0], [0, -1.0, 0], [0, 0, 1.0], [-1.0, 0, 0], [0, 1.0, 0]])
AXES = ((0, 1, 0), (0, 0, 1), (1, 0, 0), (0, 1, 0), (0, 0, 1))
RODS = [f"rod {k}" for k in range(1, 6)]

MODEL = Model(
    bodies=[rod(name, edge) for name, edge in zip(RODS, EDGES, strict=True)],
    joints=[
        revolute("ground", "rod 1", AXES[0]),
        *(revolute(RODS[k - 1], RODS[k], AXES[k], at=EDGES[k - 1]) for k in range(1, 5)),
        revolute("ground", "rod 5", (1, 0, 0), "last hinge", at=(0.0, 0.0, 1.0), on=EDGES[4], closes=True),
    ],
    gravity=(0.0, -9.81, 0.0),
)

EXAMPLE = machine(
    "bricard",
    "Bricard's mechanism",
    "IFToMM library of computational benchmark problems: Bricard's mechanism",
    MODEL,
    MODEL.state(),
    step=0.01,
    steps=1000,
)
