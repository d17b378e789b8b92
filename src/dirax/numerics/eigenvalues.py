"""Eigenvalues of matrices with an error, of which several may be one."""

import numpy as np
import scipy.linalg
import scipy.sparse.csgraph

from dirax.numerics.tolerances import TINY

RANK = 1e-9
"""Singular values, relative to the largest one, that count as zero."""


def is_defective(matrix: np.ndarray, value: complex, error: float) -> bool:
    """Whether (A − λ)² has more zeros than A − λ, whose entries may be off by `error`."""
    once = matrix - value * np.eye(len(matrix))
    sizes, squares = (np.linalg.svd(power, compute_uv=False) for power in (once, once @ once))
    cut = max(RANK, len(matrix) * error / max(sizes[0], TINY))
    return bool(np.sum(squares <= cut * sizes[0] ** 2) > np.sum(sizes <= cut * sizes[0]))


def with_errors(matrix: np.ndarray, error: float) -> tuple[np.ndarray, np.ndarray]:
    """The eigenvalues of a matrix, and by how much each may be off where its entries are by `error`: at most by what four that
    are one with one eigenvector are."""
    if not len(matrix):
        return np.zeros(0, complex), np.zeros(0)
    values, left, right = scipy.linalg.eig(matrix, left=True)
    size = np.abs(matrix).max()
    with np.errstate(divide="ignore"):
        errors = error / np.abs(np.sum(left.conj() * right, axis=0))
    return values, np.minimum(errors, size * (error / size) ** 0.25 if size > 0.0 else 0.0)


def clusters(values: np.ndarray, errors: np.ndarray) -> list[np.ndarray]:
    """The numbers of eigenvalues that may be one."""
    near = np.abs(values[:, None] - values) <= np.minimum(errors[:, None], errors)
    labels = scipy.sparse.csgraph.connected_components(near, directed=False)[1]
    return [np.flatnonzero(labels == label) for label in np.unique(labels)]
