"""A row of N four-bar linkages, which all fold at once: 2N + 1 rods of 1 m and 1 kg, pushed over from upright.

Where the rods lie flat, every window could fold either way: the constraints lose rank for a moment, and a step that is halted by
it fails. A benchmark of the IFToMM library with N = 40, a speed of 1 m/s of the first corner. As all uprights turn alike, the
row is a pendulum: ((N + 1)/3 + N) θ̈ = ((N + 1)/2 + N) g sin θ. SI units.
"""

from dirax.bodies import Model, revolute, rod
from dirax.gallery.machine import machine

AXIS, TOP, ALONG = (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)


def model(windows: int) -> Model:
    """N windows: uprights on the ground, beams from the top of each to the next one."""
    uprights = [f"upright {k}" for k in range(windows + 1)]
    beams = [f"beam {k}" for k in range(windows)]
    joints = [revolute("ground", name, AXIS, at=(float(k), 0.0, 0.0)) for k, name in enumerate(uprights)]
    for k, beam in enumerate(beams):
        joints.append(revolute(uprights[k], beam, AXIS, at=TOP))
        joints.append(revolute(beam, uprights[k + 1], AXIS, f"corner {k + 1}", at=ALONG, on=TOP, closes=True))
    return Model([*(rod(name, TOP) for name in uprights), *(rod(name, ALONG) for name in beams)], joints)


def energy(windows: int) -> float:
    """Of the start: upright at 1 rad/s."""
    return ((windows + 1) / 3 + windows) / 2 + 9.81 * ((windows + 1) / 2 + windows)


MODEL = model(4)
EXAMPLE = machine(
    "n-four-bar",
    "A row of four-bar linkages",
    "IFToMM library of computational benchmark problems: N-four-bar mechanism",
    MODEL,
    MODEL.state({}, {"upright 0": 1.0}),
    step=0.01,
    steps=1000,
    view="front",
)
