"""Which unknowns of a step can be found before others: the block triangular form of its Jacobian (Duff, Reid 1978).

A saved velocity, the second half of a step that begins with a point of its own: such unknowns stand in no equation of the
others, so that Newton's method takes one after the other, each with a matrix of its own.
"""

import numpy as np
from jaxtyping import Bool

from dirax.numerics.arrays import AnyArray

FEWEST = 6
"""Unknowns of a block: smaller ones are found together with those before them, since each takes a test of when to stop."""


def blocks(there: Bool[AnyArray, "k k"]) -> list[tuple[list[int], list[int]]]:
    """(rows, columns) of each block in the order in which they can be solved; `there` says where a matrix is not zero.

    One block for a matrix that is singular wherever its entries are."""
    k = len(there)
    column = _matched(there)
    if column is None:
        return [(list(range(k)), list(range(k)))]
    needs = there[:, column] | np.eye(k, dtype=bool)  # whether row i has the unknown of row j
    for _ in range(k.bit_length()):
        needs = needs.astype(np.float32) @ needs.astype(np.float32) > 0
    count, first = needs.sum(axis=1), (needs & needs.T).argmax(axis=1)
    groups: list[list[int]] = []
    for leader in sorted(set(first.tolist()), key=lambda i: (count[i], i)):
        members = np.flatnonzero(first == leader).tolist()
        if groups and len(groups[-1]) < FEWEST:
            groups[-1] += members
        else:
            groups.append(members)
    if len(groups) > 1 and len(groups[-1]) < FEWEST:
        last = groups.pop()
        groups[-1] += last
    return [(sorted(rows), sorted(column[i] for i in rows)) for rows in groups]


def _matched(there: Bool[AnyArray, "k k"]) -> list[int] | None:
    """A column for each row, every one once, where the matrix is not zero; None if there is no such choice."""
    columns = [np.flatnonzero(row).tolist() for row in there]
    owner: dict[int, int] = {}
    for row in range(len(there)):
        came_from, waiting = {}, [row]
        free = None
        while waiting and free is None:
            i = waiting.pop()
            for j in columns[i]:
                if j not in came_from:
                    came_from[j] = i
                    if j not in owner:
                        free = j
                        break
                    waiting.append(owner[j])
        if free is None:
            return None
        while free is not None:  # the columns along the way change hands
            i = came_from[free]
            before = next((j for j, r in owner.items() if r == i), None)
            owner[free] = i
            free = before
    taken = {i: j for j, i in owner.items()}
    return [taken[i] for i in range(len(there))]
