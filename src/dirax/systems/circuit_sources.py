"""Constant sources of a circuit that contradict each other: voltages around a loop, currents into nodes with no other way."""

from collections.abc import Sequence
from typing import Any

ROUNDOFF = 1e-9
"""Relative to the sum of sizes: what is left of voltages or currents that agree."""


def refuse_contradictions(netlist: Sequence[tuple[str, Any, Any, Any]], ground: int) -> None:
    """Raise `ValueError` for sources that no currents and potentials satisfy, whatever the charges and fluxes are."""
    held = Groups()
    for kind, a, b, voltage in netlist:
        if kind == "V" and not callable(voltage):
            given = held.difference(a, b)
            if given is None:
                held.join(a, b, voltage)
            elif abs(given - voltage) > ROUNDOFF * (abs(given) + abs(voltage)):
                raise ValueError(
                    f"the source {('V', a, b, voltage)} contradicts the voltage sources before it, by which node {a} is at "
                    f"{given:.6g} of node {b}: no initial data help; take one out of the loop, or put a resistor into it."
                )
    _refuse_currents(netlist, ground)


def _refuse_currents(netlist: Sequence[tuple[str, Any, Any, Any]], ground: int) -> None:
    joined, nodes, inflow = Groups(), {}, {}
    for kind, a, b, _ in netlist:
        for start, end in (a, b) if kind == "T" else ((a, b),):
            if kind != "I":
                joined.join(start, end, 0.0)
            nodes |= {start: None, end: None}
    for kind, a, b, current in netlist:
        if kind == "I":
            for node, sign in ((a, -1.0), (b, 1.0)):
                flows = inflow.setdefault(joined.root(node), [])
                flows.append(None if callable(current) else sign * current)
    for root, flows in inflow.items():
        if root == joined.root(ground) or None in flows or abs(sum(flows)) <= ROUNDOFF * sum(map(abs, flows)):
            continue
        alone = sorted(node for node in nodes if joined.root(node) == root)
        raise ValueError(
            f"the current sources contradict each other: they alone lead to the nodes {alone} of the circuit, into which "
            f"{sum(flows):.6g} flows, and not 0: no initial data help; give the current another way, such as a resistor."
        )


class Groups:
    """Nodes that are joined, with the differences of their potentials: a union-find with weights."""

    def __init__(self):
        self._above: dict[Any, tuple[Any, float]] = {}

    def _find(self, node: Any) -> tuple[Any, float]:
        """The root of a node, and how far above it the node is."""
        path, height = [], 0.0
        while (step := self._above.get(node)) is not None:
            path.append((node, height))
            node, height = step[0], height + step[1]
        for below, passed in path:
            self._above[below] = node, height - passed
        return node, height

    def root(self, node: Any) -> Any:
        """The same node for all that are joined."""
        return self._find(node)[0]

    def difference(self, a: Any, b: Any) -> float | None:
        """The potential of a at b; None where they are not joined."""
        (first, up), (second, down) = self._find(a), self._find(b)
        return up - down if first == second else None

    def join(self, a: Any, b: Any, difference: float) -> None:
        """State the potential of a at b, where they are not joined already."""
        (first, up), (second, down) = self._find(a), self._find(b)
        if first != second:
            self._above[first] = second, difference + down - up
