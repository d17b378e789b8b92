"""Subspaces of V ⊕ V* and the decision what rank a floating-point matrix has.

The pairing on V ⊕ V* is ⟪(v, α), (w, β)⟫ = ⟨α, w⟩ + ⟨β, v⟩ ([BLM] §2.1). A subspace U is isotropic, coisotropic or
Dirac according to how it lies in its orthogonal U^⊥; `LinearDirac` (linear.py) holds the Dirac case.
"""

from typing import TYPE_CHECKING, Any, TypeAlias

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from dirax.numerics.ranks import decide_rank
from dirax.numerics.tolerances import STRUCTURE_DEFECT, STRUCTURE_RANK
from dirax.program.given_tangents import with_tangent
from dirax.program.user_functions import is_traced

if TYPE_CHECKING:
    AnyArray: TypeAlias = Array | np.ndarray
else:
    AnyArray = Array | np.ndarray | np.generic  # a number from which NumPy took the axes is an array without any
"""Numbers that are known (numpy) or traced (JAX)."""


def known(array: Any) -> Any:
    """The numbers of an array as a numpy array where there are any, the array itself under tracing.

    What is known is computed with numpy, so that nothing is compiled for one structure of one dimension; the same code
    is traced by jit, vmap and grad.
    """
    return array if is_traced(array) else np.asarray(array)


def namespace(*arrays: Any) -> Any:
    """`jax.numpy` if any array is traced, else numpy."""
    return jnp if is_traced(*arrays) else np


def as_matrix(name: str, value: ArrayLike) -> Float[AnyArray, "*batch rows columns"]:
    """`value` as a float64 array with at least two axes and, where it can be looked at, finite entries."""
    matrix = known(value)
    if np.issubdtype(matrix.dtype, np.complexfloating):
        raise TypeError(f"{name} is complex; linear Dirac structures here are over the reals.")
    matrix = matrix.astype(float)
    if matrix.ndim < 2:
        raise ValueError(f"{name} has shape {matrix.shape}; a matrix with shape (..., rows, columns) was expected.")
    if not is_traced(matrix) and not np.all(np.isfinite(matrix)):
        raise ValueError(f"{name} has entries that are not finite.")
    return matrix


def matrix_transpose(matrix: Float[AnyArray, "*batch i j"]) -> Float[AnyArray, "*batch j i"]:
    """The transpose of the last two axes."""
    return matrix.swapaxes(-1, -2)


def pairing_defect(A: Float[AnyArray, "*batch n k"], B: Float[AnyArray, "*batch n k"]) -> Float[AnyArray, "*batch"]:
    """Largest pairing between two columns of [A; B], max |AᵀB + BᵀA|."""
    product = matrix_transpose(A) @ B
    return abs(product + matrix_transpose(product)).max(axis=(-1, -2), initial=0.0)


def require_full_rank(name: str, matrix: Float[AnyArray, "*batch rows columns"]) -> None:
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


def pseudo_inverse(
    matrix: Float[AnyArray, "*batch i j"], tolerance: float = STRUCTURE_RANK, scale: float | None = None
) -> Float[AnyArray, "*batch j i"]:
    """Moore–Penrose inverse with singular values up to `tolerance * scale` (largest one by default) taken as zero.

    Differentiable, under the assumption that the rank does not change.
    """
    if not is_traced(matrix):
        return _invert(np, matrix, tolerance, scale)
    return with_tangent(lambda matrix: _invert(jnp, matrix, tolerance, scale), _pseudo_inverse_tangent, matrix)


def _invert(xp, matrix, tolerance, scale):
    left, values, right = xp.linalg.svd(matrix, full_matrices=False)
    reference = values.max(axis=-1, keepdims=True, initial=0.0) if scale is None else scale
    kept = values > tolerance * reference
    inverse = xp.where(kept, 1.0 / xp.where(kept, values, 1.0), 0.0)
    return matrix_transpose(left * inverse[..., None, :] @ right)


def _pseudo_inverse_tangent(inverse, operands, along):
    """Golub and Pereyra (1973), constant rank."""
    (matrix,), (tangent,) = operands, along
    inverse_t, tangent_t = matrix_transpose(inverse), matrix_transpose(tangent)
    within = -inverse @ tangent @ inverse
    off_range = inverse @ inverse_t @ tangent_t @ (np.eye(matrix.shape[-2]) - matrix @ inverse)
    off_corange = (np.eye(matrix.shape[-1]) - inverse @ matrix) @ tangent_t @ inverse_t @ inverse
    return within + off_range + off_corange


