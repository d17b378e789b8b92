"""What is computed by NumPy between parts of a graph: decompositions, roots, loops whose length depends on their values."""

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr

from dirax.numerics.inverses import solved
from dirax.numerics.newton import damped_step, sizes_of_unknowns
from dirax.numerics.tolerances import EQUATION_RANK
from dirax.program.evaluation.in_numpy import Slopes, Values
from dirax.program.graph import GraphTooLarge
from dirax.program.interpreter import RULES, Interpreter, Nodes, Unavailable, Unsupported, UnsupportedPrimitive
from dirax.program.linear_solves import equilibrated_inverse, pseudo_inverses
from dirax.program.memo import Memo, Same
from dirax.program.rules.linear_algebra import linear_equations, split_as
from dirax.program.rules.reductions import factors_of_product, sum_of_products
from dirax.program.scalar_program import ScalarProgram, numpy_rule
from dirax.program.tracing import jacobian, of_one_result

LARGE_DERIVATIVE = 30_000
"""Nodes of a function times numbers by which it is differentiated from which on a graph of the derivative takes longer than its
values at a few entries."""

LARGE_FOR_FEW = 2000
"""The same of programs that are evaluated once, at a handful of entries."""

LARGE_PRODUCT = 256
"""Multiplications of a product of arrays from which on it is no graph of them."""


@numpy_rule("dot_general")
def dot_general(made: ScalarProgram, interpreter: Interpreter, equation: Any, a: Nodes, b: Nodes) -> list[Nodes]:
    """Large products stay products of arrays; summed in one order, so that an entry's bits do not depend on the others."""
    shape, (rows, columns) = equation.outvars[0].aval.shape, factors_of_product(equation, a, b)
    length = rows.shape[-1]
    if math.prod(shape) * length < LARGE_PRODUCT or equation.outvars[0].aval.dtype != np.float64:
        return list(RULES["dot_general"](interpreter, equation, a, b))
    left, right = np.moveaxis(rows, -1, 0)[..., None], np.moveaxis(columns, -1, 0)[:, :, None]

    def product(arrays: list[np.ndarray]) -> list[np.ndarray]:
        return [sum_of_products(*arrays).reshape(len(arrays[0]), *shape)]

    return made.between([left, right], [shape], product)


@numpy_rule("dirax_derivative")
def derivative_in_numbers(made: ScalarProgram, interpreter: Interpreter, equation: Any, *operands: Nodes) -> list[Nodes]:
    """Derivatives of large functions by many numbers are found in numbers, with no graph of their own."""
    jaxpr, wanted = equation.params["jaxpr"], equation.params["wanted"]
    inner = _inner.get(Same(jaxpr), lambda: _plain(jaxpr))
    large = LARGE_FOR_FEW if made.for_few else LARGE_DERIVATIVE
    if inner is None or len(inner.graph) * sum(operands[k].size for k in wanted) < large:
        return list(RULES["dirax_derivative"](interpreter, equation, *operands))
    (result,), inputs = inner.results, [node for k in wanted for node in inner.inputs[k].ravel().tolist()]
    ends, outputs, plans = np.cumsum([operands[k].size for k in wanted])[:-1], result.ravel().tolist(), []

    def slopes(arrays: list[np.ndarray]) -> list[np.ndarray]:
        plans[:] = plans or [Slopes(inner.graph, outputs, inputs)]
        known = Values(inner.graph, len(arrays[0]))
        for nodes, array in zip(inner.inputs, arrays, strict=True):
            known.bind(nodes, array)
        parts = np.split(known.slopes(outputs, inputs, plans[0]), ends, axis=2)
        return [part.reshape(len(part), *v.aval.shape) for part, v in zip(parts, equation.outvars, strict=True)]

    return made.between(list(operands), [v.aval.shape for v in equation.outvars], slopes)


_inner: Memo[ScalarProgram | None] = Memo(128)


def _plain(jaxpr: ClosedJaxpr) -> ScalarProgram | None:
    try:
        return ScalarProgram.of(jaxpr)
    except (UnsupportedPrimitive, GraphTooLarge):
        return None


@numpy_rule("svd")
def svd(made: ScalarProgram, interpreter: Interpreter, equation: Any, matrix: Nodes) -> list[Nodes]:
    p = equation.params

    def decompose(a: np.ndarray) -> list[np.ndarray]:
        left, values, right = np.linalg.svd(a, full_matrices=p["full_matrices"])
        return [values, left, right] if p["compute_uv"] else [values]

    return _decomposed(made, equation, matrix, decompose, "singular values")


@numpy_rule("eigh")
def eigh(made: ScalarProgram, interpreter: Interpreter, equation: Any, matrix: Nodes) -> list[Nodes]:
    def decompose(a: np.ndarray) -> list[np.ndarray]:
        values, vectors = np.linalg.eigh(a, UPLO="L" if equation.params["lower"] else "U")
        return [vectors, values]

    return _decomposed(made, equation, matrix, decompose, "eigenvalues")


def _decomposed(made: ScalarProgram, equation: Any, matrix: Nodes, decompose: Callable, what: str) -> list[Nodes]:
    if equation.params.get("subset_by_index") is not None:
        raise Unsupported(f"finds some {what} only")
    shapes = [v.aval.shape for v in equation.outvars]
    return made.between([matrix], shapes, lambda operands: _of_finite(decompose, *operands))


