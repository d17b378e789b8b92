"""The rank of a matrix in floating point: how many singular values are not zero."""

from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import ArrayLike

from dirax.numerics.equilibration import equilibrated, geometric_scales
from dirax.numerics.tolerances import EQUATION_RANK, RANK_GAP, RANK_ROUNDOFF, STRUCTURE_RANK, TINY


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
    if np.any(low := ranks < matrices.shape[2]):  # largest entries cannot balance a saddle point with small masses
        rows, columns = geometric_scales(np.abs(matrices[low]))
        ranks[low] = np.maximum(ranks[low], numerical_rank(np.linalg.svd(matrices[low] / rows / columns)[1], tolerance))
    directions /= np.max(np.abs(directions), axis=1, keepdims=True)
    return ranks, directions


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
