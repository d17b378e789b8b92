"""Linear equations of a few unknowns: with one solution, and with the smallest of many."""

import math
from collections.abc import Callable
from types import ModuleType
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import ShapedArray
from jax.interpreters import ad, batching
from jaxtyping import Array, Float

from dirax.numerics.equilibration import balancing_scales, geometric_scales
from dirax.numerics.ranks import numerical_rank
from dirax.numerics.tolerances import EQUATION_RANK
from dirax.program.primitives import binds, each, plain_primitive

SURELY_REGULAR = 1e6
"""Condition number, by the largest sums of rows, up to which no singular value of a matrix may count as zero."""

LARGE = 128
"""Rows from which on XLA looks for that, too: singular values of 2000 rows take 4 s, and an inverse .4 s."""


def solve(matrix: Float[Array, "n n"], right: Array, apart: bool = False) -> Array:
    """`jnp.linalg.solve` of a matrix (n, n) and a right-hand side (n,) or (n, k).

    `apart`: the graph may differentiate the elimination itself, which it does quickly however deep derivatives lie in one
    another; else a derivative is another solve.
    """
    if not binds(matrix, right):
        return jnp.linalg.solve(matrix, right)
    return solve_p.bind(matrix, right, apart=apart)[0]


def pseudo_inverse(matrix: Float[Array, "k l"], tolerance: float) -> Float[Array, "l k"]:
    """`jnp.linalg.pinv`; singular values below `tolerance`, relative to the largest, count as zero."""
    if not binds(matrix):
        return jnp.linalg.pinv(matrix, tolerance)
    return pseudo_inverse_p.bind(matrix, tolerance=tolerance)[0]


def scaled_pseudo_inverse(matrix: Float[Array, "k l"]) -> Float[Array, "l k"]:
    """The pseudo-inverse of a matrix with rows and columns scaled to unit size."""
    return scaled_inverse(matrix)[0]


def scaled_inverse(
    matrix: Float[Array, "k l"], tolerance: float = EQUATION_RANK
) -> tuple[Float[Array, "l k"], Float[Array, " l"]]:
    """The same, with singular values below `tolerance` counting as zero, and the units of the unknowns that the scales stand
    for."""
    if not binds(matrix):
        return equilibrated_inverse(jnp, matrix, tolerance)
    inverse, units = scaled_inverse_p.bind(matrix, tolerance=tolerance)
    return inverse, units


def equilibrated_inverse(xp: ModuleType, matrix: Any, tolerance: float = EQUATION_RANK) -> tuple[Any, Any]:
    """The same by JAX, or by NumPy with leading axes."""
    sizes = xp.abs(lax.stop_gradient(matrix) if xp is jnp else matrix)  # units have no derivative, which would be ∞ at zero
    rows, columns = balancing_scales(sizes, xp)
    scaled = matrix / rows / columns
    inverse = _of_one(scaled, tolerance) if xp is jnp else pseudo_inverses(scaled, tolerance, _by_either_scale)
    turned = lambda a: xp.swapaxes(a, -1, -2)
    return inverse / turned(columns) / turned(rows), 1.0 / columns[..., 0, :]


def _of_one(matrix: Array, tolerance: float) -> Array:
    """The pseudo-inverse of one matrix by JAX: of a large square one as `pseudo_inverses` has it."""
    k, l = matrix.shape
    if k != l or k < LARGE:
        return jnp.linalg.pinv(matrix, tolerance)
    inverse = jnp.linalg.inv(matrix)
    regular = _largest_sum(jnp, matrix) * _largest_sum(jnp, inverse) <= SURELY_REGULAR
    return lax.cond(regular, lambda: inverse, lambda: jnp.linalg.pinv(matrix, tolerance))


def pseudo_inverses(matrices: np.ndarray, tolerance: float, of_doubtful: Callable = np.linalg.pinv) -> np.ndarray:
    """Pseudo-inverses in NumPy with leading axes; singular values below `tolerance`, relative to the largest, count as zero.

    Where surely none does, they are found without them, which is much faster; the others by `of_doubtful(matrices, tolerance)`.
    """
    flat = matrices.reshape(math.prod(matrices.shape[:-2]), *matrices.shape[-2:])
    with np.errstate(all="ignore"):
        sizes = _largest_sum(np, flat)
        unit = sizes[:, None, None]
        found = _of_full_rank(flat / unit) / unit  # no square overflows, or is lost
        doubtful = ~(sizes * _largest_sum(np, found) <= SURELY_REGULAR)
    if np.any(doubtful):
        found[doubtful] = of_doubtful(flat[doubtful], tolerance)
    return found.reshape(*matrices.shape[:-2], *found.shape[1:])


