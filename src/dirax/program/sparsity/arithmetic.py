"""What computes with entries: the sets of a result unite those of what it is computed from."""

import math
from typing import Any

import numpy as np
import scipy.sparse as sp

from dirax.program.convolved import factors
from dirax.program.sparsity.values import Value, folded, of_all, rows, spread, too_many, union

ODD = frozenset(("neg", "convert_element_type", "copy", "copy_p", "reduce_precision", "real", "abs", "square", "sin", "tan"))
"""Functions of one number that are zero at zero."""


def united(equation: Any, *operands: Value) -> list[Value]:
    shape, name = equation.outvars[0].aval.shape, equation.primitive.name
    found: Any = None
    zero: Any = None
    for operand, variable in zip(operands, equation.invars, strict=True):
        if operand.sets is not None:
            found = union(found, spread(operand.sets, variable.aval.shape, shape))
    if any(o.known is not None or o.zero is not None for o in operands):
        zeros = [np.broadcast_to(o.zeros(v.aval.shape), shape) for o, v in zip(operands, equation.invars, strict=True)]
        if name == "mul":
            zero = zeros[0] | zeros[1]
        elif name in ("add", "add_any", "sub"):
            zero = zeros[0] & zeros[1]
        elif name == "div" or (name in ODD and len(zeros) == 1):
            zero = zeros[0]
    return [Value(found, None, zero)] * len(equation.outvars)


def selected(equation: Any, which: Value, *cases: Value) -> list[Value]:
    shape = equation.outvars[0].aval.shape
    size, found = math.prod(shape), None
    shapes = [v.aval.shape for v in equation.invars[1:]]
    zeros = [np.broadcast_to(case.zeros(own), shape) for case, own in zip(cases, shapes, strict=True)]
    each = [None if case.sets is None else spread(case.sets, own, shape) for case, own in zip(cases, shapes, strict=True)]
    if which.known is None:
        for sets in each:
            found = found if sets is None else union(found, sets)
        return [Value(found, None, np.all(zeros, axis=0))]
    chosen = np.broadcast_to(which.known, shape).astype(int)
    for k, sets in enumerate(each):
        if sets is not None:
            found = union(found, rows(sets, np.where(chosen.ravel() == k, np.arange(1, size + 1), 0)))
    return [Value(found, None, np.choose(chosen, zeros))]


def reduced(equation: Any, value: Value) -> list[Value]:
    shape, axes = equation.invars[0].aval.shape, equation.params["axes"]
    sets = None if value.sets is None else folded(value.sets, shape, axes)
    zero = None if value.zero is None and value.known is None else np.all(value.zeros(shape), axis=tuple(axes))
    return [Value(sets, None, zero)]


def product(equation: Any, *operands: Value) -> list[Value]:
    """Sums of the products that are not zero: of each batch, rows of the one with columns of the other."""
    contracted, batched = equation.params["dimension_numbers"]
    shapes = [v.aval.shape for v in equation.invars]
    orders, sizes = [], []
    for shape, own, lead in zip(shapes, contracted, batched, strict=True):
        free = [i for i in range(len(shape)) if i not in (*own, *lead)]
        orders.append(np.arange(math.prod(shape)).reshape(shape).transpose((*lead, *free, *own)).ravel())
        sizes.append([math.prod(shape[i] for i in axes) for axes in (lead, free, own)])
    (batch, height, length), (_, columns, _) = sizes
    whole, has_zeros = (batch, height, columns), [o.known is not None or o.zero is not None for o in operands]
    there = [
        ~o.zeros(shape).ravel()[order].reshape(size) if z else None
        for o, shape, order, size, z in zip(operands, shapes, orders, sizes, has_zeros, strict=True)
    ]
    found: Any = None
    zero: Any = None
    if all(has_zeros) or (any(has_zeros) and not all(np.all(t) for t in there if t is not None)):
        zero = zero_products(there, sizes).reshape(equation.outvars[0].aval.shape)
    for k, operand in enumerate(operands):
        if operand.sets is None:
            continue
        sets, own, across = operand.sets[orders[k]], sizes[k][1], there[1 - k]
        if across is None or np.all(across):
            sums = folded(sets, (batch * own, length), (1,))
            numbers = np.arange(1, batch * own + 1).reshape(batch, own, 1)
            numbers = numbers if k == 0 else numbers.transpose(0, 2, 1)
            part = rows(sums, np.broadcast_to(numbers, whole))
        else:
            group, other, at = (a[:, None] for a in np.nonzero(across))
            mine = np.arange(own)
            count = group.size * own
            too_many(count, sets, math.prod(whole), f"a product of arrays takes {count} multiplications")
            out = (group * height + (mine if k == 0 else other)) * columns + (other if k == 0 else mine)
            source = (group * own + mine) * length + at
            taken = sp.csr_matrix((np.ones(out.size, bool), (out.ravel(), source.ravel())), (math.prod(whole), len(orders[k])))
            part = taken @ sets
        found = union(found, part)
    return [Value(found, None, zero)]


def convolved(equation: Any, *operands: Value) -> list[Value]:
    """Sums of products of the entries in a window."""
    found: Any = None
    for operand, numbers in zip(operands, factors(equation), strict=True):
        if operand.sets is not None:
            for k in range(numbers.shape[-1]):
                found = union(found, rows(operand.sets, numbers[..., k]))
    return [Value(found)]


def zero_products(there: list[Any], sizes: list[list[int]]) -> np.ndarray:
    """Which sums of products have no term."""
    full = [np.ones(size, bool) if t is None else t for t, size in zip(there, sizes, strict=True)]
    return np.stack([(sp.csr_matrix(a) @ sp.csr_matrix(b).T).toarray() == 0 for a, b in zip(*full, strict=True)])


def by_matrix(equation: Any, *operands: Value) -> list[Value]:
    """Each matrix of a batch by itself."""
    batch = math.prod(equation.invars[0].aval.shape[:-2])
    each = lambda variable: variable.aval.size // max(batch, 1)
    found: Any = None
    for variable, operand in zip(equation.invars, operands, strict=True):
        if operand.sets is not None:
            found = union(found, folded(operand.sets, (batch, each(variable)), (1,)))
    return of_all(found, list(map(each, equation.outvars)), f"'{equation.primitive.name}' is of a large matrix", batch)


def all_of_all(equation: Any, *operands: Value) -> list[Value]:
    """What is not known: every result depends on everything."""
    found: Any = None
    for operand in operands:
        if operand.sets is not None:
            found = union(found, folded(operand.sets, (operand.sets.shape[0],), (0,)))
    return of_all(found, [variable.aval.size for variable in equation.outvars], f"'{equation.primitive.name}' is not followed")
