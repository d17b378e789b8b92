"""The mathematical pendulum as a canonical Hamiltonian system, for the θ maps ([BLM] Example 4.8).

x = (q, p) ∈ T*R, H = p²/2 − cos q, with the canonical Dirac structure of T*Q. Lifted to T*Q, the maps θ = 0, ½, 1 are the
symplectic Euler methods and the midpoint rule.
"""

import jax.numpy as jnp
import numpy as np

from dirax.gallery.example import Coordinate, Example
from dirax.geometry.cotangent_lift import cotangent_lift
from dirax.geometry.maps import Midpoint
from dirax.geometry.structures import induced_dirac
from dirax.schemes.discrete_dirac import DiscreteDirac
from dirax.show.scene import Scene, point, rod
from dirax.systems.dirac_system import DiracSystem


def hamiltonian(x):
    """H(q, p) = p²/2 − cos q, a scalar."""
    return x[1] ** 2 / 2 - jnp.cos(x[0])


def scene() -> Scene:
    """A rod and a bob."""
    bob = lambda x: jnp.stack([jnp.sin(x[0]), jnp.zeros(()), -jnp.cos(x[0])])
    pivot = [0.0, 0.0, 0.0]
    return Scene((rod(pivot, bob), point(pivot, radius=0.03, colour="ink"), point(bob, radius=0.08, trail=True)), view="front")


EXAMPLE = Example(
    name="pendulum",
    title="Mathematical pendulum",
    source="Barbero Liñán, López Medel & Martín de Diego, Examples 4.8 and 4.13",
    system=DiracSystem(induced_dirac(None, 1), hamiltonian),
    initial={"x": np.array([2.0, 0.0])},
    scheme=DiscreteDirac(map=cotangent_lift(Midpoint())),
    step=0.1,
    steps=1000,
    coordinates=(Coordinate("q", "rad"), Coordinate("p")),
    scene=scene(),
)
