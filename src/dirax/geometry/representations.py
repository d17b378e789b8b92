"""The representations of a linear Dirac structure, each as a kernel pair.

A kernel pair (F, E) stands for {(v, α) : F v + E α = 0}. Every function here takes the matrices of one representation,
checks them where they can be looked at, and returns a pair that depends smoothly on them as long as their rank does not
change: arithmetic only, no singular value decomposition, so that integrators may evaluate it inside a residual.

Conventions: ω[i, j] = ω(e_i, e_j), so ω♭v = ωᵀv; Λ[i, j] = Λ(dxⁱ, dxʲ), so Λ♯α = Λα. A basis is given by its columns,
one-forms by their rows.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import ArrayLike, Float

from dirax.geometry.subspaces import (
    AnyArray,
    as_matrix,
    matrix_transpose,
    namespace,
    require_full_rank,
)
from dirax.numerics.ranks import decide_rank
from dirax.numerics.tolerances import STRUCTURE_DEFECT
from dirax.program.user_functions import is_traced

ROUNDOFF = 1e-14  # a product of matrices of order one that should vanish has entries of this size

KernelPair = tuple[Float[AnyArray, "*batch n n"], Float[AnyArray, "*batch n n"]]


def two_form_pair(two_form: ArrayLike) -> KernelPair:
    """D_ω = {(v, ω♭v)} ([BLM] Example 2.2.2)."""
    two_form = skew("two_form", two_form)
    return matrix_transpose(two_form), -_identity_like(two_form)


def bivector_pair(bivector: ArrayLike) -> KernelPair:
    """D_Λ = {(Λ♯α, α)} ([BLM] Example 2.2.3)."""
    bivector = skew("bivector", bivector)
    return _identity_like(bivector), -bivector


def subspace_pair(basis: ArrayLike) -> KernelPair:
    """D_F = F ⊕ F° for F spanned by the columns of `basis` ([BLM] Example 2.2.1)."""
    basis = as_matrix("basis", basis)
    require_full_rank("basis", basis)
    return _distribution_pair(_projector(matrix_transpose(basis)), None)


def subspace_and_form_pair(basis: ArrayLike, two_form: ArrayLike) -> KernelPair:
    """D_{F,ω} = {(v, α) : v ∈ F, α − ω♭v ∈ F°}; only ω on F matters ([BLM] Proposition 2.3)."""
    basis, two_form = as_matrix("basis", basis), skew("two_form", two_form)
    _require_same_space("basis", basis.shape[-2], "two_form", two_form)
    require_full_rank("basis", basis)
    return _distribution_pair(_projector(matrix_transpose(basis)), two_form)


def annihilator_pair(one_forms: ArrayLike, two_form: ArrayLike | None = None) -> KernelPair:
    """D_{Δ,ω} for Δ the kernel of the rows of `one_forms`; ω = 0 by default, which is Δ ⊕ Δ° ([PY] (24))."""
    one_forms = as_matrix("one_forms", one_forms)
    require_full_rank("the transpose of one_forms", matrix_transpose(one_forms))
    if two_form is not None:
        two_form = skew("two_form", two_form)
        _require_same_space("one_forms", one_forms.shape[-1], "two_form", two_form)
    onto_annihilator = _projector(one_forms)
    return _distribution_pair(_identity_like(onto_annihilator) - onto_annihilator, two_form)


def codistribution_and_bivector_pair(basis: ArrayLike, bivector: ArrayLike) -> KernelPair:
    """D_{Λ,F*} = {(v, α) : α ∈ F*, β(v) = Λ(β, α) for β ∈ F*}; only Λ on F* matters ([BLM] Theorem 2.5)."""
    basis, bivector = as_matrix("basis", basis), skew("bivector", bivector)
    _require_same_space("basis", basis.shape[-2], "bivector", bivector)
    require_full_rank("basis", basis)
    onto = _projector(matrix_transpose(basis))
    return onto, _identity_like(onto) - onto - onto @ bivector


def kernel_pair(F: ArrayLike, E: ArrayLike) -> KernelPair:
    """D = {(v, α) : F v + E α = 0}, Dirac iff E Fᵀ + F Eᵀ = 0 and rank [F E] = n."""
    F, E = _square("F", F), _square("E", E)
    if F.shape[-1] != E.shape[-1]:
        raise ValueError(f"F has shape {F.shape} and E {E.shape}; both must be (..., n, n).")
    _require_isotropic("The kernel pair (F, E)", "E Fᵀ + F Eᵀ", F, E)
    return F, E


def image_pair(A: ArrayLike, B: ArrayLike) -> KernelPair:
    """D = {(A s, B s) : s ∈ R^n}, Dirac iff AᵀB + BᵀA = 0 and rank [A; B] = n."""
    A, B = _square("A", A), _square("B", B)
    if A.shape[-1] != B.shape[-1]:
        raise ValueError(f"A has shape {A.shape} and B {B.shape}; both must be (..., n, n).")
    # D = D^⊥ = {(w, β) : Bᵀw + Aᵀβ = 0}.
    F, E = matrix_transpose(B), matrix_transpose(A)
    _require_isotropic("The image pair (A, B)", "AᵀB + BᵀA", F, E)
    return F, E


KERNEL_PAIRS: dict[str, Callable[..., KernelPair]] = {
    "two_form": two_form_pair,
    "bivector": bivector_pair,
    "subspace": subspace_pair,
    "subspace_and_form": subspace_and_form_pair,
    "annihilator": annihilator_pair,
    "codistribution_and_bivector": codistribution_and_bivector_pair,
    "kernel": kernel_pair,
    "image": image_pair,
}
"""Kernel pair of each representation, by the name that follows `from_` in the constructors."""


def _distribution_pair(onto: Float[AnyArray, "*batch n n"], two_form: Float[AnyArray, "*batch n n"] | None) -> KernelPair:
    # The ranges of P and I − P are complementary, so the n equations (I − P) v + P (ω♭v − α) = 0 say both at once.
    F = _identity_like(onto) - onto
    return (F if two_form is None else F + onto @ matrix_transpose(two_form)), -onto


def _projector(rows: Float[AnyArray, "*batch k n"]) -> Float[AnyArray, "*batch n n"]:
    """Orthogonal projector onto the span of independent rows, by Gram–Schmidt with one reorthogonalisation.

    Written out in elementary operations: it is smooth in the rows, and cheap inside a compiled step.
    """
    n = rows.shape[-1]
    projector = np.zeros((*rows.shape[:-2], n, n))
    for i in range(rows.shape[-2]):
        row = rows[..., i, :]
        for _ in range(2):
            row = row - (projector @ row[..., None])[..., 0]
        unit = row / (row**2).sum(axis=-1, keepdims=True)
        projector = projector + row[..., :, None] * unit[..., None, :]
    return projector


def _identity_like(matrix: Float[AnyArray, "*batch n n"]) -> Float[AnyArray, "*batch n n"]:
    return namespace(matrix).broadcast_to(np.eye(matrix.shape[-1]), matrix.shape)


def _square(name: str, value: ArrayLike) -> Float[AnyArray, "*batch n n"]:
    matrix = as_matrix(name, value)
    if matrix.shape[-1] != matrix.shape[-2]:
        raise ValueError(f"{name} has shape {matrix.shape}; a square matrix (..., n, n) was expected.")
    return matrix


def skew(name: str, value: ArrayLike) -> Float[AnyArray, "*batch n n"]:
    """A matrix as an array. Raises `ValueError` for one that is not skew, with the defect."""
    matrix = _square(name, value)
    if not is_traced(matrix):
        defect = np.max(np.abs(matrix + matrix_transpose(matrix)), axis=(-1, -2), initial=0.0)
        size = np.max(np.abs(matrix), axis=(-1, -2), initial=0.0)
        if np.any(defect > STRUCTURE_DEFECT * size + ROUNDOFF):
            raise ValueError(
                f"{name} is not skew: max |M + Mᵀ| = {np.max(defect):.3e} for entries up to {np.max(size):.3e}. "
                f"Use (M − Mᵀ)/2 if its skew part is meant."
            )
    return matrix


def _require_same_space(name: str, dimension: int, other_name: str, other: Float[AnyArray, "*batch n n"]) -> None:
    if dimension != other.shape[-1]:
        raise ValueError(
            f"{name} lies in dimension {dimension} but {other_name} has shape {other.shape}; "
            "a basis is given by its columns, one-forms by their rows."
        )


def _require_isotropic(who: str, product: str, F: Float[AnyArray, "*batch n n"], E: Float[AnyArray, "*batch n n"]) -> None:
    """Raise unless the rows of [F E] span a Dirac structure, with the defect of an orthonormal basis of these rows."""
    if is_traced(F, E):
        return
    n = F.shape[-1]
    rows = np.concatenate(np.broadcast_arrays(F, E), axis=-1)
    lengths = np.linalg.norm(rows, axis=-1, keepdims=True)
    _, values, basis = np.linalg.svd(rows / np.where(lengths > 0, lengths, 1.0), full_matrices=False)
    rank = decide_rank(values, who)
    if np.any(rank < n):
        raise ValueError(
            f"{who} has rank {np.min(rank)}, not n = {n} (smallest singular value {values.min():.3e} of its normalised "
            "rows), so it does not describe a subspace of dimension n."
        )
    if n == 0:
        return
    pairing = basis[..., :n] @ np.swapaxes(basis[..., n:], -1, -2)
    defect = np.max(np.abs(pairing + np.swapaxes(pairing, -1, -2)), axis=(-1, -2))
    # The entries are only known to roundoff, which a nearly dependent basis magnifies.
    allowed = STRUCTURE_DEFECT + 100 * np.finfo(float).eps / values[..., -1]
    if np.any(defect > allowed):
        raise ValueError(
            f"{who} is not isotropic: {product} is not zero, max pairing {np.max(defect):.3e} on an orthonormal basis."
        )
