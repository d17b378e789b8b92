"""What moves entries about: the sets of an array are taken in another order."""

import math
from typing import Any

import numpy as np
import scipy.sparse as sp

from dirax.program.interpreter import RULES
from dirax.program.sparsity.indexing import places_of_updates, read
from dirax.program.sparsity.values import Dense, Value, rows, union

MOVES = frozenset(
    (
        *("reshape", "squeeze", "expand_dims", "broadcast_in_dim", "transpose", "rev", "concatenate", "stack", "unstack"),
        *("tile", "split", "slice"),
    )
)
"""Primitives whose rules run on arrays of numbers of any kind."""


def moved(equation: Any, *operands: Value) -> list[Value]:
    """Numbers of entries are moved, counted from 1; 0 is that of an entry which depends on nothing."""
    rule: Any = pad if equation.primitive.name == "pad" else RULES[equation.primitive.name]
    if all(o.known is not None for o in operands):
        return [Value(known=np.asarray(a)) for a in rule(None, equation, *(o.known for o in operands))]
    shapes = [v.aval.shape for v in equation.invars]
    results, count = [Value()] * len(equation.outvars), len(equation.outvars)
    zeros: list[Any] = [None] * count
    if any(o.known is not None or o.zero is not None for o in operands):
        zeros = rule(None, equation, *(o.zeros(shape) for o, shape in zip(operands, shapes, strict=True)))
    if any(o.sets is not None for o in operands):
        numbers, parts, first = [], [], 1
        for shape, operand in zip(shapes, operands, strict=True):
            if operand.sets is None:
                numbers.append(np.zeros(shape, np.int64))
                continue
            numbers.append(np.arange(first, first + operand.sets.shape[0]).reshape(shape))
            parts.append(operand.sets)
            first += operand.sets.shape[0]
        sets = parts[0] if len(parts) == 1 else sp.vstack(parts, "csr")
        results = [Value(rows(sets, moved)) for moved in rule(None, equation, *numbers)]
    return [Value(r.sets, None, zero) for r, zero in zip(results, zeros, strict=True)]


def gathered(equation: Any, value: Value, *indices: Value) -> list[Value]:
    if value.sets is None and value.known is None and value.zero is None:
        return [Value()]
    if any(i.known is None for i in indices):
        if value.sets is None:
            return [Value()]
        raise Dense(f"'{equation.primitive.name}' has indices that depend on values")
    shape = equation.invars[0].aval.shape
    numbers = np.arange(1, math.prod(shape) + 1).reshape(shape)
    places = read(equation, [numbers], [i.known for i in indices])
    zero = np.append(False, value.zeros(shape))[places] if value.known is not None or value.zero is not None else None
    return [Value(None if value.sets is None else rows(value.sets, places), None, zero)]


def scattered(equation: Any, value: Value, indices: Value, updates: Value) -> list[Value]:
    if indices.known is None:
        if value.sets is None and updates.sets is None:
            return [Value()]
        raise Dense(f"'{equation.primitive.name}' has indices that depend on values")
    shape, given = equation.invars[0].aval.shape, equation.invars[2].aval.shape
    total, name = math.prod(shape), equation.primitive.name
    places = places_of_updates(equation, indices.known, shape, given)
    inside = np.flatnonzero(places > 0)
    targets = places[inside] - 1
    kept, zero = value.sets, value.zeros(shape).ravel().copy()
    fresh = updates.zeros(given).ravel()[inside]
    if name == "scatter":  # what is written over is gone
        over = np.zeros(total, bool)
        over[targets] = True
        kept = None if kept is None else rows(kept, np.where(over, 0, np.arange(1, total + 1)))
        zero |= over
    elif name not in ("scatter-add", "scatter-sub"):
        zero[:] = False
    zero[targets[~fresh]] = False
    if updates.sets is not None:
        there = sp.csr_matrix((np.ones(len(inside), bool), (targets, inside)), (total, len(places)))
        kept = union(kept, there @ updates.sets)
    return [Value(kept, None, zero.reshape(shape))]


def updated(equation: Any, value: Value, updates: Value, *starts: Value) -> list[Value]:
    if any(s.known is None for s in starts):
        if value.sets is None and updates.sets is None:
            return [Value()]
        raise Dense("'dynamic_update_slice' has indices that depend on values")
    shapes = [v.aval.shape for v in equation.invars[:2]]
    size, count = map(math.prod, shapes)
    numbers = np.arange(1, size + 1).reshape(shapes[0]), np.arange(size + 1, size + count + 1).reshape(shapes[1])
    places = read(equation, numbers, [s.known for s in starts])
    zero = np.concatenate([v.zeros(shape).ravel() for v, shape in zip((value, updates), shapes, strict=True)])[places - 1]
    if value.sets is None and updates.sets is None:
        return [Value(zero=zero)]
    unknowns = next(v.sets.shape[1] for v in (value, updates) if v.sets is not None)
    empty = lambda rows: sp.csr_matrix((rows, unknowns), dtype=bool)
    both = [empty(n) if v.sets is None else v.sets for v, n in ((value, size), (updates, count))]
    return [Value(rows(sp.vstack(both, "csr"), places), None, zero)]


def pad(_: Any, equation: Any, x: np.ndarray, filler: np.ndarray) -> list[np.ndarray]:
    out = np.full(equation.outvars[0].aval.shape, filler.item(), x.dtype)
    source, target = [], []
    for n, size, (low, _, inside) in zip(x.shape, out.shape, equation.params["padding_config"], strict=True):
        places = low + np.arange(n) * (inside + 1)
        inner = np.flatnonzero((places >= 0) & (places < size))
        source.append(inner)
        target.append(places[inner])
    out[np.ix_(*target)] = x[np.ix_(*source)]
    return [out]
