"""Nodes that are read again and again: in an order that is found once, and from the third time on by a tape."""

from collections.abc import Set

import numpy as np

from dirax.program.evaluation.in_numpy import Values
from dirax.program.evaluation.tape import Tape
from dirax.program.graph import Graph, Order, with_ends
from dirax.program.interpreter import Nodes

TAPED, FEWEST_NODES = 3, 60
"""The reading for which a tape is made, of no fewer nodes: making it takes as long as two or three readings without."""


class ReadAgain:
    """Reads nodes of a graph that gains none; the bits are those of `Values.read`."""

    def __init__(self, graph: Graph):
        self.graph = graph
        self._orders: dict[tuple[bytes, int | None], Order] = {}
        self._tapes: dict[bytes, Tape] = {}
        self._times: dict[bytes, int] = {}

    def __call__(self, known: Values, nodes: Nodes, moving: Set[int] | None = None, index: int | None = None) -> np.ndarray:
        """The values (entries, …) of nodes (…) that depend on what is bound alone; of those that were needed all that are not
        `moving` may stay known, where these are given, always the same for an `index`."""
        key = nodes.tobytes()
        if known.table is None and (tape := self._tape(key, nodes)) is not None:
            return tape(known.given(tape)).reshape(known.entries, *nodes.shape)
        if (key, index) not in self._orders:
            read = nodes.ravel().tolist()
            order = self.graph.reachable(read)
            kept = () if moving is None else set(order) - moving
            (self._orders[key, index],) = with_ends(self.graph, [(order, read)], kept)
        return known.read(nodes, self._orders[key, index])

    def _tape(self, key: bytes, nodes: Nodes) -> Tape | None:
        times = self._times[key] = self._times.get(key, 0) + 1
        if times >= TAPED and key not in self._tapes:
            self._tapes[key] = Tape.of_leaves(self.graph, nodes.ravel().tolist())
        tape = self._tapes.get(key)
        return tape if tape is not None and tape.size >= FEWEST_NODES else None
