"""Rules of small linear solves: elimination written out in scalars, rows exchanged by selects."""

import math
from typing import Any

import numpy as np

from dirax.program.graph import Graph
from dirax.program.interpreter import RULES, Interpreter, Unavailable, Unsupported, rule

SOLVE_LIMIT = 12
"""Largest matrix that a user's function may factor; one of constants may be as large as it likes, since nothing of its factors is
left to be computed."""

MOST_SIDE_BY_SIDE = 4 * SOLVE_LIMIT**2
"""Equations up to which it is looked how they fall apart, as those of a vmapped solve do: twenty points of ten each are 200."""


def solve_triangular(g: Graph, matrix: np.ndarray, b: np.ndarray, lower: bool, unit: bool) -> np.ndarray:
    """x with matrix x = b, (n, r)."""
    n, x = len(matrix), b.copy()
    for i in range(n) if lower else reversed(range(n)):
        for j in range(i) if lower else range(i + 1, n):
            for r in range(b.shape[1]):
                x[i, r] = g.sub(int(x[i, r]), g.mul(int(matrix[i, j]), int(x[j, r])))
        if not unit:
            for r in range(b.shape[1]):
                x[i, r] = g.div(int(x[i, r]), int(matrix[i, i]))
    return x


def eliminated(g: Graph, matrix: np.ndarray, b: np.ndarray) -> np.ndarray:
    """x with matrix x = b, (n, r), by elimination with partial pivoting of [matrix | b]."""
    n = len(matrix)
    if n > SOLVE_LIMIT and not all(map(g.is_constant, matrix.ravel().tolist())):
        raise Unsupported(f"solves {n} equations; at most {SOLVE_LIMIT} are written out")
    rows = np.concatenate([matrix, b], axis=1)
    for c in range(n):
        for i in range(c + 1, n):
            swap = g.make("lt", g.make("abs", int(rows[c, c])), g.make("abs", int(rows[i, c])))
            for j in range(c, rows.shape[1]):
                upper, lower = int(rows[c, j]), int(rows[i, j])
                rows[c, j], rows[i, j] = g.select(swap, lower, upper), g.select(swap, upper, lower)
        pivot = g.recip(int(rows[c, c]))
        for i in range(c + 1, n):
            multiplier = g.mul(int(rows[i, c]), pivot)
            for j in range(c + 1, rows.shape[1]):
                rows[i, j] = g.sub(int(rows[i, j]), g.mul(multiplier, int(rows[c, j])))
    return solve_triangular(g, rows[:, :n], rows[:, n:], lower=False, unit=False)


def over_batches(function, *arrays) -> Any:
    """`function` on the last two axes, for every index of those before."""
    lead = arrays[0].shape[:-2]
    if not lead:
        return function(*arrays)
    results = [function(*(a[index] for a in arrays)) for index in np.ndindex(*lead)]
    if isinstance(results[0], tuple):
        return tuple(np.stack(part).reshape(*lead, *part[0].shape) for part in zip(*results, strict=True))
    return np.stack(results).reshape(*lead, *results[0].shape)


@rule("custom_linear_solve", lazy=True)
def custom_linear_solve(interpreter: Interpreter, equation: Any, *operands):
    found = linear_equations(interpreter, equation, operands)
    if isinstance(found, Unavailable):
        return [found] * len(equation.outvars)
    matrix, right = found
    return split_as(equation, solve_blocks(interpreter.graph, matrix, right[:, None])[:, 0])


def linear_equations(interpreter: Interpreter, equation: Any, operands: Any) -> tuple[np.ndarray, np.ndarray] | Unavailable:
    """The matrix (n, n), read off from the linear map itself, column by column, so that how the user solved does not matter, and
    the right-hand side (n,)."""
    p, g = equation.params, interpreter.graph
    lengths = p["const_lengths"]
    for_matvec = operands[: lengths.matvec]
    sides = operands[sum(lengths) :]
    if lost := next((o for o in (*for_matvec, *sides) if isinstance(o, Unavailable)), None):
        return Unavailable(lost.error)
    shapes, sizes = [s.shape for s in sides], [s.size for s in sides]
    n = sum(sizes)
    if n > MOST_SIDE_BY_SIDE:
        raise Unsupported(f"solves {n} equations at once")
    columns = []
    apart = Interpreter(g, {**interpreter.rules, "dot_general": RULES["dot_general"]})  # a product that is no graph joins all
    for k in range(n):
        unit = np.full(n, g.zero)
        unit[k] = g.one
        parts = [a.reshape(s) for a, s in zip(np.split(unit, np.cumsum(sizes)[:-1]), shapes, strict=True)]
        image = apart.run(p["jaxprs"].matvec, *for_matvec, *parts)
        if lost := next((o for o in image if isinstance(o, Unavailable)), None):
            return Unavailable(lost.error)
        columns.append(np.concatenate([o.ravel() for o in image]))
    return np.stack(columns, axis=1), np.concatenate([s.ravel() for s in sides])


