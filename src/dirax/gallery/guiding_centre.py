"""The guiding centre of a charged particle in the plane: a massless particle in a magnetic field that varies.

q = (x, y), L = A(q)·q̇ − φ(q) with A = (½ + b r²/4)(−y, x), so that B = 1 + b r², and φ = (x² + s y²)/2. It drifts along
the equipotentials: B ẋ = −∂φ/∂y, B ẏ = ∂φ/∂x.
"""

import jax.numpy as jnp
import numpy as np

from dirax.gallery.example import Coordinate, Example
from dirax.schemes.discrete_dirac import DiscreteDirac
from dirax.show.scene import Scene, path, plane, point
from dirax.systems.phase_space import PhaseSpaceLagrangian

PARAMS = {"b": 0.3, "s": 2.0}


def potential_one_form(q, params):
    """A(q), shape (2,)."""
    return (0.5 + params["b"] * (q @ q) / 4) * jnp.stack([-q[1], q[0]])


def potential(q, params):
    """φ(q), a scalar."""
    return (q[0] ** 2 + params["s"] * q[1] ** 2) / 2


def scene() -> Scene:
    """The drift in the plane."""
    return Scene((plane(), path(lambda q: q), point(lambda q: q, trail=True)), view="tilted")


EXAMPLE = Example(
    name="guiding-centre",
    title="Guiding centre in a varying magnetic field",
    source="massless limit of a charged particle; a phase-space Lagrangian of [BLM] §6",
    system=PhaseSpaceLagrangian(potential_one_form, potential),
    params=PARAMS,
    initial={"q": np.array([1.0, 0.5]), "v": np.zeros(2)},
    scheme=DiscreteDirac(constraints="resolve"),
    step=0.1,
    steps=2000,
    coordinates=(Coordinate("x"), Coordinate("y")),
    scene=scene(),
)
