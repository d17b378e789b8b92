"""Andrews' squeezing mechanism: seven bodies in a plane, three closed loops, a spring and a motor of constant torque.

Data and names of the angles: the IVP test set (Mazzia, Magherini), and Hairer and Wanner, Solving ODEs II, VII.7. SI units.
"""

import numpy as np

from dirax.bodies import Body, Model, Motor, Spring, revolute
from dirax.gallery.machine import machine

A, B, C = (-0.06934, -0.00227, 0.0), (-0.03635, 0.03273, 0.0), (0.014, 0.072, 0.0)
MASSES = (0.04325, 0.00365, 0.02373, 0.00706, 0.07050, 0.00706, 0.05498)
INERTIAS = (2.194e-6, 4.410e-7, 5.255e-6, 5.667e-7, 1.169e-5, 5.667e-7, 1.912e-5)
CENTRES = (
    *((0.00092, 0.0), (-0.0115, 0.0), (0.01874, -0.01043), (0.0, -0.00579)),
    *((0.02308, 0.00916), (0.00579, 0.0), (-0.00449, -0.01228)),
)

MODEL = Model(
    bodies=[
        Body(f"K{k}", mass, (inertia,) * 3, (*centre, 0.0))
        for k, (mass, inertia, centre) in enumerate(zip(MASSES, INERTIAS, CENTRES, strict=True), start=1)
    ],
    joints=[
        revolute("ground", "K1", name="β"),
        revolute("K1", "K2", name="Θ", at=(0.007, 0.0, 0.0)),
        revolute("ground", "K3", name="γ", at=B),
        revolute("K5", "K4", name="Φ", at=(0.04, 0.0, 0.0)),
        revolute("ground", "K5", name="δ", at=A),
        revolute("K7", "K6", name="Ω", at=(0.0, -0.04, 0.0)),
        revolute("ground", "K7", name="ε", at=A),
        *(
            revolute("K2", body, name=f"K2–{body}", at=(-0.028, 0.0, 0.0), on=end, closes=True)
            for body, end in (("K3", (0.0, -0.035, 0.0)), ("K4", (0.0, -0.02, 0.0)), ("K6", (0.02, 0.0, 0.0)))
        ),
    ],
    forces=[Motor("β", 0.033), Spring(4530.0, (("K3", (0.02, -0.018, 0.0)), ("ground", C)), length=0.07785)],
    gravity=(0.0, 0.0, 0.0),
)


START = np.array(
    [
        *(-0.0617138900142764496, 0.0, 0.455279819163070380, 0.222668390165885885),
        *(0.487364979543842550, -0.222668390165885885, 1.230547444549821192),
    ]
)
"""The angles at rest, where the loops close."""

REFERENCE = np.array(
    [
        *(15.81077119629904, -15.75637105984298, 0.04082224013073101, -0.5347301163226948),
        *(0.5244099658805304, 0.5347301163226948, 1.048080741042263),
    ]
)
"""The angles at t = .03 s."""

EXAMPLE = machine(
    "andrews-squeezer",
    "Andrews' squeezing mechanism",
    "IVP test set, problem Andrews; Hairer & Wanner II, VII.7",
    MODEL,
    MODEL.state(START),
    step=1e-5,
    steps=3000,
    plane=(2, 4),
    view="above",
)
