"""The Jacobian of a result in pieces by one argument: its entries, in pieces too."""

import numpy as np

from dirax.program.graph_derivatives import jacobian
from dirax.program.sites.courses import ALL, Course, NotBySites
from dirax.program.sites.pieces import LONGEST, Expressions, Piece, Place, combined, gathered, one_at_a_time
from dirax.program.sites.walk import Sites

MOST_ENTRIES = 512
"""Different expressions among the entries: more take LLVM longer than XLA."""

DERIVED = 10
"""How many times as many nodes as a function its Jacobian may have."""


def entries_of_jacobian(sites: Sites, argument: int = 0) -> tuple[list[Piece], np.ndarray, np.ndarray]:
    """The entries that can differ from zero as one array in pieces, and their rows and columns. Raises `NotBySites`."""
    (result,), found, rows, columns, first = sites.results, [], [], [], 0
    sites.expressions.graph.limit = DERIVED * LONGEST
    for piece in result:
        terms = _terms(sites, piece, argument)
        if len(found) + len(terms) > MOST_ENTRIES:
            raise NotBySites(f"the Jacobian has more than {MOST_ENTRIES} different expressions")
        for node, places in terms:
            found.append(Piece(Course(first, 1), len(places), node))
            rows.append(np.broadcast_to(piece.entries, places.shape))
            columns.append(places)
            first += len(places)
    i, j = (np.concatenate([np.zeros(0, np.int64), *places]) for places in (rows, columns))
    if len(np.unique(i * (1 + j.max(initial=0)) + j)) < len(i):
        raise NotBySites("an equation has one unknown as two inputs")
    return found, i, j


def _terms(sites: Sites, piece: Piece, argument: int) -> list[tuple[int, np.ndarray]]:
    """The entries of a piece's rows, and their columns: of each row one in each of them, or all of a single row."""
    e, slopes = sites.expressions, _slopes(sites.expressions, piece.node)
    if all(place.argument >= 0 for place, _ in slopes):
        return [(node, at.course.numbers(piece.length)) for at, node in slopes if at.argument == argument]
    if piece.length > 1:
        raise NotBySites("many equations depend on a sum of many terms")
    return [(p.node, p.entries) for p in _full_row(sites, slopes, argument) if p.node != e.graph.zero]


def _full_row(sites: Sites, slopes: list[tuple[Place, int]], argument: int) -> list[Piece]:
    """The row of an equation that depends on sums of many terms, an array in pieces, by its derivatives by its inputs."""
    e, terms = sites.expressions, []
    for (of, course), slope in slopes:
        if of == argument:
            terms.append(Piece(course, 1, slope))
        for piece in sites.totals[course.first] if of < 0 else ():
            inner = _slopes(e, piece.node)
            if any(at.argument < 0 for at, _ in inner):
                raise NotBySites("an equation depends on a sum of sums of many terms")
            own = [(at.course, e.graph.mul(slope, node)) for at, node in inner if at.argument == argument]
            terms += [Piece(course, piece.length, node) for course, node in own]
    size = 1 + max((int(term.entries.max()) for term in terms), default=0)
    total = [Piece(ALL, size, e.graph.zero)]
    for term in terms:
        for entries in one_at_a_time(term.entries, size):
            total = combined(e, "add", total, gathered(e, [term._replace(course=ALL)], term.length, entries, ()))
    return total


def _slopes(e: Expressions, node: int) -> list[tuple[Place, int]]:
    """The places of the inputs on which a node depends, and its derivatives by these."""
    inputs = [n for n in e.graph.reachable([node]) if n in e.places]
    (row,) = jacobian(e.graph, [node], inputs)
    return [(e.places[inputs[j]], slope) for j, slope in row.items()]
