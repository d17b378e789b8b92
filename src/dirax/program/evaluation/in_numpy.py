"""Values of nodes in NumPy, for many entries side by side, and their derivatives in numbers."""

from collections.abc import Callable

import numpy as np

from dirax.program.graph import Graph
from dirax.program.graph_derivatives import partials
from dirax.program.interpreter import Nodes

LANES = 1024
"""Entries of a batch that are computed at a time, which bounds the memory that the nodes' values take."""


class Values:
    """What nodes of a graph are at some entries; operands are computed where something needs them."""

    def __init__(self, graph: Graph, entries: int, table: dict[str, Callable] | None = None):
        """`table`: other functions for the operations than NumPy's."""
        self.graph, self.entries, self.table, self._known = graph, entries, table, {}

    def bind(self, nodes: Nodes, array: np.ndarray) -> None:
        """Nodes (…) are the entries of `array` (entries, …)."""
        columns = np.asarray(array, dtype=np.float64).reshape(self.entries, -1).T
        self._known.update(zip(nodes.ravel().tolist(), columns, strict=True))

    def without(self, nodes: set[int]) -> "Values":
        """What is known of all other nodes."""
        other = Values(self.graph, self.entries, self.table)
        other._known = {node: value for node, value in self._known.items() if node not in nodes}
        return other

    def at(self, entries: np.ndarray) -> "Values":
        """What is known at some of the entries."""
        other = Values(self.graph, len(entries), self.table)
        other._known = {n: v[entries] if isinstance(v, np.ndarray) and v.ndim else v for n, v in self._known.items()}
        return other

    def read(self, nodes: Nodes, order: list[int] | None = None) -> np.ndarray:
        """The values of nodes (…), an array (entries, …); `order` as in `Graph.evaluate`."""
        table = np.empty((nodes.size, self.entries))
        with np.errstate(all="ignore"):
            for row, value in enumerate(self.graph.evaluate(nodes.ravel().tolist(), {}, self.table, self._known, order)):
                table[row] = value
        return table.T.reshape(self.entries, *nodes.shape)

    def slopes(self, nodes: list[int], inputs: list[int]) -> np.ndarray:
        """The derivatives of nodes by inputs, (entries, nodes, inputs): forward over the graph, which only gains the
        derivatives of single operations."""
        g, values = self.graph, self._known
        moving, factors = set(inputs), {}
        for node in g.reachable(nodes):
            args = g.args[node]
            if node not in moving and any([a in moving for a in args]):
                moving.add(node)
                factors[node] = [] if g.op[node] == "select" else partials(g, node)
        with np.errstate(all="ignore"):
            g.evaluate([*nodes, *(f for slopes in factors.values() for f in slopes if f is not None)], {}, values=values)
            none = np.zeros((len(inputs), self.entries))
            rows = dict(zip(inputs, np.eye(len(inputs))[:, :, None] * np.ones(self.entries), strict=True))
            for node, slopes in factors.items():
                args = g.args[node]
                if g.op[node] == "select":
                    rows[node] = np.where(values[args[0]], rows.get(args[1], none), rows.get(args[2], none))
                    continue
                terms = [values[f] * rows[a] for a, f in zip(args, slopes, strict=True) if f is not None and a in rows]
                rows[node] = sum(terms[1:], terms[0]) if terms else none
        return np.stack([rows.get(node, none) for node in nodes]).transpose(2, 0, 1)


def in_parts(function: Callable, leaves: list[np.ndarray]) -> list[np.ndarray]:
    """`function` on LANES entries of the leaves at a time."""
    parts = [function([leaf[low : low + LANES] for leaf in leaves]) for low in range(0, len(leaves[0]), LANES)]
    return parts[0] if len(parts) == 1 else [np.concatenate(pieces) for pieces in zip(*parts, strict=True)]
