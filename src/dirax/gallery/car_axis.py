"""The car axis of the IVP test set: an axle on two springs, whose right wheel rides over waves of the road.

The axle is two light masses at a constant distance L; its left one stays on the line across the base of the car, which turns
with the right wheel at (√(L² − y_b²), y_b), y_b = r sin ω t: constraints that take the time. Equations, data and the solution
at t = 3: Mazzia and Magherini, Test Set for IVP Solvers, problem "car axis" (Schneider). q = (x_l, y_l, x_r, y_r).
"""

import jax.numpy as jnp
import numpy as np

from dirax.gallery.example import Coordinate, Example
from dirax.schemes.lagrange_dirac import LagrangeDAlembert
from dirax.show.scene import Scene, point, rod, spring
from dirax.systems.lagrange_dirac import LagrangeDirac

LENGTH, REST, WAVE, FREQUENCY = 1.0, 0.5, 0.1, 10.0
MASS = 10.0 * 1e-2**2 / 2
"""M ε²/2, the mass over the springs' stiffness."""


def wheel(t):
    """The right wheel, the left one being at the origin (2,)."""
    height = WAVE * jnp.sin(FREQUENCY * t)
    return jnp.stack([jnp.sqrt(LENGTH**2 - height**2), height])


def lagrangian(t, q, v):
    """L, a scalar: two springs of stiffness 1 and gravity 1."""
    extended = lambda apart: jnp.sqrt(apart @ apart) - REST
    springs = (extended(q[:2]) ** 2 + extended(q[2:] - wheel(t)) ** 2) / 2
    return MASS * (v @ v / 2 - q[1] - q[3]) - springs


def holonomic(t, q):
    """The left mass across the base, and the length of the axle, (2,)."""
    axle = q[2:] - q[:2]
    return jnp.stack([q[:2] @ wheel(t), axle @ axle - LENGTH**2])


REFERENCE = np.array([0.0493455784275402809122, 0.496989460230171153861, 1.04174252488542151681, 0.373911027265361256927])
"""q at t = 3, computed in quadruple precision (test set, release 2.4)."""

upright = lambda x: jnp.stack([x[0], jnp.zeros(()), x[1]])
LEFT, RIGHT, WHEEL = (lambda q: upright(q[:2])), (lambda q: upright(q[2:])), (lambda t: upright(wheel(t)))
EXAMPLE = Example(
    name="car-axis",
    title="Car axis on a bumpy road",
    source="IVP test set, problem car axis; Schneider 1990",
    system=LagrangeDirac(lagrangian, holonomic=holonomic),
    initial={"q": np.array([0.0, REST, LENGTH, REST]), "v": np.array([-REST / LENGTH, 0.0, -REST / LENGTH, 0.0])},
    scheme=LagrangeDAlembert(),
    step=1e-3,
    steps=3000,
    coordinates=tuple(Coordinate(name) for name in ("x_l", "y_l", "x_r", "y_r")),
    plane=(2, 3),
    scene=Scene(
        (rod(LEFT, RIGHT), point(LEFT), point(RIGHT, trail=True), spring([0.0] * 3, LEFT), spring(WHEEL, RIGHT), point(WHEEL)),
        view="front",
    ),
)
