"""The operations of the scalar graph, each whole in one place, a file a family; and tables of what is asked of all of them."""

from collections.abc import Callable
from typing import Any

import numpy as np

from dirax.program.operations import (
    arithmetic,
    derivatives,
    error_function,
    exponential,
    hyperbolic,
    inverse_trigonometric,
    logarithms_and_powers,
    logic,
    trigonometric,
)
from dirax.program.operations.operation import Operation

FAMILIES = (
    *(arithmetic, logic, trigonometric, inverse_trigonometric),
    *(exponential, logarithms_and_powers, hyperbolic, error_function, derivatives),
)
OPERATIONS: dict[str, Operation] = {operation.name: operation for family in FAMILIES for operation in family.OPERATIONS}

NUMPY: dict[str, Callable[..., Any]] = {name: operation.numpy for name, operation in OPERATIONS.items()}
JAX: dict[str, Callable[..., Any]] = {name: operation.jax for name, operation in OPERATIONS.items()}
EXACT = {name: operation.exact for name, operation in OPERATIONS.items() if operation.exact is not None}
COMMUTATIVE = frozenset(name for name, operation in OPERATIONS.items() if operation.commutative)
BOOLEAN = frozenset({"bool", *(name for name, operation in OPERATIONS.items() if operation.boolean)})
"""The operations, and the constants, that are truth values."""

WITH_EDGE = frozenset(name for name, operation in OPERATIONS.items() if operation.edge)


def evaluate_one(op: str, *values):
    """The value of one operation on constants."""
    if op in EXACT and all(type(v) is float for v in values):
        return EXACT[op](*values)
    with np.errstate(all="ignore"):
        return NUMPY[op](*(np.bool_(v) if isinstance(v, bool) else np.float64(v) for v in values)).item()