def split_as(equation: Any, x: np.ndarray) -> list[np.ndarray]:
    """The results of an equation from one array of all."""
    shapes = [v.aval.shape for v in equation.outvars]
    sizes = [math.prod(shape) for shape in shapes]
    return [a.reshape(shape) for a, shape in zip(np.split(x, np.cumsum(sizes)[:-1]), shapes, strict=True)]


@rule("dirax_solve")
def small_solve(interpreter: Interpreter, equation: Any, matrix, right):
    return [solve_blocks(interpreter.graph, matrix, right.reshape(len(right), -1)).reshape(right.shape)]


def solve_blocks(g: Graph, matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """x with matrix x = right, (n, r), for every group of equations by itself."""
    x = np.empty_like(right)
    for block in _independent(~np.isin(matrix, [g.zero, g.constant(-0.0)])):
        x[block] = eliminated(g, matrix[np.ix_(block, block)], right[block])
    return x


def _independent(pattern: np.ndarray) -> list[list[int]]:
    """Groups of equations that have no unknown in common with the others: a vmapped solve falls apart into its own."""
    n, groups, seen = len(pattern), [], set()
    linked = pattern | pattern.T
    for start in range(n):
        if start in seen:
            continue
        group, stack = {start}, [start]
        while stack:
            for j in np.nonzero(linked[stack.pop()])[0].tolist():
                if j not in group:
                    group.add(j)
                    stack.append(j)
        seen |= group
        groups.append(sorted(group))
    return groups


@rule("triangular_solve")
def triangular_solve(interpreter: Interpreter, equation: Any, a, b):
    g, p = interpreter.graph, equation.params

    def one(a, b):
        lower = p["lower"]
        if p["transpose_a"]:
            a, lower = a.T, not lower
        if p["left_side"]:
            return solve_triangular(g, a, b, lower, p["unit_diagonal"])
        return solve_triangular(g, a.T, b.T, not lower, p["unit_diagonal"]).T

    return [over_batches(one, a, b)]


@rule("lu")
def lu(interpreter: Interpreter, equation: Any, a) -> tuple[Any, ...]:
    g = interpreter.graph
    if a.shape[-1] != a.shape[-2]:
        raise Unsupported("factors a matrix that is not square")

    def one(a):
        packed, taken = factor(g, a)
        return packed, *taken

    return over_batches(one, a)


def factor(g: Graph, matrix: np.ndarray):
    """LU as LAPACK gives it: packed factors, pivots and permutation, the exchanges being of single pairs of rows."""
    n = len(matrix)
    if n > SOLVE_LIMIT:
        raise Unsupported(f"factors a matrix of size {n}; at most {SOLVE_LIMIT} is written out")
    rows, order = matrix.copy(), np.array([g.constant(float(i)) for i in range(n)], dtype=np.int64)
    pivots = np.empty(n, dtype=np.int64)
    for c in range(n):
        best, where = g.make("abs", int(rows[c, c])), g.constant(float(c))
        for i in range(c + 1, n):
            size = g.make("abs", int(rows[i, c]))
            larger = g.make("lt", best, size)
            best, where = g.select(larger, size, best), g.select(larger, g.constant(float(i)), where)
        pivots[c] = where
        for i in range(c + 1, n):
            swap = g.make("eq", where, g.constant(float(i)))
            for table in (*rows.T, order):
                upper, lower = int(table[c]), int(table[i])
                table[c], table[i] = g.select(swap, lower, upper), g.select(swap, upper, lower)
        pivot = g.recip(int(rows[c, c]))
        for i in range(c + 1, n):
            rows[i, c] = multiplier = g.mul(int(rows[i, c]), pivot)
            for j in range(c + 1, n):
                rows[i, j] = g.sub(int(rows[i, j]), g.mul(multiplier, int(rows[c, j])))
    return rows, (pivots, order)


@rule("lu_pivots_to_permutation")
def lu_pivots_to_permutation(interpreter: Interpreter, equation: Any, pivots):
    g, size = interpreter.graph, equation.params["permutation_size"]
    if pivots.ndim != 1:
        raise Unsupported("is not supported on batches")
    order = [g.constant(float(i)) for i in range(size)]
    for c, where in enumerate(pivots.tolist()):
        for i in range(c + 1, size):
            swap = g.make("eq", where, g.constant(float(i)))
            order[c], order[i] = g.select(swap, order[i], order[c]), g.select(swap, order[c], order[i])
    return [np.array(order, dtype=np.int64)]


@rule("cholesky")
def cholesky(interpreter: Interpreter, equation: Any, a):
    g = interpreter.graph

    def one(a):
        n = len(a)
        if n > SOLVE_LIMIT:
            raise Unsupported(f"factors a matrix of size {n}; at most {SOLVE_LIMIT} is written out")
        out = np.full((n, n), g.zero)
        for j in range(n):
            for i in range(j, n):
                total = int(a[i, j])
                for k in range(j):
                    total = g.sub(total, g.mul(int(out[i, k]), int(out[j, k])))
                out[i, j] = g.make("sqrt", total) if i == j else g.div(total, int(out[j, j]))
        return out

    return [over_batches(one, a)]
