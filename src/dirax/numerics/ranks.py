"""The rank of a matrix in floating point: how many singular values are not zero."""

import math
from collections.abc import Sequence
from contextlib import nullcontext
from operator import mul
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import ArrayLike

from dirax.numerics.equilibration import equilibrated, geometric_scales
from dirax.numerics.one_thread import one_thread
from dirax.numerics.tolerances import EQUATION_RANK, RANK_GAP, RANK_ROUNDOFF, STRUCTURE_RANK, TINY
from dirax.numerics.transversals import transversal_scales


class UndecidableRank(ValueError):
    """The singular values of a matrix do not separate into zero and nonzero ones."""


def significant(values: Any, tolerance: float, least: float = TINY, xp: ModuleType = np) -> Any:
    """Which of the values (…, k), none of them negative, are more than `tolerance` times the largest one, or times `least`
    where that is more: a boolean array of the same shape. `xp`: NumPy, or `jax.numpy` under tracing."""
    return values > tolerance * xp.maximum(values.max(axis=-1, keepdims=True, initial=0.0), least)


def numerical_rank(values: np.ndarray, tolerance: float, least: float = TINY) -> np.ndarray:
    """How many of the singular values (…, k) are `significant`: integers (…)."""
    return np.asarray(np.sum(significant(values, tolerance, least), axis=-1))


def rank_of_equations(matrices: np.ndarray, tolerance: float = EQUATION_RANK) -> tuple[np.ndarray, np.ndarray]:
    """The ranks (B,) of matrices (B, k, l) whose rows and columns have units of their own, and the directions (B, l) nearest
    to their kernels, with a largest entry of 1, in the units of the unknowns."""
    matrices = np.array(matrices, dtype=float)
    scaled, units = equilibrated(matrices)
    _, values, vt = np.linalg.svd(scaled)
    ranks = numerical_rank(values, tolerance)
    directions = vt[:, -1] * units[:, 0]
    for scales in (_geometric, _transversal):  # largest entries cannot balance a saddle point with small masses
        if np.any(low := ranks < matrices.shape[2]):
            balanced, _ = equilibrated(scales(matrices[low]))
            ranks[low] = np.maximum(ranks[low], numerical_rank(np.linalg.svd(balanced)[1], tolerance))
    directions /= np.max(np.abs(directions), axis=1, keepdims=True)
    return ranks, directions


def _geometric(matrices: np.ndarray) -> np.ndarray:
    rows, columns = geometric_scales(np.abs(matrices))
    return matrices / rows / columns


def _transversal(matrices: np.ndarray) -> np.ndarray:
    if matrices.shape[1] != matrices.shape[2]:
        return matrices
    each = [(matrix, *transversal_scales(matrix)) for matrix in matrices]
    return np.stack([matrix / rows / columns for matrix, rows, columns in each])


SURE = 1e8
"""Condition number up to which there is no doubt of a rank: four digits before EQUATION_RANK."""


SMALL = 8
"""Rows up to which a matrix is inverted in Python's floats: LAPACK is no quicker, and makes what comes after it slower by some
20 µs."""


ALONE = 64
"""Rows from which on BLAS would have several threads invert a matrix."""


def surely_independent(entries: Sequence[float], k: int, most: float = SURE) -> bool:
    """Whether the rows of a matrix (k, l), which someone has scaled, its entries row by row, are independent beyond doubt: the
    product of its norm and that of a right inverse, which is no less than its condition number, is below `most`. False also where
    it is not finite.

    The scaling of `rank_of_equations` is as good as any up to a factor √k (van der Sluis 1969), and its decision the same.
    """
    norm = sum(map(mul, entries, entries))
    if k == 1:
        return 0.0 < norm < math.inf
    if k * k == len(entries):
        return norm * _inverse_norm(entries, k) < most * most
    matrix = np.array(entries).reshape(k, -1)
    with np.errstate(all="ignore"):
        inverse_norm = _inverse_norm((matrix @ matrix.T).ravel().tolist(), k)
        # ‖Aᵀ(AAᵀ)⁻¹‖² ≤ √k ‖(AAᵀ)⁻¹‖, all by Frobenius' norm
        return bool(norm * math.sqrt(k * inverse_norm) < most * most)


