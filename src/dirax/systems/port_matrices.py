"""The matrices J, B and R of port-Hamiltonian systems: functions of x, or constant ones, which may be sparse."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.numerics.tolerances import STRUCTURE_DEFECT, TINY
from dirax.program.sparse_matrix import SparseMatrix
from dirax.program.user_functions import UserFunction


def matrix_function(value: Any, name: str) -> UserFunction:
    """The user's function of x, or a constant array as one."""
    if isinstance(value, UserFunction):
        return value
    if callable(value):
        return UserFunction(value, name, ("x",))
    if is_sparse(value):
        return ConstantFunction(value, name)
    try:
        constant = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        raise TypeError(f"{name} must be a matrix or a function of x that returns one, but {value!r:.60} was given.") from None
    return UserFunction(lambda x: jnp.asarray(constant), name, ("x",))


class ConstantFunction(UserFunction):
    """The function of x that is a sparse matrix everywhere."""

    def __init__(self, matrix: Any, name: str):
        constant = matrix if isinstance(matrix, SparseMatrix) else SparseMatrix(matrix)
        super().__init__(lambda x: constant, name, ("x",))

    def __call__(self, *values: Any):
        return self.function(None)

    def shape(self, *values: Any) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(self.function(None).shape, jnp.float64)


def is_sparse(value: Any) -> bool:
    """Whether a value is a sparse matrix, of SciPy or of dirax."""
    return isinstance(value, SparseMatrix) or hasattr(value, "tocsr")


def constituent(function: UserFunction | None):
    """What a system is made of again."""
    if isinstance(function, ConstantFunction):
        return function.function(None)
    return function


def refuse_unless_skew(J: UserFunction, found: np.ndarray | None) -> None:
    """Raise `ValueError` where J, `found` unless it is a constant one, is not skew, with the defect."""
    matrix, where = _matrix_of(J, found)
    if (skewness := _largest(matrix + matrix.T)) > STRUCTURE_DEFECT * max(_largest(matrix), TINY):
        raise ValueError(f"J is not skew{where}: max |J + Jᵀ| = {skewness:.3g}; put its symmetric part into R.")


def refuse_unless_dissipative(R: UserFunction, found: np.ndarray | None) -> None:
    """Raise `ValueError` where R, `found` unless it is a constant one, is not symmetric positive semidefinite, with the defect;
    of a sparse one what follows from its symmetry and its diagonal, row by row."""
    matrix, where = _matrix_of(R, found)
    scale = max(_largest(matrix), TINY)
    if (defect := _largest(matrix - matrix.T)) > STRUCTURE_DEFECT * scale:
        raise ValueError(f"R is not symmetric{where}: max |R − Rᵀ| = {defect:.3g}.")
    sparse = isinstance(R, ConstantFunction)
    lowest = matrix.diagonal().min() if sparse else np.linalg.eigvalsh(matrix)[0]
    if lowest < -STRUCTURE_DEFECT * scale:
        what = f"it has {lowest:.3g} on its diagonal" if sparse else f"its lowest eigenvalue is {lowest:.3g}"
        raise ValueError(f"R is not positive semidefinite{where}: {what}; dissipation must not create energy.")


def _matrix_of(function: UserFunction, found: np.ndarray | None) -> tuple[Any, str]:
    """The matrix, one of SciPy where it is sparse, and where this is, in words."""
    if isinstance(function, ConstantFunction):
        return function(None).matrix, ""
    return found, " at the initial point"


def _largest(matrix: Any) -> float:
    return abs(matrix).max() if matrix.size else 0.0
