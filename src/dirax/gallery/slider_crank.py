"""The slider crank of the IVP test set: a crank that turns at 150 rad/s, a rod that bends and stretches, and a sliding block.

q = (φ₁, φ₂, x, q₁, …, q₄): angles of crank and rod, place of the block, two lateral modes of the rod, and its stretching at the
middle and at the end. Equations, data and the solution at t = .1: Mazzia and Magherini, Test Set for IVP Solvers, problem
"slider crank" (Simeon 1996): linear stiffness, no damping, no gravity. SI units.
"""

import jax.numpy as jnp
import numpy as np

from dirax.gallery.example import Coordinate, Example
from dirax.schemes.lagrange_dirac import LagrangeDAlembert
from dirax.show.scene import Scene, box, rod
from dirax.systems.lagrange_dirac import LagrangeDirac

PI = 3.1415927  # of the test set, whose digits depend on it
L1, L2, J1, J2, ROD, BLOCK = 0.15, 0.30, 0.002727, 0.0045339259, 0.151104, 0.075552
DENSITY, YOUNG, THICK, SPEED = 7870.0, 0.2e12, 0.008, 150.0
AREA = THICK**2
MASS = DENSITY * AREA * L2 * np.block([[np.eye(2) / 2, np.zeros((2, 2))], [np.zeros((2, 2)), np.array([[8.0, 1.0], [1.0, 2.0]])]])
BENT = PI**4 * (THICK / L2) ** 2 * np.diag([1 / 24, 2 / 3])
STRETCHED = np.array([[16.0, -8.0], [-8.0, 7.0]]) / 3
STIFFNESS = YOUNG * AREA / L2 * np.block([[BENT, np.zeros((2, 2))], [np.zeros((2, 2)), STRETCHED]])
ALONG = DENSITY * AREA * L2 * np.array([0.0, 0.0, 2 / 3, 1 / 6])
ACROSS = DENSITY * AREA * L2 * np.array([2 / PI, 0.0, 0.0, 0.0])
ALONG_FAR = DENSITY * AREA * L2**2 * np.array([0.0, 0.0, 1 / 3, 1 / 6])
ACROSS_FAR = DENSITY * AREA * L2**2 * np.array([1 / PI, -0.5 / PI, 0.0, 0.0])
UPPER = np.zeros((4, 4))
UPPER[0, 2:], UPPER[1, 3] = (-16 / PI**3, 8 / PI**3 - 1 / PI), 0.5 / PI
GYRATION = DENSITY * AREA * L2 * (UPPER - UPPER.T)
"""∫ρ of the shapes' products: across times along."""


def lagrangian(q, v):
    """L, a scalar: the rod's elements follow its angle φ₂ and hang on the crank's end."""
    (w1, w2), e, rate, apart = (v[0], v[1]), q[3:], v[3:], q[0] - q[1]
    crank = (J1 + ROD * L1**2) * w1**2 / 2 + BLOCK * v[2] ** 2 / 2
    turning = (J2 + e @ (MASS @ e) + 2 * (ALONG_FAR @ e)) * w2**2 / 2 + w2 * (ACROSS_FAR @ rate + e @ (GYRATION @ rate))
    together = L1 * w1 * w2 * (L2 * ROD / 2 * jnp.cos(apart) + jnp.sin(apart) * (ACROSS @ e) + jnp.cos(apart) * (ALONG @ e))
    carried = L1 * w1 * (jnp.cos(apart) * (ACROSS @ rate) - jnp.sin(apart) * (ALONG @ rate))
    return crank + turning + together + carried + rate @ (MASS @ rate) / 2 - e @ (STIFFNESS @ e) / 2


def holonomic(t, q):
    """The end of the rod on the block, and the crank at ω t, (3,)."""
    end = L2 + q[6]
    height, ahead = L1 * jnp.sin(q[0]) + end * jnp.sin(q[1]), L1 * jnp.cos(q[0]) + end * jnp.cos(q[1])
    return jnp.stack([height, q[2] - ahead, q[0] - SPEED * t])


START = {
    "q": np.array([0.0, 0.0, 0.450016933, 0.0, 0.0, 0.103339863e-4, 0.169327969e-4]),
    "v": np.array([150.0, -74.9957670, -0.268938672e-5, 0.444896105, 0.463434311e-2, -0.178591076e-5, -0.268938672e-5]),
}
REFERENCE = np.array(
    [
        *(15.0, -0.3311734987910881, 0.1697373326718410, 1.893192460247178e-4),
        *(2.375751865617931e-5, -5.323907988763734e-6, -8.363283141616840e-6),
    ]
)
"""q at t = .1 s."""

PIN = lambda q: L1 * jnp.stack([jnp.cos(q[0]), jnp.zeros(()), jnp.sin(q[0])])
SLIDER = lambda q: jnp.stack([q[2], jnp.zeros(()), jnp.zeros(())])
NAMES = ("φ₁", "φ₂", "x", "q₁", "q₂", "q₃", "q₄")
EXAMPLE = Example(
    name="slider-crank",
    title="Slider crank with an elastic rod",
    source="IVP test set, problem slider crank; Simeon, Math. Modelling of Systems 2 (1996)",
    system=LagrangeDirac(lagrangian, holonomic=holonomic),
    initial={**START, "project": True},
    scheme=LagrangeDAlembert(),
    step=1e-5,
    steps=10_000,
    coordinates=tuple(Coordinate(name, "rad" if k < 2 else "m") for k, name in enumerate(NAMES)),
    plane=(2, 3),
    time_unit="s",
    energy_unit="J",
    scene=Scene((rod([0.0, 0.0, 0.0], PIN), rod(PIN, SLIDER), box(SLIDER, size=(0.06, 0.04, 0.04))), view="front"),
)
