"""What proofs of theorems are measured with: largest numbers, derivatives by complex steps."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

COMPLEX_STEP = 1e-30
"""A complex step so small that the imaginary part of f(x + iε d)/ε is the derivative of an analytic f, to roundoff."""


def largest(values: Any) -> float:
    """The largest absolute value; infinity where one is not a number."""
    size = np.abs(np.asarray(values, dtype=float))
    return float(np.max(size, initial=0.0)) if np.all(np.isfinite(size)) else np.inf


def derivative(function: Callable, x: np.ndarray, direction: np.ndarray) -> Any:
    """The derivative of an analytic function of NumPy's along a direction, by a complex step."""
    return np.imag(function(np.asarray(x) + 1j * COMPLEX_STEP * np.asarray(direction))) / COMPLEX_STEP


def gradient(function: Callable, x: np.ndarray) -> np.ndarray:
    """The derivatives along all coordinates, the last axis of the result."""
    return np.stack([derivative(function, x, direction) for direction in np.eye(np.size(x))], axis=-1)


def kernel(matrix: np.ndarray) -> np.ndarray:
    """An orthonormal basis, by columns, of the kernel of a matrix of full row rank."""
    return np.linalg.svd(matrix)[2][matrix.shape[0] :].T


def projector(basis: Sequence[Any] | np.ndarray) -> np.ndarray:
    """The orthogonal projector onto the span of independent columns, by which subspaces are compared."""
    basis = np.asarray(basis)
    return basis @ np.linalg.pinv(basis)
