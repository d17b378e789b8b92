"""A bottom-heavy underwater vehicle: Kirchhoff's body with its centre of gravity below that of buoyancy, on SE(3).

x = (P, Π, Γ): linear and angular impulse and the direction of gravity in the body frame; ξ = (V, Ω).

    l = ½ V·M V + ½ Ω·I Ω + m g l Γ_3,   Ṗ = P × Ω,   Π̇ = Π × Ω + P × V − m g l Γ × e_3,   Γ̇ = Γ × Ω

(Leonard, Automatica 33 (1997).) |P|², P·Γ and |Γ|² are Casimirs. Started along its largest mass, which is stable.
"""

import jax.numpy as jnp
import numpy as np

from dirax.gallery.example import Coordinate, Example
from dirax.gallery.heavy_top import along
from dirax.geometry.lie_groups import SE3
from dirax.reduction.euler_poincare import EulerPoincare
from dirax.schemes.euler_poincare import DiscreteEulerPoincare
from dirax.show.scene import Scene, arrow, attitudes, axes, box, point, rod

INERTIA = np.array([1.0, 2.0, 2.5, 1.0, 1.5, 2.0])
"""Masses and moments of inertia, the fluid's share included, in the order of ξ."""

PARAMS = {"mgl": 0.5}


def lagrangian(xi, gamma, params):
    """½ V·M V + ½ Ω·I Ω + m g l Γ_3, a scalar."""
    return xi @ (jnp.asarray(INERTIA) * xi) / 2 + params["mgl"] * gamma[2]


def motion(rows, params):
    """The attitude: its heading by integration of Ω = I⁻¹Π, its tilt that of Γ, which points down."""
    return {"attitude": attitudes(rows["t"], rows["x"][:, 3:6] / INERTIA[3:], upright=-rows["x"][:, 6:])}


def scene() -> Scene:
    """The vehicle, as one sees it who travels with it, its weight below, and its velocity with a trail."""
    weight = lambda attitude: along(attitude, jnp.array([0.0, 0.0, 0.5]))
    velocity = lambda attitude, x: along(attitude, x[:3] / INERTIA[:3])
    parts = (
        box([0.0, 0.0, 0.0], lambda attitude: attitude, size=(1.4, 0.8, 0.4)),
        rod([0.0, 0.0, 0.0], weight),
        point(weight, radius=0.1, colour=1),
        arrow([0.0, 0.0, 0.0], velocity, scale=1.2),
        point(lambda attitude, x: 1.2 * velocity(attitude, x), radius=0.03, trail=True),
    )
    return Scene((axes(length=0.5), *parts), fields=motion)


EXAMPLE = Example(
    name="underwater-vehicle",
    title="Underwater vehicle",
    source="Leonard, Automatica 33 (1997) 331–346",
    system=EulerPoincare(SE3(), lagrangian, advected=3),
    params=PARAMS,
    initial={"x": np.array([0.2, 0.1, 2.5, 0.05, -0.1, 0.4, np.sin(0.2), 0.0, np.cos(0.2)])},
    scheme=DiscreteEulerPoincare(),
    step=0.05,
    steps=2000,
    coordinates=tuple(Coordinate(name) for name in ("P1", "P2", "P3", "Π1", "Π2", "Π3", "Γ1", "Γ2", "Γ3")),
    plane=(6, 7),
    scene=scene(),
)
