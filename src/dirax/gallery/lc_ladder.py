"""Circuits from a netlist of their elements, and an LC ladder as the example.

x = (charges of the capacitors, fluxes of the inductors), in the order of the list; the potentials of the nodes, and the
currents of the voltage sources after them, are the multipliers of an implicit system (Kirchhoff's laws):

    A_C q̇ + A_L φ/L + A_R Aᵀ_R e/R + A_V i = 0,   φ̇ = Aᵀ_L e,   q/C = Aᵀ_C e,   V = Aᵀ_V e.

Loops of capacitors or sources and nodes with inductors alone are found by the constraint algorithm.
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from dirax.gallery.example import Coordinate, Example
from dirax.schemes.discrete_dirac import DiscreteDirac
from dirax.systems.implicit_system import ImplicitSystem

KINDS = ("C", "L", "R", "V")
GROUND = 0
Element = tuple[str, int, int, float]
"""(kind "C", "L", "R" or "V", from node, to node, value); node 0 is the ground."""


def circuit(netlist: Sequence[Element]) -> ImplicitSystem:
    """The implicit system of a netlist.

    Raises `ValueError` for unknown kinds, values that are not positive, and parts that are not connected to the ground.
    """
    for kind, start, end, value in netlist:
        if kind not in KINDS or start == end or (kind != "V" and not value > 0):
            given = (kind, start, end, value)
            raise ValueError(f"an element is (C, L, R or V, node, other node, value > 0), but {given} was given.")
    nodes = sorted({node for _, *ends, _ in netlist for node in ends} - {GROUND})
    _refuse_islands(netlist, nodes)
    row = {node: i for i, node in enumerate(nodes)}

    def incidence(kind: str) -> np.ndarray:
        chosen = [e for e in netlist if e[0] == kind]
        matrix = np.zeros((len(nodes), len(chosen)))
        for column, (_, start, end, _) in enumerate(chosen):
            for node, sign in ((start, 1.0), (end, -1.0)):
                if node != GROUND:
                    matrix[row[node], column] = sign
        return matrix

    values = {kind: np.array([e[3] for e in netlist if e[0] == kind]) for kind in KINDS}
    c, l, r, v = (incidence(kind) for kind in KINDS)
    nc, nl, nv, n = c.shape[1], l.shape[1], v.shape[1], len(nodes)
    E = np.zeros((n + nl + nc + nv, nc + nl))
    E[:n, :nc], E[n : n + nl, nc:] = c, np.eye(nl)
    B = np.zeros((n + nl + nc + nv, n + nv))
    B[:n, :n], B[:n, n:] = -r @ np.diag(1 / values["R"]) @ r.T, -v
    B[n : n + nl, :n], B[n + nl : n + nl + nc, :n], B[n + nl + nc :, :n] = l.T, c.T, v.T

    def f(x):
        current, voltage = x[nc:] / values["L"], x[:nc] / values["C"]
        return jnp.concatenate([-jnp.asarray(l) @ current, jnp.zeros(nl), -voltage, -jnp.asarray(values["V"])])

    energy = lambda x: jnp.sum(x[:nc] ** 2 / values["C"]) / 2 + jnp.sum(x[nc:] ** 2 / values["L"]) / 2
    return ImplicitSystem(lambda x: jnp.asarray(E), f, lambda x: jnp.asarray(B), energy)


def _refuse_islands(netlist: Sequence[Element], nodes: list[int]) -> None:
    reached, grown = {GROUND}, True
    while grown:
        grown = False
        for _, start, end, _ in netlist:
            if (start in reached) != (end in reached):
                reached |= {start, end}
                grown = True
    if set(nodes) - reached:
        raise ValueError(f"the nodes {sorted(set(nodes) - reached)} are not connected to the ground, node {GROUND}.")


def ladder(sections: int = 4, inductance: float = 1.0, capacitance: float = 1.0) -> list[Element]:
    """Sections of an inductor along and a capacitor to the ground; its first inductor is tied to the ground."""
    along: list[Element] = [("L", k, k + 1, inductance) for k in range(sections)]
    return along + [("C", k + 1, GROUND, capacitance) for k in range(sections)]


def frequencies(sections: int = 4, inductance: float = 1.0, capacitance: float = 1.0) -> np.ndarray:
    """The ladder's angular frequencies, 2/√(LC) sin((2k − 1)π/(4n + 2)), k = 1, …, n."""
    k = np.arange(1, sections + 1)
    return 2 / np.sqrt(inductance * capacitance) * np.sin((2 * k - 1) * np.pi / (4 * sections + 2))


EXAMPLE = Example(
    name="lc-ladder",
    title="LC ladder",
    source="closed port-Hamiltonian system of [BLM] §7, from a netlist",
    system=circuit(ladder()),
    initial={"x": np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])},
    scheme=DiscreteDirac(),
    step=0.05,
    steps=1000,
    coordinates=tuple(Coordinate(f"{letter}{i}") for letter in ("charge ", "flux ") for i in range(1, 5)),
)