def all_surely_independent(matrices: np.ndarray, most: float = SURE) -> bool:
    """The same of every one of the matrices (B, k, l)."""
    k = matrices.shape[1]
    with np.errstate(all="ignore"):
        norm = np.einsum("bkl,bkl->b", matrices, matrices)
        if k == 1:
            return bool(np.all((norm > 0.0) & (norm < math.inf)))
        square = k == matrices.shape[2]
        try:
            inverse_norm = _inverse_norms(matrices if square else matrices @ matrices.swapaxes(1, 2))
        except np.linalg.LinAlgError:
            return False
        condition = norm * inverse_norm if square else norm * np.sqrt(k * inverse_norm)
        return bool(np.all(condition < most * most))


def _inverse_norms(matrices: np.ndarray) -> np.ndarray:
    """The sums (B,) of the squares of the entries of the inverses."""
    if matrices.shape[1] == 2:
        (a, b), (c, d) = matrices.transpose(1, 2, 0)
        determinant = a * d - b * c
        return (a * a + b * b + c * c + d * d) / determinant / determinant
    inverses = np.linalg.inv(matrices)
    return np.einsum("bkl,bkl->b", inverses, inverses)


def _inverse_norm(entries: Sequence[float], k: int) -> float:
    """The sum of the squares of the entries of the inverse of a square matrix (k, k); infinite where it has none."""
    if k == 2:
        a, b, c, d = entries
        determinant = a * d - b * c
        return (a * a + b * b + c * c + d * d) / determinant / determinant if determinant else math.inf
    if k > SMALL:
        try:
            with one_thread() if k > ALONE else nullcontext():
                inverse = np.linalg.inv(np.array(entries).reshape(k, k))
        except np.linalg.LinAlgError:
            return math.inf
        return float(np.vdot(inverse, inverse))
    both = [[*entries[k * i : k * i + k], *[float(i == j) for j in range(k)]] for i in range(k)]
    for i in range(k):
        pivot = max(range(i, k), key=lambda j: abs(both[j][i]))
        both[i], both[pivot] = both[pivot], both[i]
        if not both[i][i]:
            return math.inf
        factor = 1.0 / both[i][i]
        both[i] = own = [x * factor for x in both[i]]
        for j in range(k):
            if j != i and (slope := both[j][i]):
                both[j] = [x - slope * y for x, y in zip(both[j], own, strict=True)]
    return sum([x * x for row in both for x in row[k:]])


def decide_rank(
    singular_values: ArrayLike, what: str, tolerance: float = STRUCTURE_RANK, scale: float | None = None
) -> np.ndarray:
    """Number of singular values above `tolerance * scale`, along the last axis; `scale` is the largest one by default.

    Raises `UndecidableRank` where a singular value lies within a factor `RANK_GAP` of that threshold, unless it is below
    `RANK_ROUNDOFF` and the threshold above it.
    """
    values = np.asarray(singular_values)
    if values.shape[-1] == 0:
        return np.zeros(values.shape[:-1], dtype=int)
    reference = values.max(axis=-1, keepdims=True) if scale is None else np.full_like(values[..., :1], scale)
    relative = values / np.where(reference > 0, reference, 1.0)
    surely_zero = max(tolerance / RANK_GAP, min(RANK_ROUNDOFF, tolerance))
    undecided = np.any((relative > surely_zero) & (relative < tolerance * RANK_GAP), axis=-1)
    if np.any(undecided):
        worst = relative[undecided].reshape(-1, values.shape[-1])[0]
        raise UndecidableRank(
            f"The rank of {what} is undecidable: relative singular values {np.array2string(worst, precision=3)} have "
            f"no gap around the tolerance {tolerance:.0e}. Give a tolerance that is {RANK_GAP:.0f} times away from them."
        )
    return np.asarray(np.sum(relative > tolerance, axis=-1))
