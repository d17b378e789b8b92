"""The heavy top as a Lie–Poisson system on se(3)*: Π̇ = Π × Ω + m g l Γ × χ, Γ̇ = Γ × Ω, Ω = I⁻¹Π.

x = (Π, Γ): angular momentum and direction of gravity in the body frame (Marsden & Ratiu, Introduction to Mechanics and
Symmetry, §1.4). Λ(Π, Γ)(α, β) = (Π × α + Γ × β, Γ × α), H = Π·I⁻¹Π/2 + m g l Γ·χ. |Γ|² and Π·Γ are Casimirs, quadratic,
so the midpoint map keeps them; for a symmetric top Π·χ is conserved as well.
"""

import jax.numpy as jnp
import numpy as np

from dirax.gallery.example import Coordinate, Example
from dirax.gallery.rigid_body import bivector as cross
from dirax.geometry.maps import Midpoint
from dirax.geometry.structures import DiracStructure
from dirax.schemes.discrete_dirac import DiscreteDirac
from dirax.systems.dirac_system import DiracSystem

PARAMS = {"I1": 1.0, "I2": 1.0, "I3": 0.5, "mgl": 1.0}


def bivector(x):
    """Λ(Π, Γ) of se(3)*, shape (6, 6)."""
    return jnp.block([[cross(x[:3]), cross(x[3:])], [cross(x[3:]), jnp.zeros((3, 3))]])


def hamiltonian(x, params):
    """H = Π·I⁻¹Π/2 + m g l Γ_3, a scalar."""
    return (x[0] ** 2 / params["I1"] + x[1] ** 2 / params["I2"] + x[2] ** 2 / params["I3"]) / 2 + params["mgl"] * x[5]


EXAMPLE = Example(
    name="heavy-top",
    title="Heavy top",
    source="Marsden & Ratiu, Introduction to Mechanics and Symmetry, §1.4",
    system=DiracSystem(DiracStructure.from_bivector(bivector), hamiltonian),
    params=PARAMS,
    initial={"x": np.array([0.1, 0.0, 1.5, np.sin(0.4), 0.0, np.cos(0.4)])},
    scheme=DiscreteDirac(map=Midpoint()),
    step=0.05,
    steps=2000,
    coordinates=tuple(Coordinate(name) for name in ("Π1", "Π2", "Π3", "Γ1", "Γ2", "Γ3")),
    plane=(3, 4),
)
