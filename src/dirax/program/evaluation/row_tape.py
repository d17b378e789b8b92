"""Derivatives of nodes in numbers by a compiled loop over a table of operations on rows, one row a node: the sweeps of
`in_numpy.Values.slopes`, with their bits."""

from collections.abc import Sequence

import numpy as np

from dirax.program.evaluation.tape import Tape, read
from dirax.program.evaluation.tape_code import LANES, NUMBER, loops
from dirax.program.graph import Graph

Terms = Sequence[tuple[int, list[tuple[int, int]] | None]]
"""Nodes that move, operands first, with (operand that does, node of the derivative by it); None for a selection."""


class RowTape:
    """(values of the leaves) ↦ values of nodes and of `more` of them, and the derivatives of the first by inputs; `backward` from
    the nodes, else forward."""

    def __init__(
        self, graph: Graph, nodes: list[int], inputs: list[int], more: list[int], terms: Terms, needed: list[int], backward: bool
    ):
        conditions = [graph.args[node][0] for node, of in terms if of is None]
        self.numbers, self.backward = Tape.of_leaves(graph, [*nodes, *more], [*needed, *conditions]), backward
        self._free: list[int] = []
        self._rows = 1  # the first one is zero
        self._lines: list[tuple[int, int, int, int, int]] = []
        seeds, wanted = (nodes, inputs) if backward else (inputs, nodes)
        at = {node: self._row() for node in dict.fromkeys(seeds)}
        self._seeds = np.zeros((self._rows, len(seeds), LANES))
        for column, node in enumerate(seeds):
            self._seeds[at[node], column] += 1.0
        (self._backward if backward else self._forward)(graph, terms, at, set(wanted))
        self._wanted = np.array([at.get(node, 0) for node in wanted], np.int32)
        self._table = np.array(self._lines, np.int32).reshape(-1, 5)
        self._lines = []

    def _row(self) -> int:
        if self._free:
            return self._free.pop()
        self._rows += 1
        return self._rows - 1

    def _forward(self, graph: Graph, terms: Terms, at: dict[int, int], kept: set[int]) -> None:
        slot, last = self.numbers.slot.tolist(), {}
        for place, (node, of) in enumerate(terms):
            for operand in graph.args[node][1:] if of is None else [operand for operand, _ in of]:
                last[operand] = place
        for place, (node, of) in enumerate(terms):
            row = self._row()
            if of is None:
                condition, *operands = graph.args[node]
                yes, no = (at.get(x, 0) for x in operands)
                self._lines.append((NUMBER["choice"], row, yes, no, slot[condition]))
            else:
                operands = [operand for operand, _ in of]
                for number, (operand, factor) in enumerate(of):
                    self._lines.append((NUMBER["more" if number else "product"], row, at[operand], 0, slot[factor]))
            at[node] = row
            for operand in set(operands):
                if last[operand] == place and operand not in kept and operand in at:
                    self._free.append(at.pop(operand))

    def _backward(self, graph: Graph, terms: Terms, at: dict[int, int], kept: set[int]) -> None:
        slot = self.numbers.slot.tolist()
        for node, of in reversed(terms):
            row = at.get(node)
            if row is None:
                continue
            for operand, factor in of or ():
                what = "more" if operand in at else "product"
                to = at[operand] if operand in at else at.setdefault(operand, self._row())
                self._lines.append((NUMBER[what], to, row, 0, slot[factor]))
            if node not in kept:
                self._free.append(at.pop(node))

    def __call__(self, given: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(entries, leaves) ↦ (entries, nodes and more), (entries, nodes, inputs)."""
        columns, entries = self._seeds.shape[1], len(given)
        rows = np.empty((self._rows, columns, LANES))
        values, slopes = np.empty((entries, len(self.numbers.outputs))), np.empty((entries, len(self._wanted), columns))
        run, at, count = loops()[1], self._table.ctypes.data, len(self._table)
        for some, table in self.numbers.tables(given):
            values[some] = read(table, self.numbers.outputs, some.stop - some.start)
            for block, first in zip(table, range(some.start, some.stop, LANES), strict=True):
                rows[: len(self._seeds)] = self._seeds
                run(at, count, block.ctypes.data, rows.ctypes.data, columns)
                into = slopes[first : min(first + LANES, some.stop)]
                into[:] = np.moveaxis(rows[self._wanted], 2, 0)[: len(into)]
        return values, slopes.swapaxes(1, 2) if self.backward else slopes
