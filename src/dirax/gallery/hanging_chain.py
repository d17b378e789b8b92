"""A chain of N links without mass in the plane, with masses at their ends, hanging from a fixed point: N holonomic constraints.

    L = (1/N) Σ [|ẋ_i|²/2 − g y_i],   |x_i − x_{i−1}|² = 1/N²,   x_0 = 0

of length 1 and mass 1. Written in arrays: any number of links. Two links are a double pendulum.
"""

import jax.numpy as jnp
import numpy as np

from dirax.gallery.example import Coordinate, Example
from dirax.show.scene import Scene, point, rod
from dirax.systems.lagrange_dirac import LagrangeDirac

LINKS, GRAVITY = 4, 9.81


def lagrangian(q, v):
    """L of the places q (2N,), x and y in turn."""
    links = q.shape[0] // 2
    return (v @ v / 2 - GRAVITY * jnp.sum(q[1::2])) / links


def lengths(q):
    """(|x_i − x_{i−1}|² − 1/N²)/2 (N,)."""
    places = jnp.concatenate([jnp.zeros((1, 2)), q.reshape(-1, 2)])
    along = jnp.diff(places, axis=0)
    return (jnp.sum(along**2, axis=1) - (2 / q.shape[0]) ** 2) / 2


SYSTEM = LagrangeDirac(lagrangian, holonomic=lengths)


def straight(links: int, angle: float = np.pi / 2) -> np.ndarray:
    """The places (2N,) of a straight chain at an angle to the vertical, in radians."""
    return (np.arange(1, links + 1)[:, None] / links * [np.sin(angle), -np.cos(angle)]).ravel()


def scene(links: int = LINKS) -> Scene:
    """The chain in its plane."""
    joint = lambda i: (0.0, 0.0, 0.0) if i == 0 else lambda q: jnp.stack([q[2 * i - 2], 0.0 * q[0], q[2 * i - 1]])
    rods = (rod(joint(i), joint(i + 1)) for i in range(links))
    masses = (point(joint(i), radius=0.016, trail=i == links, colour=int(i == links)) for i in range(1, links + 1))
    return Scene((point(joint(0), colour="ink"), *rods, *masses), "front")


EXAMPLE = Example(
    name="hanging-chain",
    title="Hanging chain",
    source="N inextensible links in the plane",
    system=SYSTEM,
    initial={"q": straight(LINKS), "v": np.zeros(2 * LINKS)},
    step=0.01,
    steps=500,
    coordinates=tuple(Coordinate(f"{letter}{i}") for i in range(1, LINKS + 1) for letter in "xy"),
    scene=scene(),
)
