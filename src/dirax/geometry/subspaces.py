"""Subspaces of V ⊕ V* and the decision what rank a floating-point matrix has.

The pairing on V ⊕ V* is ⟪(v, α), (w, β)⟫ = ⟨α, w⟩ + ⟨β, v⟩ ([BLM] §2.1). A subspace U is isotropic, coisotropic or
Dirac according to how it lies in its orthogonal U^⊥; `LinearDirac` (linear.py) holds the Dirac case.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from dirax.functions import is_traced

RANK_TOLERANCE = 1e-10
"""Singular values below this fraction of the scale of a matrix count as zero."""
RANK_GAP = 100.0
"""A singular value within this factor of the tolerance, on either side, leaves the rank undecided."""
STRUCTURE_TOLERANCE = 1e-10
"""Largest relative defect (of skewness, of isotropy, of membership) that counts as roundoff."""


class UndecidableRank(ValueError):
    """The singular values of a matrix do not separate into zero and nonzero ones."""


def as_matrix(name: str, value: ArrayLike) -> Float[Array, "*batch rows columns"]:
    """`value` as a float64 array with at least two axes and, where it can be looked at, finite entries."""
    if not is_traced(value) and np.iscomplexobj(np.asarray(value)):
        raise TypeError(f"{name} is complex; linear Dirac structures here are over the reals.")
    matrix = jnp.asarray(value, dtype=float)
    if matrix.ndim < 2:
        raise ValueError(f"{name} has shape {matrix.shape}; a matrix with shape (..., rows, columns) was expected.")
    if not is_traced(matrix) and not np.all(np.isfinite(matrix)):
        raise ValueError(f"{name} has entries that are not finite.")
    return matrix


def matrix_transpose(matrix: Float[Array, "*batch i j"]) -> Float[Array, "*batch j i"]:
    """The transpose of the last two axes."""
    return jnp.swapaxes(matrix, -1, -2)


def decide_rank(
    singular_values: np.ndarray, what: str, tolerance: float = RANK_TOLERANCE, scale: float | None = None
) -> np.ndarray:
    """Number of singular values above `tolerance * scale`, along the last axis; `scale` is the largest one by default.

    Raises `UndecidableRank` where a singular value lies within a factor `RANK_GAP` of that threshold.
    """
    values = np.asarray(singular_values)
    if values.shape[-1] == 0:
        return np.zeros(values.shape[:-1], dtype=int)
    reference = values.max(axis=-1, keepdims=True) if scale is None else np.full_like(values[..., :1], scale)
    relative = values / np.where(reference > 0, reference, 1.0)
    undecided = np.any((relative > tolerance / RANK_GAP) & (relative < tolerance * RANK_GAP), axis=-1)
    if np.any(undecided):
        worst = relative[undecided].reshape(-1, values.shape[-1])[0]
        raise UndecidableRank(
            f"The rank of {what} is undecidable: relative singular values {np.array2string(worst, precision=3)} have "
            f"no gap around the tolerance {tolerance:.0e}. Give a tolerance that is {RANK_GAP:.0f} times away from them."
        )
    return np.sum(relative > tolerance, axis=-1)


def require_full_rank(name: str, matrix: Float[Array, "*batch rows columns"]) -> None:
    """Raise unless the columns, each divided by its length, are linearly independent; nothing under tracing."""
    if is_traced(matrix):
        return
    columns, rows = matrix.shape[-1], matrix.shape[-2]
    if columns > rows:
        raise ValueError(
            f"{name} has {columns} columns in a space of dimension {rows}, so they cannot be independent; "
            f"a basis is given by its columns, shape ({rows}, k) with k ≤ {rows}. Is it transposed?"
        )
    lengths = np.linalg.norm(matrix, axis=-2, keepdims=True)
    singular_values = np.linalg.svd(np.asarray(matrix) / np.where(lengths > 0, lengths, 1.0), compute_uv=False)
    rank = decide_rank(singular_values, name)
    if np.any(rank < columns):
        raise ValueError(
            f"{name} has rank {np.min(rank)}, not {columns}: the smallest singular value of its normalised columns is "
            f"{singular_values.min():.3e}. Leave out the dependent columns."
        )


@partial(jax.custom_jvp, nondiff_argnums=(1, 2))
def pseudo_inverse(
    matrix: Float[Array, "*batch i j"], tolerance: float = RANK_TOLERANCE, scale: float | None = None
) -> Float[Array, "*batch j i"]:
    """Moore–Penrose inverse with singular values up to `tolerance * scale` (largest one by default) taken as zero.

    Differentiable, under the assumption that the rank does not change.
    """
    left, values, right = jnp.linalg.svd(matrix, full_matrices=False)
    reference = jnp.max(values, axis=-1, keepdims=True, initial=0.0) if scale is None else scale
    kept = values > tolerance * reference
    inverse = jnp.where(kept, 1.0 / jnp.where(kept, values, 1.0), 0.0)
    return matrix_transpose(left * inverse[..., None, :] @ right)


@pseudo_inverse.defjvp
def _pseudo_inverse_jvp(tolerance: float, scale: float | None, primals, tangents):
    # Golub and Pereyra (1973), constant rank.
    (matrix,), (tangent,) = primals, tangents
    inverse = pseudo_inverse(matrix, tolerance, scale)
    inverse_t, tangent_t = matrix_transpose(inverse), matrix_transpose(tangent)
    off_range = jnp.eye(matrix.shape[-2]) - matrix @ inverse
    off_corange = jnp.eye(matrix.shape[-1]) - inverse @ matrix
    return inverse, (
        -inverse @ tangent @ inverse + inverse @ inverse_t @ tangent_t @ off_range + off_corange @ tangent_t @ inverse_t @ inverse
    )


class PontryaginSubspace(eqx.Module):
    """A linear subspace U of V ⊕ V* of any dimension k, held by an orthonormal basis of columns (v; α).

    The open port-Hamiltonian set of [BLM] (22) is one that is coisotropic without being Dirac.
    """

    basis: Float[Array, "*batch 2*n k"]

    @classmethod
    def from_image(cls, A: ArrayLike, B: ArrayLike, tolerance: float = RANK_TOLERANCE) -> "PontryaginSubspace":
        """U = {(A s, B s) : s ∈ R^k}; A and B (..., n, k). Dependent columns are dropped.

        Raises `UndecidableRank` where the rank of [A; B] is unclear at the relative SVD `tolerance`. Under tracing the
        columns are taken to be independent.
        """
        A, B = as_matrix("A", A), as_matrix("B", B)
        if A.shape != B.shape:
            raise ValueError(f"A has shape {A.shape} and B {B.shape}; both must be (..., n, k).")
        stacked = jnp.concatenate([A, B], axis=-2)
        if is_traced(stacked):
            return cls(jnp.linalg.qr(stacked)[0])
        left, values, _ = jnp.linalg.svd(stacked, full_matrices=False)
        return cls(left[..., : uniform_rank(decide_rank(np.asarray(values), "[A; B]", tolerance), "[A; B]")])

    @property
    def n(self) -> int:
        """Dimension of V."""
        return self.basis.shape[-2] // 2

    @property
    def dimension(self) -> int:
        """Dimension of U."""
        return self.basis.shape[-1]

    def image(self) -> tuple[Float[Array, "*batch n k"], Float[Array, "*batch n k"]]:
        """(A, B) with U = {(A s, B s)} and AᵀA + BᵀB = I."""
        return self.basis[..., : self.n, :], self.basis[..., self.n :, :]

    def contains(self, v: ArrayLike, covector: ArrayLike, tolerance: float = STRUCTURE_TOLERANCE) -> Bool[Array, "*batch"]:
        """Whether the distance of (v, α) from U is at most `tolerance` times its length."""
        element = jnp.concatenate([jnp.asarray(v, dtype=float), jnp.asarray(covector, dtype=float)], axis=-1)
        components = jnp.einsum("...ik,...i->...k", self.basis, element)
        residual = element - jnp.einsum("...ik,...k->...i", self.basis, components)
        return jnp.linalg.norm(residual, axis=-1) <= tolerance * jnp.linalg.norm(element, axis=-1)

    def orthogonal(self) -> "PontryaginSubspace":
        """U^⊥ with respect to the pairing, of dimension 2n − k ([BLM] §2.1)."""
        A, B = self.image()
        # ⟪(v, α), (w, β)⟫ is the Euclidean product of (α, v) with (w, β).
        left, _, _ = jnp.linalg.svd(jnp.concatenate([B, A], axis=-2), full_matrices=True)
        return PontryaginSubspace(left[..., self.dimension :])

    def isotropy_defect(self) -> Float[Array, "*batch"]:
        """Largest pairing between two elements of the orthonormal basis, max |AᵀB + BᵀA|."""
        A, B = self.image()
        product = matrix_transpose(A) @ B
        return jnp.max(jnp.abs(product + matrix_transpose(product)), axis=(-1, -2), initial=0.0)

    def is_isotropic(self, tolerance: float = STRUCTURE_TOLERANCE) -> Bool[Array, "*batch"]:
        """Whether U ⊆ U^⊥ ([BLM] §2.1)."""
        return self.isotropy_defect() <= tolerance

    def is_coisotropic(self, tolerance: float = STRUCTURE_TOLERANCE) -> Bool[Array, "*batch"]:
        """Whether U^⊥ ⊆ U ([BLM] §2.1), which is U^⊥ being isotropic, for U^⊥⊥ = U."""
        return self.orthogonal().is_isotropic(tolerance)

    def is_dirac(self, tolerance: float = STRUCTURE_TOLERANCE) -> Bool[Array, "*batch"]:
        """Whether U = U^⊥: isotropic and of dimension n ([BLM] Definition 2.1)."""
        return self.is_isotropic(tolerance) & (self.dimension == self.n)


def uniform_rank(ranks: np.ndarray, what: str) -> int:
    """The one rank of a whole batch; raises where it differs between members."""
    distinct = np.unique(ranks)
    if distinct.size > 1:
        raise ValueError(f"The rank of {what} varies over the batch ({distinct.tolist()}); take its members one by one.")
    return int(distinct[0]) if distinct.size else 0