def _largest_sum(xp: ModuleType, matrices: Any) -> Any:
    """Of the sizes of the entries of a row, with leading axes."""
    return xp.max(xp.sum(xp.abs(matrices), axis=-1), axis=-1, initial=0.0)


def _by_either_scale(matrices: np.ndarray, tolerance: float) -> np.ndarray:
    """Those of matrices (B, k, l), divided by geometric means where these have more rank, or both have all: largest entries
    cannot balance a saddle point with small masses, and geometric means raise the roundoff of zero."""
    found, least = np.linalg.pinv(matrices, tolerance), min(matrices.shape[1:])
    rank = lambda a: numerical_rank(np.linalg.svd(a, compute_uv=False), tolerance)
    for i, own in enumerate(rank(matrices).tolist()):
        rows, columns = geometric_scales(np.abs(matrices[i]))
        balanced = matrices[i] / rows / columns
        if rank(balanced) > own or own == least == rank(balanced):
            found[i] = np.linalg.pinv(balanced, tolerance) / columns.T / rows.T
    return found


def _of_full_rank(matrices: np.ndarray) -> np.ndarray:
    """The pseudo-inverses of matrices (B, k, l) of full rank, (B, l, k); of others something that is large or not finite."""
    *_, k, l = matrices.shape
    if k > l:
        return np.swapaxes(_of_full_rank(np.swapaxes(matrices, 1, 2)), 1, 2)
    if k == l:
        try:
            return np.linalg.inv(matrices)
        except np.linalg.LinAlgError:  # one of them is singular
            return np.full(matrices.shape, np.inf)
    return np.swapaxes(_rows_inverted(matrices), 1, 2)


def _rows_inverted(matrices: np.ndarray) -> np.ndarray:
    """(W⁺)ᵀ of matrices W (B, k, l) with independent rows, from W = RQ with R triangular, the rows of Q orthonormal: by
    Gram and Schmidt for all of them side by side, each row twice, after which Q is orthonormal to roundoff."""
    q, r = np.array(matrices, order="C"), np.zeros((*matrices.shape[:2], matrices.shape[1]))
    combined = lambda factors, rows: (factors[:, None] @ rows)[:, 0]
    for i in range(matrices.shape[1]):
        for _ in range(2):
            along = combined(q[:, i], np.swapaxes(q[:, :i], 1, 2))
            q[:, i] -= combined(along, q[:, :i])
            r[:, i, :i] += along
        r[:, i, i] = np.sqrt(np.einsum("bl,bl->b", q[:, i], q[:, i]))
        q[:, i] /= r[:, i, i, None]
    for i in reversed(range(matrices.shape[1])):
        q[:, i] -= combined(r[:, i + 1 :, i], q[:, i + 1 :])
        q[:, i] /= r[:, i, i, None]
    return q


def _turned(matrix, **_):
    return [ShapedArray(matrix.shape[::-1], matrix.dtype)]


def _solve_tangents(primals, tangents, **p):
    """x' = A⁻¹ (b' − A' x), by the same elimination."""
    (matrix, right), (along_matrix, along_right) = primals, map(ad.instantiate_zeros, tangents)
    (x,) = solve_p.bind(matrix, right, **p)
    return [x], solve_p.bind(matrix, along_right - along_matrix @ x, **p)


def _solve_transposed(along, matrix, right, **p):
    return [None, solve_p.bind(jnp.swapaxes(matrix, -1, -2), along[0], **p)[0]]


def _solve_batched(operands, axes, **p):
    """Right-hand sides side by side for one matrix; else each group of equations by itself."""
    (matrix, right), (of_matrix, of_right) = operands, axes
    if of_matrix is not None:
        return each(_solve_by_jax, operands, axes, **p)
    columns = jnp.moveaxis(right, of_right, -1)
    (found,) = solve_p.bind(matrix, columns.reshape(len(columns), -1), **p)
    return [jnp.moveaxis(found.reshape(columns.shape), -1, 0)], [0]


def _solve_by_jax(matrix, right, **_):
    return [jnp.linalg.solve(matrix, right)]


solve_p = plain_primitive("dirax_solve", _solve_by_jax, lambda a, b, **_: [ShapedArray(b.shape, b.dtype)])
ad.primitive_jvps[solve_p] = _solve_tangents
ad.primitive_transposes[solve_p] = _solve_transposed
batching.primitive_batchers[solve_p] = _solve_batched
pseudo_inverse_p = plain_primitive(
    "dirax_pseudo_inverse",
    lambda matrix, tolerance: [jnp.linalg.pinv(matrix, tolerance)],
    _turned,
)
scaled_inverse_p = plain_primitive(
    "dirax_scaled_inverse",
    lambda matrix, tolerance: list(equilibrated_inverse(jnp, matrix, tolerance)),
    lambda matrix, **_: [*_turned(matrix), ShapedArray(matrix.shape[1:], matrix.dtype)],
)