class PontryaginSubspace(eqx.Module):
    """A linear subspace U of V ⊕ V* of any dimension k, held by an orthonormal basis of columns (v; α).

    The open port-Hamiltonian set of [BLM] (22) is one that is coisotropic without being Dirac.
    """

    basis: Float[Array, "*batch two_n k"] = eqx.field(converter=jnp.asarray)

    @classmethod
    def from_image(cls, A: ArrayLike, B: ArrayLike, tolerance: float = STRUCTURE_RANK) -> "PontryaginSubspace":
        """U = {(A s, B s) : s ∈ R^k}; A and B (..., n, k). Dependent columns are dropped.

        Raises `UndecidableRank` where the rank of [A; B] is unclear at the relative SVD `tolerance`. Under tracing the
        columns are taken to be independent.
        """
        A, B = as_matrix("A", A), as_matrix("B", B)
        if A.shape != B.shape:
            raise ValueError(f"A has shape {A.shape} and B {B.shape}; both must be (..., n, k).")
        stacked = namespace(A, B).concatenate([A, B], axis=-2)
        if is_traced(stacked):
            return cls(jnp.linalg.qr(stacked)[0])
        left, values, _ = np.linalg.svd(stacked, full_matrices=False)
        return cls(left[..., : uniform_rank(decide_rank(values, "[A; B]", tolerance), "[A; B]")])

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
        A, B = self._halves()
        return jnp.asarray(A), jnp.asarray(B)

    def _halves(self) -> tuple[Float[AnyArray, "*batch n k"], Float[AnyArray, "*batch n k"]]:
        basis = known(self.basis)
        return basis[..., : self.n, :], basis[..., self.n :, :]

    def contains(self, v: ArrayLike, covector: ArrayLike, tolerance: float = STRUCTURE_DEFECT) -> Bool[AnyArray, "*batch"]:
        """Whether the distance of (v, α) from U is at most `tolerance` times its length."""
        vector, one_form, basis = known(v).astype(float), known(covector).astype(float), known(self.basis)
        element = namespace(vector, one_form).concatenate([vector, one_form], axis=-1)[..., None]
        residual = element - basis @ (matrix_transpose(basis) @ element)
        return (residual**2).sum(axis=(-1, -2)) ** 0.5 <= tolerance * (element**2).sum(axis=(-1, -2)) ** 0.5

    def orthogonal(self) -> "PontryaginSubspace":
        """U^⊥ with respect to the pairing, of dimension 2n − k ([BLM] §2.1)."""
        A, B = self._halves()
        xp = namespace(A)
        # ⟪(v, α), (w, β)⟫ is the Euclidean product of (α, v) with (w, β).
        left, _, _ = xp.linalg.svd(xp.concatenate([B, A], axis=-2), full_matrices=True)
        return PontryaginSubspace(left[..., self.dimension :])

    def isotropy_defect(self) -> Float[AnyArray, "*batch"]:
        """Largest pairing between two members of the orthonormal basis, max |AᵀB + BᵀA|."""
        return pairing_defect(*self._halves())

    def is_isotropic(self, tolerance: float = STRUCTURE_DEFECT) -> Bool[AnyArray, "*batch"]:
        """Whether U ⊆ U^⊥ ([BLM] §2.1)."""
        return self.isotropy_defect() <= tolerance

    def is_coisotropic(self, tolerance: float = STRUCTURE_DEFECT) -> Bool[AnyArray, "*batch"]:
        """Whether U^⊥ ⊆ U ([BLM] §2.1), which is U^⊥ being isotropic, for U^⊥⊥ = U."""
        return self.orthogonal().is_isotropic(tolerance)

    def is_dirac(self, tolerance: float = STRUCTURE_DEFECT) -> Bool[AnyArray, "*batch"]:
        """Whether U = U^⊥: isotropic and of dimension n ([BLM] Definition 2.1)."""
        return self.is_isotropic(tolerance) & (self.dimension == self.n)


def uniform_rank(ranks: Int[AnyArray, "*batch"], what: str) -> int:
    """The one rank of a whole batch; raises where it differs between members."""
    distinct = np.unique(ranks)
    if distinct.size > 1:
        raise ValueError(f"The rank of {what} varies over the batch ({distinct.tolist()}); take its members one by one.")
    return int(distinct[0]) if distinct.size else 0
