"""Values of nodes in NumPy, for many entries side by side, and their derivatives in numbers."""

import functools
from collections.abc import Callable, Sequence

import numpy as np

from dirax.program.evaluation.row_tape import RowTape
from dirax.program.evaluation.tape import FEWEST_NODES, Tape
from dirax.program.evaluation.tape_code import compiles
from dirax.program.graph import Graph, Order
from dirax.program.graph_derivatives import slopes
from dirax.program.interpreter import Nodes

LANES = 1024
"""Entries of a batch that are computed at a time, which bounds the memory that the nodes' values take."""

MORE_LANES, MOST_VALUES = 4 * LANES, 2**24
"""Entries at a time of a graph with few nodes, where what an operation takes is Python's, and the values there may be then."""


PARTIALS = 4
"""Nodes, at most, for the derivatives of one operation by its operands, and the operation."""


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

    def read(self, nodes: Nodes, order: Order | None = None) -> np.ndarray:
        """The values of nodes (…), an array (entries, …); `order` as in `Graph.evaluate`."""
        table = np.empty((nodes.size, self.entries))
        with np.errstate(all="ignore"):
            for row, value in enumerate(self.graph.evaluate(nodes.ravel().tolist(), {}, self.table, self._known, order)):
                table[row] = value
        return table.T.reshape(self.entries, *nodes.shape)

    def given(self, tape: Tape) -> np.ndarray:
        """The values (entries, inputs) of the inputs of a tape."""
        values = np.concatenate([self._known[node] for node in tape.inputs]) if tape.inputs else np.empty(0)
        return values.reshape(len(tape.inputs), self.entries).T

    def slopes(self, nodes: list[int], inputs: list[int], plan: "Slopes | None" = None) -> np.ndarray:
        """The derivatives of nodes by inputs, (entries, nodes, inputs): over the graph, which only gains the derivatives of
        single operations, backward from fewer nodes than inputs, else forward, and so past branches: of one that is not taken
        infinite derivatives count for nothing then; `plan` where it has been made before. The nodes' own values are known
        after it."""
        plan, values = plan or Slopes(self.graph, nodes, inputs), self._known
        if self.table is None and plan.tape is not None:
            found, slopes = plan.tape(self.given(plan.tape.numbers))
            values.update(zip([*nodes, *plan.more], found.T, strict=True))
            return slopes
        with np.errstate(all="ignore"):
            self.graph.evaluate(plan.needed, {}, values=values, order=plan.order)
            if plan.backward:
                return self._backward(nodes, inputs, plan).transpose(2, 1, 0)
            return self._forward(nodes, inputs, plan).transpose(2, 0, 1)

    def _forward(self, nodes: list[int], inputs: list[int], plan: "Slopes") -> np.ndarray:
        """(nodes, inputs, entries)."""
        values, none = self._known, np.zeros((len(inputs), self.entries))
        rows = dict(zip(inputs, np.eye(len(inputs))[:, :, None] * np.ones(self.entries), strict=True))
        for node, terms in plan.terms:
            if terms is None:
                condition, yes, no = self.graph.args[node]
                rows[node] = np.where(values[condition], rows.get(yes, none), rows.get(no, none))
                continue
            first, *others = terms
            total = values[first[1]] * rows[first[0]]
            for operand, factor in others:
                total += values[factor] * rows[operand]
            rows[node] = total
        return np.stack([rows.get(node, none) for node in nodes])

    def _backward(self, nodes: list[int], inputs: list[int], plan: "Slopes") -> np.ndarray:
        """(inputs, nodes, entries)."""
        values, none, flow = self._known, np.zeros((len(nodes), self.entries)), {}

        def flows(into: int, more: np.ndarray) -> None:
            flow[into] = flow[into] + more if into in flow else more

        for one, node in zip(np.eye(len(nodes)), nodes, strict=True):
            flows(node, one[:, None] * np.ones(self.entries))
        kept = set(inputs)
        for node, terms in reversed(plan.terms):
            if (here := flow.get(node) if node in kept else flow.pop(node, None)) is None:
                continue
            for operand, factor in terms or ():
                flows(operand, values[factor] * here)
        return np.stack([flow.get(node, none) for node in inputs])


class Slopes:
    """What it takes to find the derivatives of nodes by inputs in numbers, found once."""

    def __init__(self, graph: Graph, nodes: list[int], inputs: list[int], more: Sequence[int] = ()):
        """`more`: nodes whose values will be asked for as well."""
        moving = set(inputs)
        self.terms: list[tuple[int, list[tuple[int, int]] | None]] = []
        """Nodes that depend on the inputs, with (operand that does, node of the derivative by it); None for a selection."""
        with graph.with_limit(PARTIALS * graph.limit):  # what a large step has left is not for these
            for node in graph.reachable(nodes):
                args = graph.args[node]
                if node in moving or not any([a in moving for a in args]):
                    continue
                if graph.op[node] == "select":
                    moving.add(node)
                    self.terms.append((node, None))
                elif terms := [(a, f) for a, f in slopes(graph, node) if a in moving]:
                    moving.add(node)
                    self.terms.append((node, terms))
        self.nodes, self.inputs, self.more, self.graph = nodes, inputs, list(more), graph
        self.backward = len(nodes) < len(inputs) and all(terms is not None for _, terms in self.terms)
        self.needed = [*nodes, *(factor for _, terms in self.terms for _, factor in terms or ())]
        self.order = Order(graph.reachable(self.needed))

    @property
    def size(self) -> int:
        """Products for each of the inputs, or of the nodes."""
        return sum(len(terms or (0, 0)) for _, terms in self.terms)

    @property
    def factors(self) -> list[int]:
        """The nodes that the derivatives are made of, with the conditions of selections."""
        conditions = [self.graph.args[node][0] for node, terms in self.terms if terms is None]
        return [*self.needed[len(self.nodes) :], *conditions]

    @functools.cached_property
    def tape(self) -> RowTape | None:
        """The derivatives by a compiled loop; None for few nodes, and where nothing compiles it."""
        if len(self.order.nodes) < FEWEST_NODES or not compiles():
            return None
        return RowTape(self.graph, self.nodes, self.inputs, self.more, self.terms, self.needed, self.backward)


def lanes_of(graph: Graph) -> int:
    """How many entries of a graph are computed at a time."""
    return min(MORE_LANES, max(LANES, MOST_VALUES // max(1, len(graph))))


def in_parts(function: Callable, leaves: list[np.ndarray], most: int = LANES) -> list[np.ndarray]:
    """`function` on so many entries of the leaves at a time at most."""
    parts = [function([leaf[low : low + most] for leaf in leaves]) for low in range(0, len(leaves[0]), most)]
    return parts[0] if len(parts) == 1 else [np.concatenate(pieces) for pieces in zip(*parts, strict=True)]
