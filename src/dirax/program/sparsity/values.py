"""What is known of the entries of an array: their index sets, rows of one sparse matrix of booleans."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
import scipy.sparse as sp

MOST_PER_UNKNOWN = 256
"""Entries of the sets of one array, for each of its entries and of the unknowns, from which on a function counts as dense."""


class Dense(Exception):
    """Raised where index sets become too large to be of use; says what made them so."""


class Value(NamedTuple):
    """What is known of an array: the index sets of its entries (entries, unknowns), None for empty ones; its numbers, where they
    are known; which entries are zero whatever the unknowns, None for no entries."""

    sets: Any = None
    known: Any = None
    zero: Any = None

    def zeros(self, shape: tuple[int, ...]) -> np.ndarray:
        """Which entries are known to be zero."""
        if self.known is not None:
            return np.broadcast_to(self.known == 0, shape)
        return np.zeros(shape, bool) if self.zero is None else self.zero


def rows(sets: Any, numbers: np.ndarray) -> Any:
    """The sets of entries with these numbers, counted from 1; 0 for the empty set."""
    flat = numbers.ravel()
    if len(flat) == sets.shape[0] and np.array_equal(flat, np.arange(1, len(flat) + 1)):
        return sets
    pointers = np.append(sets.indptr, sets.indptr[-1])
    extended = sp.csr_matrix((sets.data, sets.indices, pointers), (sets.shape[0] + 1, sets.shape[1]))
    return extended[np.where(flat > 0, flat - 1, sets.shape[0])]


def spread(sets: Any, shape: tuple[int, ...], whole: tuple[int, ...]) -> Any:
    """The sets of an operand that is repeated along axes of length 1, or is a number."""
    if shape == whole:
        return sets
    return rows(sets, np.broadcast_to(np.arange(1, math.prod(shape) + 1).reshape(shape), whole))


def folded(sets: Any, shape: tuple[int, ...], axes: Sequence[int]) -> Any:
    kept = [n for axis, n in enumerate(shape) if axis not in axes]
    inner = tuple(1 if axis in axes else n for axis, n in enumerate(shape))
    groups = np.broadcast_to(np.arange(math.prod(kept)).reshape(inner), shape).ravel()
    total = sp.csr_matrix((np.ones(len(groups), bool), (groups, np.arange(len(groups)))), (math.prod(kept), len(groups)))
    return total @ sets


def union(a: Any, b: Any) -> Any:
    if a is None or a is b:
        return b
    return a if b.nnz == 0 else b if a.nnz == 0 else sp.csr_matrix(a + b)


def too_many(entries: int, sets: Any, results: int, message: str) -> None:
    """Raises `Dense` with the message for so many entries of the sets of so many results."""
    if entries > MOST_PER_UNKNOWN * (sets.shape[1] + results):
        raise Dense(message)


def of_all(sets: Any, sizes: Sequence[int], message: str, batch: int = 1) -> list[Value]:
    """Results of these sizes, for each of a batch of sets, whose every entry depends on all of its set. Raises `Dense`."""
    too_many(sets.nnz * sum(sizes), sets, batch * sum(sizes), message)
    return [Value(rows(sets, np.repeat(np.arange(1, batch + 1), size))) for size in sizes]


def evaluated(equation: Any, operands: list[Any]) -> list[np.ndarray]:
    """The results of an equation for known operands, also while JAX traces."""
    with jax.ensure_compile_time_eval():
        found = equation.primitive.bind(*map(jax.numpy.asarray, operands), **equation.params)
    return [np.asarray(a) for a in (found if equation.primitive.multiple_results else [found])]
