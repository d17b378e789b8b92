"""The free top: a rigid body turning about its fixed centre of mass, as Euler–Poincaré equations on SO(3).

l(ω) = ½ Σ I_i ω_i², μ = Iω, μ̇ = μ × ω. x = μ, the body angular momentum. Started near the middle axis, which is unstable:
the body tumbles. |μ|² is a Casimir, and the spatial momentum of the reconstructed motion is conserved.
"""

import jax.numpy as jnp
import numpy as np

from dirax.gallery.example import Coordinate, Example
from dirax.gallery.heavy_top import along
from dirax.geometry.lie_groups import SO3
from dirax.reduction.euler_poincare import EulerPoincare
from dirax.schemes.euler_poincare import DiscreteEulerPoincare
from dirax.show.scene import Scene, arrow, attitudes, axes, box, point

PARAMS = {"I1": 1.0, "I2": 2.0, "I3": 3.0}


def inertia(params):
    """(I1, I2, I3)."""
    return jnp.stack([params["I1"], params["I2"], params["I3"]])


def lagrangian(xi, params):
    """½ Σ I_i ω_i², a scalar."""
    return xi @ (inertia(params) * xi) / 2


def motion(rows, params):
    """The attitude by integration of ω = I⁻¹μ from the identity."""
    omega = rows["x"] / np.array([float(params[name]) for name in ("I1", "I2", "I3")])
    return {"attitude": attitudes(rows["t"], omega)}


def scene() -> Scene:
    """The body, a corner of it with its trail, and the angular momentum, which stays."""
    tip = lambda attitude: along(attitude, jnp.array([0.75, 0.0, 0.0]))
    momentum = lambda attitude, x: along(attitude, x)
    bodies = (
        box([0.0, 0.0, 0.0], lambda attitude: attitude, size=(1.5, 0.95, 0.35)),
        point(tip, radius=0.05, trail=True, colour=1),
    )
    return Scene((axes(length=1.0), *bodies, arrow([0.0, 0.0, 0.0], momentum, scale=0.6)), fields=motion)


EXAMPLE = Example(
    name="free-top",
    title="Free top",
    source="Marsden & Ratiu, Introduction to Mechanics and Symmetry, §1.2",
    system=EulerPoincare(SO3(), lagrangian),
    params=PARAMS,
    initial={"x": np.array([0.01, 2.0, 0.01])},
    scheme=DiscreteEulerPoincare(),
    step=0.05,
    steps=2000,
    coordinates=(Coordinate("μ1"), Coordinate("μ2"), Coordinate("μ3")),
    scene=scene(),
)
