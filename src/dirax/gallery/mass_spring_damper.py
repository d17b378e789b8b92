"""A chain of masses, springs that harden, and dampers, pushed at its end: a port-Hamiltonian system.

x = (e_1, …, e_n, p_1, …, p_n): elongations of the springs, the first of them tied to the wall, and momenta.

    H = Σ (k e_i²/2 + s e_i⁴/4 + p_i²/2m),   ė_i = v_i − v_{i−1},   ṗ_i = F_i − F_{i+1} − d v_i,   u pushes the last mass.
"""

import itertools

import jax.numpy as jnp
import numpy as np

from dirax.gallery.example import Coordinate, Example
from dirax.schemes.discrete_gradient import DiscreteGradient
from dirax.show.scene import Scene, box, plane, spring
from dirax.systems.port_hamiltonian import PortHamiltonian

PARAMS = {"m": 1.0, "k": 1.0, "s": 0.5, "d": 0.05}
MASSES = 3


def chain(n: int = MASSES) -> PortHamiltonian:
    """The chain of n masses, with one open port: force in, velocity of the last mass out."""
    difference = np.eye(n) - np.eye(n, k=-1)
    zero = np.zeros((n, n))
    J = np.block([[zero, difference], [-difference.T, zero]])

    def hamiltonian(x, params):
        e, p = x[:n], x[n:]
        return params["k"] * (e @ e) / 2 + params["s"] * jnp.sum(e**4) / 4 + p @ p / (2 * params["m"])

    def R(x, params):
        return params["d"] * jnp.diag(jnp.concatenate([jnp.zeros(n), jnp.ones(n)]))

    return PortHamiltonian(hamiltonian, J=J, B=np.eye(2 * n)[:, -1:], R=R)


def scene() -> Scene:
    """The chain from its wall, springs of length 1 where they are not stretched."""
    place = lambda k: lambda x: jnp.stack([k + 1.0 + jnp.sum(x[: k + 1]), jnp.zeros(()), jnp.zeros(())])
    wall = box([-0.04, 0.0, 0.0], size=(0.08, 1.0, 1.0), colour="ink")
    ends = [[0.0, 0.0, 0.0], *(place(k) for k in range(MASSES))]
    springs = [spring(a, b, radius=0.12) for a, b in itertools.pairwise(ends)]
    masses = [box(place(k), size=(0.3, 0.3, 0.3), colour=k) for k in range(MASSES)]
    return Scene((plane([0.0, 0.0, -0.15]), wall, *springs, *masses))


EXAMPLE = Example(
    name="mass-spring-damper",
    title="Chain of masses, springs and dampers",
    source="port-Hamiltonian system of [BLM] §7",
    system=chain(),
    params=PARAMS,
    initial={"x": np.array([0.5, -0.2, 0.8, 0.0, 0.0, 0.0])},
    scheme=DiscreteGradient(),
    step=0.05,
    steps=1000,
    coordinates=tuple(Coordinate(f"{letter}{i}") for letter in "ep" for i in range(1, MASSES + 1)),
    scene=scene(),
)
