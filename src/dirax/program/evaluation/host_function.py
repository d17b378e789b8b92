"""Jaxprs of a few numbers as graphs that NumPy evaluates, with computations between nodes that are no nodes themselves."""

import functools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dirax.program.derivatives import partials
from dirax.program.graph import NODE_LIMIT, Graph
from dirax.program.interpreter import Interpreter, Nodes, Unavailable

LANES = 1024
"""Entries of a batch that are computed at a time, which bounds the memory that the nodes' values take."""

HOST_RULES: dict[str, Callable] = {}
"""Primitive name → rule(made, interpreter, equation, *operands), which may add computations to the HostFunction `made`."""


def host_rule(name: str) -> Callable[[Callable], Callable]:
    """Register a rule that is used here before that of the scalar graph."""
    return lambda function: HOST_RULES.setdefault(name, function)


class Values:
    """What nodes of a graph are at some entries; operands are computed where something needs them."""

    def __init__(self, graph: Graph, entries: int):
        self.graph, self.entries, self._known = graph, entries, {}

    def bind(self, nodes: Nodes, array: np.ndarray) -> None:
        """Nodes (…) are the entries of `array` (entries, …)."""
        columns = np.asarray(array, dtype=np.float64).reshape(self.entries, -1).T
        self._known.update(zip(nodes.ravel().tolist(), columns, strict=True))

    def read(self, nodes: Nodes) -> np.ndarray:
        """The values of nodes (…), an array (entries, …)."""
        table = np.empty((nodes.size, self.entries))
        with np.errstate(all="ignore"):
            for row, value in enumerate(self.graph.evaluate(nodes.ravel().tolist(), {}, values=self._known)):
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


@dataclass
class Opaque:
    """A computation between nodes that is no node: arrays (entries, …) of the operands to those of the results."""

    operands: list[Nodes]
    results: list[Nodes]
    function: Callable[[list[np.ndarray]], list[np.ndarray]]


@dataclass
class HostFunction:
    """A jaxpr as a graph: arrays of input nodes, the nodes of its results, and what is computed between nodes."""

    inputs: list[Nodes]
    results: list[Nodes] = field(default_factory=list)
    opaque: list[Opaque] = field(default_factory=list)
    graph: Graph = field(default_factory=lambda: Graph(NODE_LIMIT))

    def __call__(self, leaves: list[np.ndarray]) -> list[np.ndarray]:
        """The results for arguments (entries, …), with that leading axis."""
        return in_parts(self._part, leaves)

    def _part(self, leaves: list[np.ndarray]) -> list[np.ndarray]:
        known = Values(self.graph, len(leaves[0]))
        for nodes, leaf in zip(self.inputs, leaves, strict=True):
            known.bind(nodes, leaf)
        for step in self.opaque:
            for nodes, array in zip(step.results, step.function([known.read(o) for o in step.operands]), strict=True):
                known.bind(nodes, array)
        return [known.read(nodes) for nodes in self.results]

    def fresh(self, shape: tuple[int, ...]) -> Nodes:
        """New input nodes."""
        first = len(self.graph)
        return np.array([self.graph.input(f"x{first + i}") for i in range(int(np.prod(shape)))], np.int64).reshape(shape)

    def between(self, operands: list[Nodes], shapes: list[tuple[int, ...]], function: Callable) -> list[Nodes]:
        """The nodes of the results of an opaque computation."""
        self.opaque.append(Opaque(operands, [self.fresh(shape) for shape in shapes], function))
        return self.opaque[-1].results


def interpreted(jaxpr: Any, host_rules: dict[str, Callable] = HOST_RULES) -> HostFunction:
    """A closed jaxpr as a HostFunction, a graph alone without `host_rules`. Raises `UnsupportedPrimitive` and `GraphTooLarge`."""
    made = HostFunction([])
    made.inputs = [made.fresh(v.aval.shape) for v in jaxpr.jaxpr.invars]
    rules = {name: functools.partial(rule, made) for name, rule in host_rules.items()}
    made.results = Interpreter(made.graph, rules).run(jaxpr, *made.inputs)
    for result in made.results:
        if isinstance(result, Unavailable):
            raise result.error
    return made
