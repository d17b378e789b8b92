"""A direct-current motor: an electrical and a mechanical port-Hamiltonian system, interconnected.

Circuit: flux Φ, H = Φ²/2L, ports voltage V and back-electromotive force; rotor: angular momentum p, H = p²/2J, port torque.
The feedback of the two is Φ̇ = −R i − K ω + V, ṗ = K i − d ω, with i = Φ/L and ω = p/J: x = (Φ, p), one port left, V.
"""

import jax.numpy as jnp
import numpy as np

from dirax.gallery.example import Coordinate, Example
from dirax.schemes.discrete_gradient import DiscreteGradient
from dirax.show.scene import Scene, arrow, box, disk, rod, turn
from dirax.systems.interconnection import interconnect
from dirax.systems.port_hamiltonian import PortHamiltonian

PARAMS = {"L": 0.5, "R": 1.0, "K": 0.8, "J": 0.2, "d": 0.05, "V": 2.0}
"""Inductance, resistance, motor constant, inertia, friction, and the voltage that is switched on at t = 0."""

CIRCUIT = PortHamiltonian(
    lambda x, params: x[0] ** 2 / (2 * params["L"]),
    J=np.zeros((1, 1)),
    R=lambda x, params: jnp.asarray(params["R"], float)[None, None],
    B=lambda x, params: jnp.stack([jnp.ones(()), jnp.asarray(params["K"], float)])[None],
)
ROTOR = PortHamiltonian(
    lambda x, params: x[0] ** 2 / (2 * params["J"]),
    J=np.zeros((1, 1)),
    R=lambda x, params: jnp.asarray(params["d"], float)[None, None],
    B=np.ones((1, 1)),
)


def exact(t, x, params=None) -> np.ndarray:
    """The solution at times `t` (rows,) under the constant voltage, shape (rows, 2), by the eigenvectors of the system."""
    p = {**PARAMS, **(params or {})}
    matrix = np.array([[-p["R"] / p["L"], -p["K"] / p["J"]], [p["K"] / p["L"], -p["d"] / p["J"]]])
    rest = -np.linalg.solve(matrix, [p["V"], 0.0])
    values, vectors = np.linalg.eig(matrix)
    part = np.linalg.solve(vectors, np.asarray(x, float) - rest)
    return rest + (np.exp(np.outer(np.atleast_1d(t), values)) * part @ vectors.T).real


def motion(rows, params):
    """The angle of the rotor, by integration of ω = p/J, and the current."""
    speed = rows["x"][:, 1] / float(params["J"])
    angle = np.concatenate([[0.0], np.cumsum(np.diff(rows["t"]) * (speed[1:] + speed[:-1]) / 2)])
    return {"angle": angle[:, None], "current": rows["x"][:, :1] / float(params["L"])}


def scene() -> Scene:
    """The rotor between two magnets, and the current as an arrow along its shaft."""
    shaft = rod((0.0, 0.0, -0.5), (0.0, 0.0, 0.5), radius=0.03)
    rotor = disk((0.0, 0.0, 0.0), lambda angle: turn([0, 0, 1], angle[0]), radius=0.6, thickness=0.3)
    magnets = (box((side, 0.0, 0.0), size=(0.3, 0.9, 0.5), colour=k) for k, side in enumerate((-0.95, 0.95), start=1))
    current = arrow((0.0, 0.0, 0.5), lambda current: jnp.stack([0.0 * current[0], 0.0 * current[0], current[0]]), colour=3)
    return Scene((shaft, rotor, *magnets, current), fields=motion)


EXAMPLE = Example(
    name="dc-motor",
    title="Direct-current motor",
    source="interconnection of port-Hamiltonian systems, [BLM] §7",
    system=interconnect(CIRCUIT, ROTOR, ports=[1], other_ports=[0], sizes=(1, 1), params=PARAMS).with_inputs(
        lambda t, x, params: jnp.asarray(params["V"], float)[None]
    ),
    params=PARAMS,
    initial={"x": np.zeros(2)},
    scheme=DiscreteGradient(),
    step=0.01,
    steps=500,
    coordinates=(Coordinate("Φ"), Coordinate("p")),
    exact=exact,
    scene=scene(),
)
