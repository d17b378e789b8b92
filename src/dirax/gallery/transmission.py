"""A continuously variable transmission driven by a pendulum: a hard case for nonholonomic integrators.

q = (x, y, ξ): two oscillators whose gear ratio sin ξ is set by the angle ξ of a pendulum, ẏ = sin ξ ẋ, after Modin & Verdier
(Discrete Contin. Dyn. Syst. 34, 2014; Numer. Math. 145, 2020); the gyroscopic term and the data are our own:

    L = (ẋ² + ẏ² + ξ̇²)/2 − (x² + y²)/2 + cos ξ + β (x + y²/2) ξ̇

The constraint has no component along ξ, so that the pendulum swings by itself and conserves its energy where β = 0; x and y
then see a linear system with periodic coefficients, reversible under v → −v. β ≠ 0 couples back and is not reversible.
"""

import jax.numpy as jnp
import numpy as np

from dirax.gallery.example import Coordinate, Example
from dirax.schemes.discrete_dirac import DiscreteDirac
from dirax.show.scene import Scene, box, plane, point, rod, spring
from dirax.systems.lagrange_dirac import LagrangeDirac

PARAMS = {"beta": 0.0}
CASES = {"integrable": {"beta": 0.0}, "irreversible": {"beta": 0.2}}
"""Parameters by what they make of the system."""


def lagrangian(q, v, params):
    """L(q, v), a scalar."""
    x, y, angle = q
    gyroscopic = params["beta"] * (x + y**2 / 2) * v[2]
    return v @ v / 2 + gyroscopic - (x**2 + y**2) / 2 + jnp.cos(angle)


def one_forms(q):
    """dy − sin ξ dx, shape (1, 3)."""
    return jnp.stack([-jnp.sin(q[2]), jnp.ones(()), jnp.zeros(())])[None]


def scene() -> Scene:
    """The pendulum, and the oscillators x and y side by side, each on a spring."""
    bob = lambda q: jnp.stack([jnp.sin(q[2]), 0.0 * q[2], 1.0 - jnp.cos(q[2])])
    parts = [rod((0.0, 0.0, 1.0), bob), point(bob, radius=0.1, trail=True)]
    for number, at in enumerate((0.7, 1.4)):
        mass = lambda q, i=number, at=at: jnp.stack([q[i], at + 0.0 * q[i], 0.15 + 0.0 * q[i]])
        wall = (-3.0, at, 0.15)
        parts += [box(wall, size=(0.06, 0.4, 0.3), colour="ink"), spring(wall, mass, radius=0.08)]
        parts += [box(mass, size=(0.3, 0.3, 0.3), colour=number + 1)]
    return Scene((plane(), *parts))


EXAMPLE = Example(
    name="transmission",
    title="Transmission driven by a pendulum",
    source="after Modin & Verdier 2014, 2020",
    system=LagrangeDirac(lagrangian, one_forms),
    params=PARAMS,
    initial={"q": np.array([1.0, 0.5, 0.8]), "v": np.array([0.2, 0.2 * np.sin(0.8), 0.7])},
    scheme=DiscreteDirac(constraints="resolve"),
    step=0.05,
    steps=2000,
    coordinates=(Coordinate("x"), Coordinate("y"), Coordinate("ξ", "rad")),
    scene=scene(),
)