@numpy_rule("while")
def while_(made: ScalarProgram, interpreter: Interpreter, equation: Any, *operands: Nodes) -> Any:
    try:
        return list(RULES["while"](interpreter, equation, *operands))
    except Unsupported:
        pass
    if lost := next((o for o in operands if isinstance(o, Unavailable)), None):
        return [Unavailable(lost.error)] * len(equation.outvars)
    p = equation.params
    condition, body = (ScalarProgram.of(p[name], by_numpy=True).in_numpy for name in ("cond_jaxpr", "body_jaxpr"))
    a, b = p["cond_nconsts"], p["cond_nconsts"] + p["body_nconsts"]

    def loop(arrays: list[np.ndarray]) -> list[np.ndarray]:
        for_condition, for_body, carry = arrays[:a], arrays[a:b], arrays[b:]
        while True:
            going = condition([*for_condition, *carry])[0] != 0
            if not np.any(going):
                return carry
            after = body([*for_body, *carry])
            carry = [np.where(going.reshape(-1, *(1,) * (x.ndim - 1)), x, y) for x, y in zip(after, carry, strict=True)]

    return made.between(list(operands), [v.aval.shape for v in equation.outvars], loop)


@numpy_rule("custom_linear_solve")
def linear_solve(made: ScalarProgram, interpreter: Interpreter, equation: Any, *operands: Nodes) -> Any:
    try:
        return list(RULES["custom_linear_solve"](interpreter, equation, *operands))
    except Unsupported:  # too many to be written out
        found = linear_equations(interpreter, equation, operands)
    if isinstance(found, Unavailable):
        return [found] * len(equation.outvars)
    matrix, right = found
    (x,) = made.between([matrix, right], [right.shape], lambda operands: [solved(*operands)], "solve")
    return split_as(equation, x)


@numpy_rule("dirax_solve")
def solved_by_numpy(made: ScalarProgram, interpreter: Interpreter, equation: Any, matrix: Nodes, right: Nodes) -> list[Nodes]:
    return made.between([matrix, right], [right.shape], lambda operands: [solved(*operands)], "solve")


@numpy_rule("dirax_pseudo_inverse")
def pseudo_inverse(made: ScalarProgram, interpreter: Interpreter, equation: Any, matrix: Nodes) -> list[Nodes]:
    inverse = functools.partial(pseudo_inverses, tolerance=equation.params["tolerance"])
    return made.between(
        [matrix], [equation.outvars[0].aval.shape], lambda operands: _of_finite(lambda a: [inverse(a)], *operands)
    )


@numpy_rule("dirax_scaled_inverse")
def scaled_inverse(made: ScalarProgram, interpreter: Interpreter, equation: Any, matrix: Nodes) -> list[Nodes]:
    tolerance, shapes = equation.params["tolerance"], [v.aval.shape for v in equation.outvars]
    return made.between([matrix], shapes, lambda operands: _inverted(operands[0], tolerance), ("scaled inverse", tolerance))


def _inverted(matrices: np.ndarray, tolerance: float = EQUATION_RANK) -> list[np.ndarray]:
    """The scaled pseudo-inverses and the units of their rows; of a matrix that all entries have, once."""
    inverted = lambda a: list(equilibrated_inverse(np, a, tolerance))
    if len(matrices) > 1 and np.all(matrices == matrices[:1]):
        return [np.repeat(a, len(matrices), axis=0) for a in _of_finite(inverted, matrices[:1])]
    return _of_finite(inverted, matrices)


def _of_finite(function: Callable, matrices: np.ndarray) -> list[np.ndarray]:
    """The arrays that `function` gives for matrices with leading axes; NaN for a matrix that is not finite."""
    good = np.all(np.isfinite(matrices), axis=(-2, -1))
    spread = lambda a: good.reshape(*good.shape, *(1,) * (a.ndim - good.ndim))
    return [np.where(spread(a), a, np.nan) for a in function(np.where(spread(matrices), matrices, 0.0))]


_equations: Memo[tuple[Callable, Callable, bool]] = Memo(128)


def _with_slope(residual: ClosedJaxpr) -> tuple[Callable, Callable, bool]:
    """A residual and its derivative by the last argument, for arguments with an axis of entries; whether that is surely the same
    whatever the last argument is."""
    slope = jax.make_jaxpr(jacobian(of_one_result(residual), len(residual.in_avals) - 1))(*residual.in_avals)
    value, linear = (ScalarProgram.of(jaxpr, by_numpy=True) for jaxpr in (residual, slope))
    fixed = not linear.opaque and linear.inputs[-1].size > 0 and not linear.depends_on(linear.inputs[-1])
    return value.in_numpy, linear.in_numpy, fixed


@numpy_rule("dirax_root")
def root(made: ScalarProgram, interpreter: Interpreter, equation: Any, *operands: Nodes) -> list[Nodes]:
    """The method of `dirax.program.roots`, for all entries side by side."""
    closed: ClosedJaxpr = equation.params["residual"]
    residual, linear, fixed = _equations.get(Same(closed), lambda: _with_slope(closed))
    most = equation.params["max_steps"]

    def find(arrays: list[np.ndarray]) -> list[np.ndarray]:
        *captured, found = arrays
        found, going = found.copy(), np.arange(len(found))
        of_all, among = [], going
        for _ in range(most):
            if not len(going):
                break
            known = [a[going] for a in captured]
            if not fixed or not of_all:
                of_all = [slope := linear([*known, found[going]])[0], *_inverted(slope)]
                among = np.arange(len(going))
            slope, inverse, units = (a[among] for a in of_all)
            value = residual([*known, found[going]])[0]
            sizes = sizes_of_unknowns(slope, inverse, found[going], value)
            changed = lambda value, inverse=inverse: (inverse @ value[..., None])[..., 0]
            update = lambda u, known=known, changed=changed: changed(residual([*known, u])[0])
            found[going], more = damped_step(changed(value), update, found[going], units, sizes)
            going, among = going[more], among[more]
        return [found]

    return made.between(list(operands), [equation.outvars[0].aval.shape], find)
