"""The Jacobian of a result in pieces by one argument: its entries, in pieces too."""

import numpy as np

from dirax.program.graph_derivatives import jacobian
from dirax.program.sites.courses import Course, NotBySites
from dirax.program.sites.pieces import Piece
from dirax.program.sites.walk import Sites

MOST_ENTRIES = 512
"""Different expressions among the entries: more take LLVM longer than XLA."""


def entries_of_jacobian(sites: Sites, argument: int = 0) -> tuple[list[Piece], np.ndarray, np.ndarray]:
    """The entries that can differ from zero as one array in pieces, and their rows and columns. Raises `NotBySites`."""
    e, (result,), found, rows, columns, first = sites.expressions, sites.results, [], [], [], 0
    g = e.graph
    for piece in result:
        inputs = [n for n in g.reachable([piece.node]) if n in e.places]
        if any(e.places[n].argument < 0 for n in inputs):
            raise NotBySites("an equation depends on a sum of many terms")
        unknowns = [n for n in inputs if e.places[n].argument == argument]
        (row,) = jacobian(g, [piece.node], unknowns)
        if len(found) + len(row) > MOST_ENTRIES:
            raise NotBySites(f"the Jacobian has more than {MOST_ENTRIES} different expressions")
        for j, node in row.items():
            found.append(Piece(Course(first, 1), piece.length, node))
            rows.append(piece.entries)
            columns.append(e.places[unknowns[j]].course.numbers(piece.length))
            first += piece.length
    i, j = (np.concatenate([np.zeros(0, np.int64), *places]) for places in (rows, columns))
    if len(np.unique(i * (1 + j.max(initial=0)) + j)) < len(i):
        raise NotBySites("an equation has one unknown as two inputs")
    return found, i, j
