"""Tape: nodes of a graph evaluated by one small compiled loop that goes through a table of their operations.

Nothing is compiled for a graph, and an operation on eight entries takes some seven nanoseconds, a hundredth of what NumPy takes
to call it: this is for large graphs at few entries. The loop has the operations that IEEE 754 rounds in one way only, and all
others are NumPy's: the bits are those of `in_numpy`.
"""

import itertools
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from dirax.program.evaluation.tape_code import CODE, LANES, NUMBER, compiles, loops
from dirax.program.graph import Graph
from dirax.program.operations import NUMPY

MOST_VALUES = 2**20
"""Values that are held at a time; entries are taken in parts."""

FEWEST_NODES = 400
"""Nodes from which on a tape is quicker than Python's floats, and than NumPy at a few entries."""


class Tape:
    """(values of the inputs) ↦ values of the outputs, for many entries; with the opaque computations `between` of a program."""

    def __init__(
        self,
        graph: Graph,
        inputs: Sequence[int],
        outputs: Sequence[int],
        between: Sequence[Any] = (),
        also: Sequence[int] = (),
    ):
        """`also`: nodes that are computed too."""
        self.graph, self.inputs, self.size = graph, list(inputs), 0
        self.slot = np.zeros(len(graph), np.int32)
        self._known: set[int] = set()
        self._acts: list[Callable[[np.ndarray, int], None]] = []
        self._constants: list[tuple[int, np.ndarray]] = []
        self._place(list(dict.fromkeys(inputs)))
        self.places = self.slot[list(inputs)] if len(inputs) else np.zeros(0, np.int32)
        for step in between:
            self._need([n for operand in step.operands for n in operand.ravel().tolist()])
            self._insert(step)
        self._need([*outputs, *also])
        self.outputs = self.slot[list(outputs)] if len(outputs) else np.zeros(0, np.int32)
        self._spare: list[np.ndarray] = []

    @classmethod
    def of_leaves(cls, graph: Graph, outputs: Sequence[int], also: Sequence[int] = ()) -> "Tape":
        """The tape of nodes whose inputs are all that they depend on."""
        return cls(graph, [node for node in graph.reachable([*outputs, *also]) if graph.op[node] == "input"], outputs, (), also)

    def __call__(self, given: np.ndarray) -> np.ndarray:
        """(entries, inputs) ↦ (entries, outputs)."""
        found = np.empty((len(given), len(self.outputs)))
        for some, table in self.tables(given):
            found[some] = read(table, self.outputs, some.stop - some.start)
        return found

    def tables(self, given: np.ndarray) -> Iterator[tuple[slice, np.ndarray]]:
        """The values (blocks, slots, LANES) of all nodes for some of the entries, and which; the memory is used again."""
        entries, most = len(given), LANES * max(1, MOST_VALUES // (LANES * max(1, self.size)))
        blocks = -(-min(entries, most) // LANES)
        try:
            whole = self._spare.pop() if blocks == 1 else self._empty(blocks)
        except IndexError:
            whole = self._empty(1)
        for low in range(0, entries, most):
            some = slice(low, min(low + most, entries))
            count = some.stop - low
            table = whole[: -(-count // LANES)]
            write(table, self.places, given[some])
            with np.errstate(all="ignore"):
                for act in self._acts:
                    act(table, count)
            yield some, table
        if blocks == 1:
            self._spare.append(whole)

    def _empty(self, blocks: int) -> np.ndarray:
        table = np.empty((blocks, self.size, LANES))
        for first, values in self._constants:
            table[:, first : first + len(values)] = values[:, None]
        return table

    def _place(self, nodes: list[int]) -> int:
        """Give nodes the next slots; the first of them."""
        first = self.size
        self.slot[nodes] = np.arange(first, first + len(nodes), dtype=np.int32)
        self._known.update(nodes)
        self.size += len(nodes)
        return first

    def _need(self, outputs: Sequence[int]) -> None:
        """Have nodes computed: between calls of NumPy, all that can be."""
        graph, ops, args = self.graph, self.graph.op, self.graph.args
        depth, waves, compiled = [0] * len(ops), defaultdict(list), CODE if compiles() else {}
        for node in graph.reachable(outputs, self._known):
            operands = args[node]
            if not operands:
                waves[-1].append(node)
                continue
            below = depth[operands[0]]
            for a in operands[1:]:
                below = max(below, depth[a])
            by_numpy = ops[node] not in compiled
            waves[2 * below + by_numpy].append(node)
            depth[node] = below + by_numpy
        for place in sorted(waves):
            nodes = waves[place]
            if place < 0:
                values = np.array([float(graph.value[node]) for node in nodes])
                self._constants.append((self._place(nodes), values))
            elif place % 2:
                for op, some in itertools.groupby(sorted(nodes, key=ops.__getitem__), key=ops.__getitem__):
                    self._call(NUMPY[op], list(some))
            else:
                self._loop(nodes)

    def _loop(self, nodes: list[int]) -> None:
        """Have the compiled loop compute these, operands first."""
        first, slot = self._place(nodes), self.slot
        ops, args = self.graph.op, self.graph.args
        operands = [args[node] for node in nodes]
        table = np.empty((len(nodes), 4), np.int32)
        table[:, 0] = [NUMBER[ops[node]] for node in nodes]
        table[:, 1:] = slot[np.array([o if len(o) == 3 else (o[0], o[-1], o[0]) for o in operands])]
        run, at, count = loops()[0], table.ctypes.data, len(table)

        def act(values: np.ndarray, entries: int, keep: np.ndarray = table) -> None:
            run(at, count, values.ctypes.data, first, len(values), values.shape[1])

        self._acts.append(act)

    def _call(self, function: Callable, nodes: list[int]) -> None:
        """Have NumPy compute these, all of one operation."""
        first, operands = self._place(nodes), np.array([self.graph.args[node] for node in nodes]).T
        places, stop = [self.slot[of] for of in operands], self.size

        def act(values: np.ndarray, entries: int) -> None:
            if entries == 1:
                values[0, first:stop] = np.asarray(function(*[values[0, of, 0] for of in places]))[:, None]
            else:
                values[:, first:stop] = function(*[values[:, of] for of in places])

        self._acts.append(act)

    def _insert(self, step: Any) -> None:
        """Have an opaque computation follow."""
        operands = [(self.slot[operand.ravel()], operand.shape) for operand in step.operands]
        for result in step.results:
            self._place(result.ravel().tolist())
        results = [self.slot[result.ravel()] for result in step.results]

        def act(values: np.ndarray, entries: int) -> None:
            arrays = [read(values, places, entries).reshape(entries, *shape) for places, shape in operands]
            for places, array in zip(results, step.function(arrays), strict=True):
                write(values, places, np.asarray(array, float).reshape(entries, -1))

        self._acts.append(act)


def by_tape(
    graph: Graph, inputs: Sequence[int], outputs: Sequence[int], between: Sequence[Any] = ()
) -> Callable[[Sequence[float]], tuple[float, ...]]:
    """(values of the inputs) ↦ values of the outputs, for one entry, in order."""
    tape = Tape(graph, inputs, outputs, between)
    return lambda given: tuple(tape(np.array([given], float))[0].tolist())


def write(table: np.ndarray, places: np.ndarray, given: np.ndarray) -> None:
    """Put (entries, count) into places of a table (blocks, slots, LANES), which is filled up with copies of the last entry."""
    blocks, entries = len(table), len(given)
    if entries == 1:
        table[0, places] = given[0][:, None]
        return
    if more := blocks * LANES - entries:
        given = np.concatenate([given, np.broadcast_to(given[-1:], (more, given.shape[1]))])
    table[:, places] = given.reshape(blocks, LANES, len(places)).transpose(0, 2, 1)


def read(table: np.ndarray, places: np.ndarray, entries: int) -> np.ndarray:
    """What stands there, (entries, count)."""
    if entries == 1:
        return table[0, places, 0][None]
    return table[:, places].transpose(0, 2, 1).reshape(len(table) * LANES, len(places))[:entries]
