"""A particle on a contact distribution in a harmonic potential: a hard case for nonholonomic integrators.

q = (x, y, z) with ż = y ẋ, after the contact oscillators of McLachlan & Perlmutter (J. Nonlinear Sci. 16, 2006) and the
non-reversible test problems of Modin & Verdier (Numer. Math. 145, 2020); the perturbations and the data are our own:

    L = (ẋ² + ẏ² + ż²)/2 + β x ẏ − (x² + y²)/2 − κ (x sin(y + z) + z²/2)

- β = κ = 0: y is a harmonic oscillator by itself, and drives x; reversible under v → −v, and integrable (Modin & Verdier);
- κ ≠ 0: reversible, not integrable;
- β ≠ 0: a gyroscopic force, not reversible under v → −v. With κ ≠ 0 no reflection helps either.

The energy is conserved in every case.
"""

import jax.numpy as jnp
import numpy as np

from dirax.gallery.example import Coordinate, Example
from dirax.schemes.discrete_dirac import DiscreteDirac
from dirax.show.scene import Scene, axes, box, point
from dirax.systems.lagrange_dirac import LagrangeDirac

PARAMS = {"beta": 0.0, "kappa": 0.0}
CASES = {
    "integrable": {"beta": 0.0, "kappa": 0.0},
    "perturbed, reversible": {"beta": 0.0, "kappa": 0.1},
    "irreversible": {"beta": 0.3, "kappa": 0.1},
}
"""Parameters by what they make of the system."""


def lagrangian(q, v, params):
    """L(q, v), a scalar."""
    x, y, z = q
    well = (x**2 + y**2) / 2 + params["kappa"] * (x * jnp.sin(y + z) + z**2 / 2)
    return v @ v / 2 + params["beta"] * x * v[1] - well


def one_forms(q):
    """dz − y dx, shape (1, 3)."""
    return jnp.stack([-q[1], jnp.zeros(()), jnp.ones(())])[None]


def scene() -> Scene:
    """The particle, and the plane of admissible velocities that it carries."""
    place = lambda q: q
    tilt = lambda q: jnp.stack([1 + jnp.sqrt(1 + q[1] ** 2), 0.0 * q[0], -q[1], 0.0 * q[2]])  # of the normal to (−y, 0, 1)
    return Scene((axes(), box(place, tilt, size=(0.8, 0.8, 0.02), colour=2), point(place, trail=True)))


EXAMPLE = Example(
    name="contact-particle",
    title="Particle on a contact distribution",
    source="after McLachlan & Perlmutter 2006 and Modin & Verdier 2020",
    system=LagrangeDirac(lagrangian, one_forms),
    params=PARAMS,
    initial={"q": np.array([1.0, 0.4, 0.2]), "v": np.array([0.3, 0.6, 0.12])},
    scheme=DiscreteDirac(constraints="resolve"),
    step=0.05,
    steps=2000,
    coordinates=(Coordinate("x"), Coordinate("y"), Coordinate("z")),
    scene=scene(),
)
