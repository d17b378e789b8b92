"""A robot's arm of six hinges that swings freely: a base that turns, shoulder, elbow, and a wrist of three.

Lengths and masses near those of an arm for 5 kg; its links are uniform cylinders. A tree without loops: each program for machines
can state it, and the arm falls chaotically. SI units.
"""

import numpy as np

from dirax.bodies import Body, Model, revolute
from dirax.gallery.machine import machine

Y, Z = (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
LINKS = {  # mass, end and radius of each, axis of the hinge that it hangs on
    "base": (3.7, (0.0, 0.0, 0.089), 0.06, Z),
    "upper arm": (8.4, (0.425, 0.0, 0.0), 0.06, Y),
    "forearm": (2.3, (0.392, 0.0, 0.0), 0.05, Y),
    "wrist 1": (1.2, (0.0, 0.109, 0.0), 0.04, Y),
    "wrist 2": (1.2, (0.0, 0.0, -0.095), 0.04, Z),
    "wrist 3": (0.2, (0.0, 0.082, 0.0), 0.04, Y),
}


def cylinder(name: str, mass: float, end: tuple, radius: float, *_) -> Body:
    """A uniform cylinder from the origin to its end: m (|e|² − e eᵀ)/12 + m r²/4 (1 + e eᵀ/|e|²)."""
    e = np.asarray(end)
    along = np.outer(e, e)
    thick = mass * radius**2 / 4 * (np.eye(3) + along / (e @ e))
    return Body(name, mass, mass * (e @ e * np.eye(3) - along) / 12 + thick, centre=e / 2)


NAMES = ["ground", *LINKS]
ENDS = [(0.0, 0.0, 0.0), *(link[1] for link in LINKS.values())]

MODEL = Model(
    bodies=[cylinder(name, *link) for name, link in LINKS.items()],
    joints=[revolute(NAMES[k], name, link[3], at=ENDS[k]) for k, (name, link) in enumerate(LINKS.items())],
)

EXAMPLE = machine(
    "robot-arm",
    "A robot's arm that swings freely",
    "six hinges; MuJoCo, Exudyn, pinocchio and Drake state it as well",
    MODEL,
    MODEL.state({"upper arm": 1.0, "forearm": 0.3, "wrist 1": 0.2, "wrist 2": 0.3}, {"base": 1.0}),
    step=0.002,
    steps=2500,
    plane=(1, 2),
    trail="wrist 3",
)
