"""The operations of the scalar graph, and what they mean on NumPy arrays."""

import math
import operator
from typing import Any

import numpy as np

_erf = np.vectorize(math.erf, otypes=[np.float64])
_erfc = np.vectorize(math.erfc, otypes=[np.float64])


def _maximum(a, b):
    return np.maximum(a, b)


def _minimum(a, b):
    return np.minimum(a, b)


OPERATIONS: dict[str, Any] = {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "neg": np.negative,
    "recip": lambda a: np.divide(1.0, a),
    "abs": np.abs,
    "sqrt": np.sqrt,
    "floor": np.floor,
    "ceil": np.ceil,
    "round": np.rint,
    "trunc": np.trunc,
    "sign": np.sign,
    "max": _maximum,
    "min": _minimum,
    "rem": np.fmod,
    "sin": np.sin,
    "cos": np.cos,
    "tan": np.tan,
    "asin": np.arcsin,
    "acos": np.arccos,
    "atan": np.arctan,
    "atan2": np.arctan2,
    "sinh": np.sinh,
    "cosh": np.cosh,
    "tanh": np.tanh,
    "asinh": np.arcsinh,
    "acosh": np.arccosh,
    "atanh": np.arctanh,
    "exp": np.exp,
    "exp2": np.exp2,
    "expm1": np.expm1,
    "log": np.log,
    "log1p": np.log1p,
    "pow": np.power,
    "cbrt": np.cbrt,
    "erf": _erf,
    "erfc": _erfc,
    "select": np.where,
    "lt": np.less,
    "le": np.less_equal,
    "eq": np.equal,
    "ne": np.not_equal,
    "finite": np.isfinite,
    "and": np.logical_and,
    "or": np.logical_or,
    "not": np.logical_not,
}

EXACT = {
    **{"add": operator.add, "sub": operator.sub, "mul": operator.mul, "neg": operator.neg, "abs": abs},
    **{"lt": operator.lt, "le": operator.le, "eq": operator.eq, "ne": operator.ne},
}
"""Operations that Python's numbers do as NumPy's do, without a warning or an error."""

BOOLEAN = frozenset({"bool", "lt", "le", "eq", "ne", "finite", "and", "or", "not"})
COMMUTATIVE = frozenset({"add", "mul", "max", "min", "eq", "ne", "and", "or"})
STEPWISE = frozenset({"floor", "ceil", "round", "trunc", "sign"})
"""Operations whose derivative is zero."""


def evaluate_one(op: str, *values):
    """The value of one operation on constants."""
    if op in EXACT and all(type(v) is float for v in values):
        return EXACT[op](*values)
    with np.errstate(all="ignore"):
        return OPERATIONS[op](*(np.bool_(v) if isinstance(v, bool) else np.float64(v) for v in values)).item()
