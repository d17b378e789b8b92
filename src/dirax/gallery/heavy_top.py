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
from dirax.show.scene import Scene, arrow, attitudes, axes, disk, point, rod
from dirax.systems.dirac_system import DiracSystem

PARAMS = {"I1": 1.0, "I2": 1.0, "I3": 0.5, "mgl": 1.0}


def bivector(x):
    """Λ(Π, Γ) of se(3)*, shape (6, 6)."""
    return jnp.block([[cross(x[:3]), cross(x[3:])], [cross(x[3:]), jnp.zeros((3, 3))]])


def hamiltonian(x, params):
    """H = Π·I⁻¹Π/2 + m g l Γ_3, a scalar."""
    return (x[0] ** 2 / params["I1"] + x[1] ** 2 / params["I2"] + x[2] ** 2 / params["I3"]) / 2 + params["mgl"] * x[5]


def motion(rows, params):
    """The attitude: its heading by integration of Ω = I⁻¹Π, its tilt that of Γ."""
    omega = rows["x"][:, :3] / np.array([float(params[name]) for name in ("I1", "I2", "I3")])
    return {"attitude": attitudes(rows["t"], omega, upright=rows["x"][:, 3:])}


def along(attitude, x):
    """The vector of the body x, (3,), in space."""
    w, u = attitude[0], attitude[1:]
    return x + 2 * jnp.cross(u, w * x + jnp.cross(u, x))


def scene() -> Scene:
    """The top on its point, with its angular momentum."""
    on_axis = lambda height: lambda attitude: along(attitude, jnp.array([0.0, 0.0, height]))
    momentum = lambda attitude, x: along(attitude, x[:3])
    return Scene(
        (
            axes(length=0.6),
            rod([0.0, 0.0, 0.0], on_axis(1.2)),
            disk(on_axis(0.75), lambda attitude: attitude, radius=0.5, thickness=0.12),
            point(on_axis(1.2), radius=0.035, trail=True, colour=1),
            arrow([0.0, 0.0, 0.0], momentum, scale=0.7),
        ),
        fields=motion,
    )


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
    scene=scene(),
)
