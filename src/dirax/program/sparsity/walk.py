"""A jaxpr run on index sets: what each primitive does to them is said in movement.py and arithmetic.py."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
import scipy.sparse as sp
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, Literal
from jax.interpreters import partial_eval

import dirax.program.rules  # noqa: F401  (registers the rules)
from dirax.program.rules.reductions import FOLDS
from dirax.program.sparsity import arithmetic, movement
from dirax.program.sparsity.values import Value, evaluated, rows, too_many, union

BY_ENTRY = frozenset(
    (
        *("add", "add_any", "sub", "mul", "div", "rem", "neg", "sign", "max", "min", "abs", "pow", "integer_pow", "square"),
        *("sqrt", "rsqrt", "cbrt", "exp", "exp2", "expm1", "log", "log1p", "logistic", "sin", "cos", "tan", "asin", "acos"),
        *("atan", "atan2", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh", "erf", "erfc", "erf_inv", "lgamma", "digamma"),
        *("floor", "ceil", "round", "nextafter", "clamp", "convert_element_type", "copy", "copy_p", "reduce_precision"),
        *("real", "imag", "complex", "conj", "bessel_i0e", "bessel_i1e", "igamma", "igammac", "polygamma"),
    )
)
"""Primitives that compute entry by entry."""

CALLS = {
    "jit": "jaxpr", "pjit": "jaxpr", "closed_call": "call_jaxpr", "core_call": "call_jaxpr", "remat2": "jaxpr",
    "checkpoint": "jaxpr", "custom_jvp_call": "call_jaxpr", "custom_vjp_call": "call_jaxpr", "custom_vjp_call_jaxpr": "fun_jaxpr",
}  # fmt: skip

BY_NAME: dict[str, Callable[..., list[Value]]] = {
    **dict.fromkeys((*movement.MOVES, "pad"), movement.moved),
    **dict.fromkeys(BY_ENTRY, arithmetic.united),
    **dict.fromkeys(("gather", "dynamic_slice"), movement.gathered),
    "dynamic_update_slice": movement.updated,
    "dot_general": arithmetic.product,
    "conv_general_dilated": arithmetic.convolved,
    "select_n": arithmetic.selected,
}
"""What primitives do to sets, whatever their operands."""

BY_MATRIX = frozenset(("lu", "triangular_solve", "cholesky", "eigh", "svd", "qr", "householder_product"))

IN_NUMPY: dict[str, Callable] = {
    "add": np.add, "add_any": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide, "neg": np.negative,
    "max": np.maximum, "min": np.minimum, "abs": np.abs, "convert_element_type": np.asarray, "copy": np.asarray,
    "eq": np.equal, "ne": np.not_equal, "lt": np.less, "le": np.less_equal, "gt": np.greater, "ge": np.greater_equal,
    "and": np.bitwise_and, "or": np.bitwise_or, "not": np.invert, "square": np.square, "sqrt": np.sqrt,
    "select_n": lambda which, *cases: np.choose(which, cases),
}  # fmt: skip
"""What is evaluated where all numbers are known: masks, indices, constants of a linear part."""

INDEXING = frozenset(
    ("gather", "dynamic_slice", "cumsum", "reduce_sum", "scatter", "scatter-add", "sort", "xor", "is_finite", "select_n", "rem")
)


def pattern_of(function: Callable, unknowns: Any, *others: Any) -> Any:
    """Where the Jacobian of `function(unknowns, *others)`, an array of floats, can have entries: booleans (results, unknowns).

    `unknowns` is a vector; all arguments are values or `jax.ShapeDtypeStruct`s. Other floats than unknowns are not looked at,
    whole numbers among them are, where their values are known. Raises `Dense`.
    """
    shaped = lambda x: x if isinstance(x, jax.ShapeDtypeStruct) else jax.ShapeDtypeStruct(np.shape(x), jax.numpy.result_type(x))
    closed = jax.make_jaxpr(function)(*jax.tree.map(shaped, (unknowns, *others)))
    size = math.prod(unknowns.shape)
    whole = lambda leaf: None if jax.numpy.issubdtype(jax.numpy.result_type(leaf), np.inexact) else _concrete(leaf)
    given = [Value(known=whole(leaf)) for leaf in jax.tree.leaves(others)]
    (found,) = _run(closed, [Value(_unit_sets(size)), *given])
    return sp.csr_matrix((closed.out_avals[0].size, size), dtype=bool) if found.sets is None else found.sets


def _unit_sets(size: int) -> Any:
    """Every unknown depends on itself."""
    return sp.csr_matrix((np.ones(size, bool), np.arange(size), np.arange(size + 1)), (size, size))


def _concrete(value: Any) -> np.ndarray | None:
    return None if isinstance(value, Tracer | jax.ShapeDtypeStruct) else np.asarray(value)


def _run(closed: ClosedJaxpr, operands: Sequence[Value]) -> list[Value]:
    jaxpr, used = partial_eval.dce_jaxpr(closed.jaxpr, [True] * len(closed.jaxpr.outvars))[:2]
    operands = [operand for operand, needed in zip(operands, used, strict=True) if needed]
    constants = [Value(known=_concrete(c)) for c in closed.consts]
    values: dict[Any, Value] = dict(zip(closed.jaxpr.constvars, constants, strict=True))
    values.update(zip(jaxpr.invars, operands, strict=True))
    read = lambda atom: Value(known=np.asarray(atom.val)) if isinstance(atom, Literal) else values[atom]
    for equation in jaxpr.eqns:
        results = _results(equation, [read(atom) for atom in equation.invars])
        for variable, result in zip(equation.outvars, results, strict=True):
            values[variable] = _trimmed(equation, variable, result)
    return [read(atom) for atom in jaxpr.outvars]


def _trimmed(equation: Any, variable: Any, value: Value) -> Value:
    """Without the sets of what has no derivative. Raises `Dense` where there is too much of them."""
    sets, zero = value.sets, value.zero
    if sets is not None and not np.issubdtype(variable.aval.dtype, np.inexact):
        sets = None
    if zero is not None and not np.any(zero):
        zero = None
    if sets is not None and zero is not None:
        sets = rows(sets, np.where(zero.ravel(), 0, np.arange(1, zero.size + 1)))
    if sets is not None:
        too_many(sets.nnz, sets, sets.shape[0], f"the results of '{equation.primitive.name}' depend on too many unknowns each")
    return Value(sets, value.known, zero)


def _results(equation: Any, operands: list[Value]) -> list[Value]:
    name, p = equation.primitive.name, equation.params
    if name in CALLS:
        inner = p[CALLS[name]]
        return _run(inner if isinstance(inner, ClosedJaxpr) else ClosedJaxpr(inner, ()), operands)
    if name.startswith("dirax_"):
        impl = lambda *given: equation.primitive.impl(*given, **p)
        return _run(jax.make_jaxpr(impl)(*(v.aval for v in equation.invars)), operands)
    if all(o.known is not None for o in operands) and name not in movement.MOVES:
        if name in IN_NUMPY:
            return [Value(known=IN_NUMPY[name](*(o.known for o in operands)).astype(equation.outvars[0].aval.dtype))]
        if name == "iota":
            return [Value(known=iota(equation))]
        if _is_whole(equation):
            return [Value(known=a) for a in evaluated(equation, [o.known for o in operands])]
    if name in BY_NAME:
        return BY_NAME[name](equation, *operands)
    if name in FOLDS and "axes" in p:
        return arithmetic.reduced(equation, *operands)
    if name.startswith("scatter"):
        return movement.scattered(equation, *operands)
    if name == "cond":
        return _branches(equation, operands)
    moving = any(np.issubdtype(v.aval.dtype, np.inexact) for v in equation.outvars)
    if not moving or all(o.sets is None for o in operands):
        return [Value()] * len(equation.outvars)
    return (arithmetic.by_matrix if name in BY_MATRIX else arithmetic.all_of_all)(equation, *operands)


def _is_whole(equation: Any) -> bool:
    """Whether results are whole numbers, which can be indices, of a primitive that is quickly evaluated."""
    whole = all(np.issubdtype(v.aval.dtype, np.integer) or v.aval.dtype == np.bool_ for v in equation.outvars)
    name = equation.primitive.name
    return whole and not equation.effects and (name in BY_ENTRY or name in INDEXING)


def _branches(equation: Any, operands: list[Value]) -> list[Value]:
    found: list[Any] = [None] * len(equation.outvars)
    for branch in equation.params["branches"]:
        results = _run(branch, operands[1:])
        found = [a if b.sets is None else union(a, b.sets) for a, b in zip(found, results, strict=True)]
    return [Value(sets) for sets in found]


def iota(equation: Any) -> np.ndarray:
    shape, along = equation.outvars[0].aval.shape, equation.params["dimension"]
    inner = [1] * len(shape)
    inner[along] = -1
    return np.broadcast_to(np.arange(shape[along], dtype=equation.outvars[0].aval.dtype).reshape(inner), shape)
