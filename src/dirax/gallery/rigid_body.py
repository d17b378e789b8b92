"""The reduced free rigid body on the sphere ([BLM] Example 5.6), ξ̇ = ξ × I⁻¹ξ.

x = ξ ∈ S² ⊂ R³, the body angular momentum of unit length. The Dirac structure is the graph of the Lie–Poisson bivector
Λ(ξ)α = ξ × α, whose leaf the sphere is, with H = ξ·I⁻¹ξ/2. By the sphere projection the discrete system is [BLM] (4).
"""

import jax.numpy as jnp
import numpy as np

from dirax.gallery.example import Coordinate, Example
from dirax.geometry.maps import SphereProjection
from dirax.geometry.structures import DiracStructure
from dirax.schemes.discrete_dirac import DiscreteDirac
from dirax.show.scene import Scene, path, point, sphere
from dirax.systems.dirac_system import DiracSystem

PARAMS = {"I1": 1.0, "I2": 2.0, "I3": 3.0}


def bivector(x):
    """Λ(ξ), the matrix of α ↦ ξ × α; shape (3, 3)."""
    return jnp.array([[0.0, -x[2], x[1]], [x[2], 0.0, -x[0]], [-x[1], x[0], 0.0]])


def hamiltonian(x, params):
    """H(ξ) = ξ·I⁻¹ξ/2, a scalar."""
    return (x[0] ** 2 / params["I1"] + x[1] ** 2 / params["I2"] + x[2] ** 2 / params["I3"]) / 2


def scene() -> Scene:
    """The momentum on its sphere."""
    return Scene((sphere(), path(lambda x: x), point(lambda x: x, radius=0.04, trail=True)))


EXAMPLE = Example(
    name="rigid-body",
    title="Free rigid body on the sphere",
    source="Barbero Liñán, López Medel & Martín de Diego, Example 5.6",
    system=DiracSystem(DiracStructure.from_bivector(bivector), hamiltonian),
    params=PARAMS,
    initial={"x": np.array([0.3, 0.5, np.sqrt(1 - 0.34)])},
    scheme=DiscreteDirac(map=SphereProjection()),
    step=0.1,
    steps=1000,
    coordinates=(Coordinate("ξ1"), Coordinate("ξ2"), Coordinate("ξ3")),
    scene=scene(),
)
