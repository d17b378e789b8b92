"""The heavy top on SO(3): the system of `heavy-top` with its motion on the group, as a Hamiltonian on so(3)* ⋉ R³.

x = (Π, Γ), H = Π·I⁻¹Π/2 + m g l Γ_3; Γ is a vector that the rotations carry along, the direction upwards. Besides |Γ|² and
Π·Γ the discrete equations keep Π_3 of the symmetric top; `dx.reconstruct` gives its attitude, a quaternion.
"""

import jax.numpy as jnp

from dirax.gallery import heavy_top
from dirax.gallery.example import Example
from dirax.geometry.lie_groups import SO3
from dirax.reduction.lie_poisson import LiePoisson
from dirax.schemes.euler_poincare import DiscreteEulerPoincare


def hamiltonian(mu, gamma, params):
    """H(Π, Γ), a scalar."""
    return heavy_top.hamiltonian(jnp.concatenate([mu, gamma]), params)


EXAMPLE = Example(
    name="heavy-top-so3",
    title="Heavy top on SO(3)",
    source="Marsden & Ratiu, Introduction to Mechanics and Symmetry, §1.4",
    system=LiePoisson(SO3(), hamiltonian, advected=3),
    params=heavy_top.PARAMS,
    initial=heavy_top.EXAMPLE.initial,
    scheme=DiscreteEulerPoincare(),
    step=heavy_top.EXAMPLE.step,
    steps=heavy_top.EXAMPLE.steps,
    coordinates=heavy_top.EXAMPLE.coordinates,
    plane=heavy_top.EXAMPLE.plane,
    scene=heavy_top.EXAMPLE.scene,
)
