"""Rules of reductions, products of arrays and cumulative sums."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from dirax.program.convolved import factors
from dirax.program.graph import Graph
from dirax.program.interpreter import Interpreter, rule

LARGE = 256
"""Multiplications of a product of arrays from which on it pays to ask whether all of them are of constants."""

FOLDS = {
    "reduce_sum": "add",
    "reduce_prod": "mul",
    "reduce_max": "max",
    "reduce_min": "min",
    "reduce_and": "and",
    "reduce_or": "or",
    "cumsum": "add",
    "cumprod": "mul",
    "cummax": "max",
    "cummin": "min",
}
EMPTY = {"add": 0.0, "mul": 1.0, "max": -np.inf, "min": np.inf, "and": True, "or": False}


def fold(interpreter: Interpreter, op: str, nodes) -> int:
    """op over the nodes from the left."""
    g, total = interpreter.graph, None
    for node in nodes:
        total = node if total is None else g.make(op, total, node)
    return g.constant(EMPTY[op]) if total is None else total


def along_axes(x: np.ndarray, axes, function: Callable[[list[int]], int]) -> np.ndarray:
    """`function` of the entries along `axes`, for every position of the other axes."""
    kept = [a for a in range(x.ndim) if a not in axes]
    shape = tuple(x.shape[a] for a in kept)
    count = int(np.prod([x.shape[a] for a in axes]))
    rows = np.transpose(x, (*kept, *axes)).reshape(int(np.prod(shape)), count).tolist()
    return np.array([function(row) for row in rows], dtype=np.int64).reshape(shape)


@rule("reduce_sum", "reduce_prod", "reduce_max", "reduce_min", "reduce_and", "reduce_or")
def reduce(interpreter: Interpreter, equation: Any, x):
    op = FOLDS[equation.primitive.name]
    return [along_axes(x, tuple(equation.params["axes"]), lambda row: fold(interpreter, op, row))]


@rule("cumsum", "cumprod", "cummax", "cummin")
def cumulative(interpreter: Interpreter, equation: Any, x):
    g, op, axis = interpreter.graph, FOLDS[equation.primitive.name], equation.params["axis"]
    out = np.moveaxis(x, axis, 0).copy()
    order = range(len(out) - 1, -1, -1) if equation.params["reverse"] else range(len(out))
    previous = None
    for i in order:
        if previous is not None:
            for index in np.ndindex(*out[i].shape):
                out[(i, *index)] = g.make(op, int(out[(previous, *index)]), int(out[(i, *index)]))
        previous = i
    return [np.moveaxis(out, 0, axis)]


@rule("argmax", "argmin")
def position_of_extreme(interpreter: Interpreter, equation: Any, x):
    g, largest = interpreter.graph, equation.primitive.name == "argmax"

    def position(row):
        best, where = row[0], g.zero
        for i, node in enumerate(row[1:], 1):
            better = g.make("lt", *((best, node) if largest else (node, best)))
            best, where = g.select(better, node, best), g.select(better, g.constant(float(i)), where)
        return where

    return [along_axes(x, tuple(equation.params["axes"]), position)]


@rule("dot_general")
def dot_general(interpreter: Interpreter, equation: Any, a, b):
    g = interpreter.graph
    rows, columns = factors_of_product(equation, a, b)
    of_floats = equation.outvars[0].aval.dtype == np.float64
    large = of_floats and rows.size * columns.shape[1] >= LARGE
    if large and (known := _product_of_constants(interpreter, rows, columns)) is not None:
        return [interpreter.constants(known.reshape(equation.outvars[0].aval.shape))]
    zero = zeros_of(g, rows, columns)
    out = np.full((len(rows), rows.shape[1], columns.shape[1]), g.zero)
    for k, i, j in np.argwhere(terms_of_product(rows, columns, zero)).tolist():
        pairs = zip(rows[k, i].tolist(), columns[k, j].tolist(), strict=True)
        out[k, i, j] = fold(interpreter, "add", [g.mul(x, y) for x, y in pairs if x not in zero and y not in zero])
    return [out.reshape(equation.outvars[0].aval.shape)]


def terms_of_product(rows: np.ndarray, columns: np.ndarray, zero: set[int]) -> np.ndarray:
    """How many terms that are not surely zero each entry of a product is the sum of, (batch, i, j)."""
    of_rows, of_columns = (~np.isin(nodes, list(zero)) for nodes in (rows, columns))
    return of_rows.astype(float) @ np.swapaxes(of_columns, 1, 2)


def zeros_of(g: Graph, *factors: np.ndarray) -> set[int]:
    """The nodes with which a product of entries of these factors is zero."""
    return {g.zero, g.constant(-0.0)} if _are_finite(g, *factors) else set()


def _are_finite(g: Graph, *factors: np.ndarray) -> bool:
    """Whether nothing comes of the products of zeros, which most are with columns of an identity: no constant is ∞ or NaN."""
    constants = (g.number(node) for nodes in factors for node in np.unique(nodes).tolist())
    return all(c is None or math.isfinite(c) for c in constants)


def _product_of_constants(interpreter: Interpreter, rows: np.ndarray, columns: np.ndarray) -> np.ndarray | None:
    """The product in numbers, with the bits of the sums that nodes would be made for; None where a factor is no constant."""
    if (left := interpreter.numbers(rows)) is None or (right := interpreter.numbers(columns)) is None:
        return None
    left, right = (np.moveaxis(a, -1, 1) for a in (left, right))
    return sum_of_products(left[..., None], right[:, :, None])


def sum_of_products(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Σ x·y over the second axis in its order, so that an entry's bits do not depend on the others."""
    with np.errstate(all="ignore"):
        total = x[:, 0] * y[:, 0]
        for k in range(1, x.shape[1]):
            total = total + x[:, k] * y[:, k]
    return total


@rule("conv_general_dilated")
def convolution(interpreter: Interpreter, equation: Any, a, b):
    g, (left, right) = interpreter.graph, factors(equation)
    nodes = np.append(g.zero, a), np.append(g.zero, b)
    terms = (x[numbers].reshape(-1, numbers.shape[-1]).tolist() for x, numbers in zip(nodes, (left, right), strict=True))
    out = [fold(interpreter, "add", [g.mul(x, y) for x, y in zip(*pairs, strict=True)]) for pairs in zip(*terms, strict=True)]
    return [np.array(out, dtype=np.int64).reshape(equation.outvars[0].aval.shape)]


def factors_of_product(equation: Any, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The operands of a `dot_general` as rows (batch, i, length) and columns (batch, j, length), to be summed over the last."""
    (ca, cb), (ba, bb) = equation.params["dimension_numbers"]

    def arranged(array: np.ndarray, contracted, batched) -> np.ndarray:
        free = [i for i in range(array.ndim) if i not in (*contracted, *batched)]
        sizes = (math.prod(array.shape[i] for i in axes) for axes in (batched, free, contracted))
        return np.transpose(array, (*batched, *free, *contracted)).reshape(*sizes)

    return arranged(a, ca, ba), arranged(b, cb, bb)
