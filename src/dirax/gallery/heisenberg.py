"""The classical Heisenberg system ([PY] §8.2): a free particle in space with one nonholonomic constraint.

    L = (ẋ² + ẏ² + ż²)/2,   ż = y ẋ − x ẏ

Differentiating the constraint along p = q̇, ṗ = μ (−y, x, 1) gives μ (1 + x² + y²) = 0: there is no constraint force, and
every solution is a straight line at constant velocity. The same computation with differences shows it of the (+) and (−)
schemes too, which are one and the same here: q_k = q_0 + k (q_1 − q_0), with the energy |q_1 − q_0|²/(2h²) constant.
"""

import jax.numpy as jnp
import numpy as np

from dirax.gallery.example import Coordinate, Example
from dirax.schemes.lagrange_dirac import PlusLagrangeDirac
from dirax.show.scene import Scene, axes, path, point, rod
from dirax.systems.lagrange_dirac import LagrangeDirac

TWO_POINTS = {"q0": np.array([1.0, 0.0, 0.1]), "q1": np.array([1.05, 0.1, 0.0])}
"""[PY] (62), for h = .01, with the decimal points where they satisfy the constraint."""


def lagrangian(q, v):
    """L(q, v) = |v|²/2, a scalar."""
    return v @ v / 2


def one_forms(q):
    """dz − y dx + x dy, shape (1, 3)."""
    return jnp.array([[-q[1], q[0], 1.0]])


def exact(t, q, v, params=None) -> np.ndarray:
    """The straight line q + t v at times `t` (rows,), shape (rows, 3)."""
    return np.asarray(q) + np.atleast_1d(np.asarray(t, float))[:, None] * np.asarray(v)


def scene() -> Scene:
    """The straight line; the particle falls by twice the area that the rod from the axis to the point below it sweeps."""
    place, below = (lambda q: q), (lambda q: q * jnp.array([1.0, 1.0, 0.0]))
    return Scene((axes(), path(place), path(below), rod((0.0, 0.0, 0.0), below), rod(below, place), point(place, trail=True)))


EXAMPLE = Example(
    name="heisenberg",
    title="Heisenberg system",
    source="Peng & Yoshimura, §8.2",
    system=LagrangeDirac(lagrangian, one_forms),
    initial={"q": np.array([1.0, 0.0, 0.1]), "v": np.array([5.0, 10.0, -10.0])},
    scheme=PlusLagrangeDirac(),
    step=1e-2,
    steps=100_000,
    coordinates=(Coordinate("x"), Coordinate("y"), Coordinate("z")),
    exact=exact,
    scene=scene(),
)
