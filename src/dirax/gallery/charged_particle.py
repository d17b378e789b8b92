"""A charged particle in a constant magnetic field, by the Kaluza–Klein Lagrangian on R³ × S¹ ([RL] §7.1).

q = (x, y, z, θ), B = (0, 0, B0), A(q) = (B0/2)(−y, x, 0), in units with c = 1:

    L = m |ẋ|²/2 + (A(q)·ẋ + θ̇)²/2

θ is cyclic and its momentum A·ẋ + θ̇ is the charge. The paper takes m = e = B0 = 1 and T = 20; the particle runs on a helix.
"""

import jax.numpy as jnp
import numpy as np

from dirax.gallery.example import Coordinate, Example
from dirax.schemes.lagrange_dirac import PlusLagrangeDirac
from dirax.show.scene import Scene, arrow, path, plane, point
from dirax.systems.lagrange_dirac import LagrangeDirac

PARAMS = {"m": 1.0, "B0": 1.0}
END = 20.0


def lagrangian(q, v, params):
    """L(q, v), a scalar."""
    charge = params["B0"] / 2 * (q[0] * v[1] - q[1] * v[0]) + v[3]
    return params["m"] * (v[:3] @ v[:3]) / 2 + charge**2 / 2


def exact(t, q, v, params=None) -> np.ndarray:
    """The helix through (q, v) at times `t` (rows,), shape (rows, 4); θ by integrating θ̇ = e − A·ẋ.

    Raises `ValueError` for a particle without charge, or without a field, which runs straight on.
    """
    p = {**PARAMS, **(params or {})}
    q, v, t = np.asarray(q, float), np.asarray(v, float), np.atleast_1d(np.asarray(t, float))
    charge = p["B0"] / 2 * (q[0] * v[1] - q[1] * v[0]) + v[3]
    turn = charge * p["B0"] / p["m"]
    if turn == 0:
        raise ValueError(
            f"the exact solution is written for a particle that turns, but its charge is {charge:g} and B0 = {p['B0']:g}: "
            "give another v[3] or B0."
        )
    place, speed = complex(*q[:2]), complex(*v[:2])
    centre = place + speed / (1j * turn)
    along = (1 - np.exp(-1j * turn * t)) / (1j * turn)  # ∫ exp(−i turn t) dt
    plane = place + speed * along
    # A·ẋ = (B0/2) Im(conj(plane) d plane/dt)
    potential = p["B0"] / 2 * ((np.conj(centre) * speed * along).imag - abs(speed) ** 2 * t / turn)
    return np.stack([plane.real, plane.imag, q[2] + v[2] * t, q[3] + charge * t - potential], axis=1)


def turn_of_the_circle(q):
    """The generator of translations of θ; its momentum is the charge."""
    return jnp.array([0.0, 0.0, 0.0, 1.0])


def scene() -> Scene:
    """The particle on its helix about the field."""
    place = lambda q: q[:3]
    return Scene((plane(), path(place), point(place, trail=True), arrow([0.0, 0.0, 0.0], [0.0, 0.0, 5.0], colour="ink")))


EXAMPLE = Example(
    name="charged-particle",
    title="Charged particle in a magnetic field",
    source="Rodríguez Abella & Leok, §7.1",
    system=LagrangeDirac(lagrangian),
    params=PARAMS,
    initial={"q": np.zeros(4), "v": np.array([1.0, 0.0, 1.0, 1.0])},
    scheme=PlusLagrangeDirac(),
    step=END / 200,
    steps=200,
    coordinates=(Coordinate("x"), Coordinate("y"), Coordinate("z"), Coordinate("θ", "rad")),
    exact=exact,
    symmetries={"charge": turn_of_the_circle},
    scene=scene(),
)
