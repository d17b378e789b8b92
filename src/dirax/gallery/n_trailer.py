"""A car with trailers: each hangs on the axle of the one before it, and no axle slides to the side.

The classical nonholonomic chain; trailer k turns by θ̇_k = v_{k−1} sin(θ_{k−1} − θ_k)/d_k, its speed is v_k =
v_{k−1} cos(θ_{k−1} − θ_k) (Murray and Sastry, IEEE Trans. Autom. Control 38 (1993)), and on a circle of the steered car the
radii are R_k² = R_{k−1}² − d_k². A motor holds the steering; the car rolls freely. SI units.
"""

from dirax.bodies import Body, Model, Spring, blade, planar, revolute
from dirax.gallery.machine import machine

WHEELBASE, LENGTHS = 2.5, (2.0, 2.0, 1.5)
TRAILERS = tuple(f"trailer {k}" for k in range(1, len(LENGTHS) + 1))
STEERED = 0.5
"""The angle of the front axle (rad) at which the spring of the steering is at rest."""

MODEL = Model(
    bodies=[
        Body("car", 1200.0, (1500.0, 1500.0, 1500.0), centre=(WHEELBASE / 2, 0.0, 0.0)),
        Body("steer", 30.0, (1.0, 1.0, 1.0)),
        *(Body(name, 300.0, (150.0, 150.0, 150.0)) for name in TRAILERS),
    ],
    joints=[
        planar("ground", "car"),
        revolute("car", "steer", at=(WHEELBASE, 0.0, 0.0)),
        *(
            revolute(before, name, on=(length, 0.0, 0.0))
            for before, name, length in zip(("car", *TRAILERS), TRAILERS, LENGTHS, strict=False)
        ),
    ],
    contacts=[blade("car"), blade("steer"), *(blade(name) for name in TRAILERS)],
    forces=[Spring(2e4, coordinate="steer", length=STEERED, name="steering")],
)

EXAMPLE = machine(
    "n-trailer",
    "Car with three trailers",
    "Murray & Sastry, IEEE Trans. Autom. Control 38 (1993)",
    MODEL,
    MODEL.state({"steer": STEERED}, {"car.x": 3.0, "steer": 0.0}),
    step=0.01,
    steps=2000,
    view="above",
    trail="trailer 3",
)
