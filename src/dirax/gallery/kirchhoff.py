"""Kirchhoff's rigid body in an ideal fluid, a Lie–Poisson system on se(3)*: Π̇ = Π × Ω + P × V, Ṗ = P × Ω.

x = (Π, P): angular and linear impulse in the body frame, H = Π·I⁻¹Π/2 + P·M⁻¹P/2, Ω = I⁻¹Π, V = M⁻¹P (Lamb,
Hydrodynamics, §124). |P|² and Π·P are Casimirs, quadratic, so the midpoint map keeps them.
"""

import jax.numpy as jnp
import numpy as np

from dirax.gallery.example import Coordinate, Example
from dirax.gallery.heavy_top import along, bivector
from dirax.geometry.maps import Midpoint
from dirax.geometry.structures import DiracStructure
from dirax.schemes.discrete_dirac import DiscreteDirac
from dirax.show.scene import Scene, arrow, attitudes, axes, box, point
from dirax.systems.dirac_system import DiracSystem

INERTIA = np.array([1.0, 1.5, 2.0, 1.0, 2.0, 2.5])
"""Moments of inertia and masses, the fluid's share included."""


def hamiltonian(x):
    """H = Π·I⁻¹Π/2 + P·M⁻¹P/2, a scalar."""
    return x @ (x / jnp.asarray(INERTIA)) / 2


def motion(rows, params):
    """The attitude by integration of Ω = I⁻¹Π from the identity."""
    return {"attitude": attitudes(rows["t"], rows["x"][:, :3] / INERTIA[:3])}


def scene() -> Scene:
    """The body, as one sees it who travels with it: its linear impulse, which stays, and its velocity, with a trail."""
    impulse = lambda attitude, x: along(attitude, x[3:])
    velocity = lambda attitude, x: 2 * along(attitude, x[3:] / INERTIA[3:])
    body = box([0.0, 0.0, 0.0], lambda attitude: attitude, size=(1.2, 0.8, 0.5))
    arrows = arrow([0.0, 0.0, 0.0], impulse, colour=1), arrow([0.0, 0.0, 0.0], velocity)
    return Scene((axes(length=0.6), body, *arrows, point(velocity, radius=0.04, trail=True)), fields=motion)


EXAMPLE = Example(
    name="kirchhoff",
    title="Rigid body in an ideal fluid",
    source="Lamb, Hydrodynamics, §124",
    system=DiracSystem(DiracStructure.from_bivector(bivector), hamiltonian),
    initial={"x": np.array([0.4, 0.6, 0.8, 0.9, -0.2, 0.3])},
    scheme=DiscreteDirac(map=Midpoint()),
    step=0.05,
    steps=2000,
    coordinates=tuple(Coordinate(name) for name in ("Π1", "Π2", "Π3", "P1", "P2", "P3")),
    scene=scene(),
)
