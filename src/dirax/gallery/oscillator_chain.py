"""Chains of oscillators: that of Fermi, Pasta, Ulam and Tsingou between two walls, and Toda's in a ring, which is integrable.

    L = Σ q̇_i²/2 − Σ V(q_{i+1} − q_i),   V(d) = d²/2 + α d³/3 + β d⁴/4

E. Fermi, J. Pasta, S. Ulam, Studies of nonlinear problems, Los Alamos report LA-1940 (1955): 32 masses that begin in their first
mode come back to it. With V(d) = (e^{2αd} − 2αd − 1)/(4α²) a ring of them is Toda's (M. Toda, J. Phys. Soc. Japan
22 (1967) 431), of which α d³/3 is the first term: the eigenvalues of the matrix of H. Flaschka (Phys. Rev. B 9 (1974) 1924)
do not change. Written in arrays: any number of sites.
"""

import jax.numpy as jnp
import numpy as np

from dirax.gallery.example import Coordinate, Example
from dirax.show.scene import Scene, point, rod
from dirax.systems.lagrange_dirac import LagrangeDirac

SITES, ALPHA = 12, 0.25


def chain(alpha: float = ALPHA, beta: float = 0.0) -> LagrangeDirac:
    """The chain of Fermi, Pasta, Ulam and Tsingou with fixed ends, of as many sites as the data have."""

    def lagrangian(q, v):
        d = jnp.diff(jnp.concatenate([jnp.zeros(1), q, jnp.zeros(1)]))
        return v @ v / 2 - jnp.sum(d**2 / 2 + alpha * d**3 / 3 + beta * d**4 / 4)

    return LagrangeDirac(lagrangian)


def toda_chain(alpha: float = ALPHA) -> LagrangeDirac:
    """Toda's chain, closed to a ring: the potential of the other to third order in d."""

    def lagrangian(q, v):
        d = jnp.roll(q, -1) - q
        return v @ v / 2 - jnp.sum(jnp.exp(2 * alpha * d) - 2 * alpha * d - 1) / (4 * alpha**2)

    return LagrangeDirac(lagrangian)


def first_mode(sites: int, amplitude: float = 1.0) -> np.ndarray:
    """The first mode of the linear chain, of the given amplitude (sites,)."""
    return amplitude * np.sin(np.pi * np.arange(1, sites + 1) / (sites + 1))


def toda_eigenvalues(q: np.ndarray, p: np.ndarray, alpha: float = ALPHA) -> np.ndarray:
    """The conserved eigenvalues of Flaschka's matrix at (q, p): α p_i on its diagonal, e^{α(q_{i+1} − q_i)}/2 beside it."""
    sites, beside = len(q), np.exp(alpha * (np.roll(q, -1) - q)) / 2
    upper = np.zeros((sites, sites))
    upper[np.arange(sites), (np.arange(sites) + 1) % sites] = beside
    return np.linalg.eigvalsh(np.diag(alpha * np.asarray(p)) + upper + upper.T)


def scene(sites: int = SITES) -> Scene:
    """The displacements of the masses, drawn upwards, over their places at rest, a quarter apart."""
    place = lambda i: jnp.array([0.25 * (i - (sites - 1) / 2), 0.0, 0.0])
    mass = lambda i: lambda q: place(i) + jnp.array([0.0, 0.0, 1.0]) * q[i]
    springs = (rod(mass(i), mass(i + 1)) for i in range(sites - 1))
    return Scene((*springs, *(point(mass(i), radius=0.06) for i in range(sites))), "front")


EXAMPLE = Example(
    name="oscillator-chain",
    title="Chain of Fermi, Pasta, Ulam and Tsingou",
    source="Fermi, Pasta & Ulam, LA-1940 (1955)",
    system=chain(),
    initial={"q": first_mode(SITES), "v": np.zeros(SITES)},
    step=0.1,
    steps=2000,
    coordinates=tuple(Coordinate(f"q{i}") for i in range(1, SITES + 1)),
    scene=scene(),
)
