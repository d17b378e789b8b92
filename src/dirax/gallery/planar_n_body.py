"""N bodies in a plane under Newton's law, with translations and rotations as symmetries.

q = (x_1, y_1, …, x_N, y_N), masses m of shape (N,):

    L = Σ m_i |ṙ_i|²/2 + G Σ_{i<j} m_i m_j / |r_i − r_j|

The data are the figure eight of three equal masses (Chenciner and Montgomery, Annals of Mathematics 152, 2000; digits of
Simó), of period 6.32591398 and angular momentum 0; `lagrange(masses)` gives the equilateral solution of Lagrange, a circle.

Translations act on all bodies alike. In the coordinates of `from_shape`, y = (ρ, s_2, …, s_{N−1}, X, Y, θ), they and the
rotations are translations of (X, Y), the centre of mass, and of θ, the direction from the first body to the second; ρ is
their distance, and s_j ∈ R² is the Jacobi vector from the centre of mass of the first j bodies to body j + 1, turned by −θ.
There L is invariant under y ↦ y + (0, …, 0, a, b, c): `SYMMETRIC`, whose last three coordinates are cyclic.
"""

import jax.numpy as jnp
import numpy as np

from dirax.gallery.example import Coordinate, Example
from dirax.reduction.coordinates import in_coordinates
from dirax.show.scene import Scene, plane, point
from dirax.systems.lagrange_dirac import LagrangeDirac

PERIOD = 6.32591398
PARAMS = {"m": np.ones(3), "G": 1.0}


def lagrangian(q, v, params):
    """L(q, v), a scalar."""
    m, n = params["m"], q.shape[0] // 2
    r, speed = q.reshape(n, 2), v.reshape(n, 2)
    first, second = np.triu_indices(n, 1)
    gap = r[first] - r[second]
    attraction = jnp.sum(m[first] * m[second] / jnp.sqrt(jnp.sum(gap**2, axis=1)))
    return jnp.sum(m * jnp.sum(speed**2, axis=1)) / 2 + params["G"] * attraction


def jacobi(q, masses):
    """The Jacobi vectors ρ_1, …, ρ_{N−1} of bodies at q (2N,), and their centre of mass: (N, 2)."""
    r, m = jnp.reshape(q, (-1, 2)), jnp.asarray(masses)
    total = jnp.cumsum(m)
    centres = jnp.cumsum(m[:, None] * r, axis=0) / total[:, None]
    return jnp.concatenate([r[1:] - centres[:-1], centres[-1:]])


def from_jacobi(vectors, masses):
    """The bodies (2N,) of `jacobi`; linear in the vectors (N, 2)."""
    m, bodies = jnp.asarray(masses), [jnp.zeros(2)]
    total = m[0]
    for j in range(len(vectors) - 1):  # each body is put where its Jacobi vector says, and the centre of mass moved back to 0
        here = vectors[j]
        share = m[j + 1] / (total + m[j + 1])
        bodies = [body - share * here for body in bodies] + [(1.0 - share) * here]
        total = total + m[j + 1]
    return jnp.concatenate([body + vectors[-1] for body in bodies])


def turned(angle, vectors):
    """Vectors (r, 2) turned by an angle."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([c * vectors[:, 0] - s * vectors[:, 1], s * vectors[:, 0] + c * vectors[:, 1]], axis=1)


def from_shape(y, params):
    """The bodies q of the coordinates y = (ρ, s_2, …, s_{N−1}, X, Y, θ), all of shape (2N,)."""
    shape = jnp.concatenate([y[:1], jnp.zeros(1), y[1:-3]]).reshape(-1, 2)
    return from_jacobi(jnp.concatenate([turned(y[-1], shape), y[-3:-1][None]]), params["m"])


def to_shape(q, params):
    """The coordinates y of the bodies q; θ in (−π, π]."""
    vectors = jacobi(q, params["m"])
    angle = jnp.arctan2(vectors[0, 1], vectors[0, 0])
    shape = turned(-angle, vectors[:-1]).reshape(-1)
    return jnp.concatenate([shape[:1], shape[2:], vectors[-1], angle[None]])


def lagrange(masses=(1.0, 1.0, 1.0), side: float = 1.0, G: float = 1.0) -> dict[str, np.ndarray]:
    """Initial q and v of Lagrange's solution: three bodies in an equilateral triangle that turns at the rate √(GM/side³)."""
    m = np.asarray(masses, dtype=float)
    r = side / np.sqrt(3) * np.array([[np.cos(a), np.sin(a)] for a in np.pi / 2 + 2 * np.pi / 3 * np.arange(3)])
    r = r - m @ r / m.sum()
    rate = np.sqrt(G * m.sum() / side**3)
    return {"q": r.ravel(), "v": rate * np.stack([-r[:, 1], r[:, 0]], axis=1).ravel()}


def rotation(q):
    """The generator of rotations about the origin."""
    r = q.reshape(-1, 2)
    return jnp.stack([-r[:, 1], r[:, 0]], axis=1).reshape(-1)


def along(axis: int):
    """The generator of translations of all bodies along an axis of the plane."""
    return lambda q: jnp.zeros_like(q).at[axis::2].set(1.0)


SYSTEM = LagrangeDirac(lagrangian)
SYMMETRIC = in_coordinates(SYSTEM, from_shape)
"""The system in the coordinates of `from_shape`; its `fibre` for N bodies is range(2N − 3, 2N)."""

_POSITION, _SPEED = np.array([0.97000436, -0.24308753]), np.array([-0.93240737, -0.86473146])


def scene() -> Scene:
    """The bodies in their plane."""
    places = [lambda q, k=k: q[2 * k : 2 * k + 2] for k in range(3)]
    return Scene((plane(), *(point(place, radius=0.05, trail=True, colour=k) for k, place in enumerate(places))), view="tilted")


EXAMPLE = Example(
    name="planar-n-body",
    title="Planar three-body problem: the figure eight",
    source="Chenciner & Montgomery, Annals of Mathematics 152 (2000)",
    system=SYSTEM,
    params=PARAMS,
    initial={
        "q": np.concatenate([_POSITION, -_POSITION, np.zeros(2)]),
        "v": np.concatenate([-_SPEED / 2, -_SPEED / 2, _SPEED]),
    },
    step=PERIOD / 2000,
    steps=2000,
    coordinates=tuple(Coordinate(f"{axis}{body}") for body in (1, 2, 3) for axis in "xy"),
    symmetries={"momentum along x": along(0), "momentum along y": along(1), "angular momentum": rotation},
    scene=scene(),
)
