"""One Dirac structure on one vector space.

In the waves s = v + α and d = v − α the pairing of V ⊕ V* is half of ⟨s, s'⟩ − ⟨d, d'⟩, so that the Dirac structures on
V = R^n are exactly the graphs s = O d of the orthogonal matrices O (the scattering representation of Cervera, van der
Schaft and Baños, 2007). O is unique, depends smoothly on the structure whatever the rank of its projections, and needs
no choice of basis: it is what is stored, and everything else is read off from it.
"""

from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from dirax.geometry.representations import (
    KernelPair,
    annihilator_pair,
    bivector_pair,
    codistribution_and_bivector_pair,
    image_pair,
    kernel_pair,
    subspace_and_form_pair,
    subspace_pair,
    two_form_pair,
)
from dirax.geometry.scattering import block_diagonal, eliminate, inverse_on_range, range_basis, rows, scattering_matrix
from dirax.geometry.subspaces import (
    AnyArray,
    PontryaginSubspace,
    as_matrix,
    known,
    matrix_transpose,
    namespace,
    pairing_defect,
)
from dirax.numerics.tolerances import STRUCTURE_DEFECT, STRUCTURE_RANK, TRANSVERSALITY

COMMON = ("covectors", "vectors")
"""What may agree at ports that are joined."""


class LinearDirac(eqx.Module):
    """A linear Dirac structure D = D^⊥ ⊂ V ⊕ V* on V = R^n ([BLM] Definition 2.1), or a batch of them.

    `scattering` (..., n, n) is the orthogonal matrix O with D = {(v, α) : v + α = O (v − α)}; leading axes are a batch.
    Use the constructors `from_…`; they work under jit, vmap and grad, where checks of values are skipped.

    Ranks are decided on singular values relative to the unit length of an orthonormal basis of D: below `tolerance`
    (1e-10) they are zero, and one within a factor 100 of `tolerance` raises `UndecidableRank`, naming the values. In
    `pull_back`, `push_forward` and `compose` they are relative to the largest one and `tolerance` is 1e-12; roundoff is
    divided by the smallest nonzero one. Under tracing there is only the threshold.
    So state two-forms, bivectors and maps in units that make their entries of order one.

        D = LinearDirac.from_two_form([[0.0, 1.0], [-1.0, 0.0]])
        D.contains([1.0, 2.0], [-2.0, 1.0])  # (−ṗ, q̇) for (q̇, ṗ) = (1, 2): True
    """

    scattering: Float[Array, "*batch n n"] = eqx.field(converter=jnp.asarray)

    # Constructors

    @classmethod
    def from_two_form(cls, two_form: ArrayLike) -> "LinearDirac":
        """D_ω = {(v, ω♭v)}, ω (..., n, n) skew with ω[i, j] = ω(e_i, e_j), so ω♭v = ωᵀv ([BLM] Example 2.2.2).

        Raises ValueError, with the defect, where ω is not skew.
        """
        return cls(scattering_matrix(two_form_pair(two_form)))

    @classmethod
    def from_bivector(cls, bivector: ArrayLike) -> "LinearDirac":
        """D_Λ = {(Λ♯α, α)}, Λ (..., n, n) skew with Λ[i, j] = Λ(dxⁱ, dxʲ), so Λ♯α = Λα ([BLM] Example 2.2.3).

        Raises ValueError, with the defect, where Λ is not skew.
        """
        return cls(scattering_matrix(bivector_pair(bivector)))

    @classmethod
    def from_subspace(cls, basis: ArrayLike) -> "LinearDirac":
        """D_F = F ⊕ F°, F spanned by the columns of `basis` (..., n, k) ([BLM] Example 2.2.1).

        Raises ValueError, with the smallest singular value, where the columns are dependent.
        """
        return cls(scattering_matrix(subspace_pair(basis)))

    @classmethod
    def from_subspace_and_form(cls, basis: ArrayLike, two_form: ArrayLike) -> "LinearDirac":
        """D_{F,ω} = {(v, α) : v ∈ F, α(w) = ω(v, w) for w ∈ F} ([BLM] Proposition 2.3).

        F is spanned by the columns of `basis` (..., n, k); of ω (..., n, n) only the restriction to F matters.
        Raises ValueError where the columns are dependent or ω is not skew.
        """
        return cls(scattering_matrix(subspace_and_form_pair(basis, two_form)))

    @classmethod
    def from_annihilator(cls, one_forms: ArrayLike, two_form: ArrayLike | None = None) -> "LinearDirac":
        """D_{Δ,ω} for Δ = ker W, W = `one_forms` (..., m, n) by rows; ω (..., n, n) is zero by default ([PY] (24)).

        Raises ValueError where the one-forms are dependent or ω is not skew.
        """
        return cls(scattering_matrix(annihilator_pair(one_forms, two_form)))

    @classmethod
    def from_codistribution_and_bivector(cls, basis: ArrayLike, bivector: ArrayLike) -> "LinearDirac":
        """D_{Λ,F*} = {(v, α) : α ∈ F*, β(v) = Λ(β, α) for β ∈ F*} ([BLM] Theorem 2.5).

        F* is spanned by the columns of `basis` (..., n, k); of Λ (..., n, n) only the restriction to F* matters.
        Raises ValueError where the columns are dependent or Λ is not skew.
        """
        return cls(scattering_matrix(codistribution_and_bivector_pair(basis, bivector)))

    @classmethod
    def from_kernel(cls, F: ArrayLike, E: ArrayLike) -> "LinearDirac":
        """D = {(v, α) : F v + E α = 0}, with E Fᵀ + F Eᵀ = 0 and rank [F E] = n; F and E (..., n, n).

        Raises ValueError, with the defect, where the pair is not isotropic or the rank is below n.
        """
        return cls(scattering_matrix(kernel_pair(F, E)))

    @classmethod
    def from_image(cls, A: ArrayLike, B: ArrayLike) -> "LinearDirac":
        """D = {(A s, B s) : s ∈ R^n}, with AᵀB + BᵀA = 0 and rank [A; B] = n; A and B (..., n, n).

        Raises ValueError, with the defect, where the pair is not isotropic or the rank is below n.
        """
        return cls(scattering_matrix(image_pair(A, B)))

    # Representations

    @property
    def n(self) -> int:
        """Dimension of V."""
        return self.scattering.shape[-1]

    def kernel(self) -> KernelPair:
        """(F, E) with D = {F v + E α = 0} and F Fᵀ + E Eᵀ = I."""
        F, E = _kernel(self)
        return jnp.asarray(F), jnp.asarray(E)

    def image(self) -> tuple[Float[Array, "*batch n n"], Float[Array, "*batch n n"]]:
        """(A, B) with D = {(A s, B s)} and AᵀA + BᵀB = I."""
        A, B = _image(self)
        return jnp.asarray(A), jnp.asarray(B)

    def subspace(self) -> PontryaginSubspace:
        """D as a subspace of V ⊕ V*."""
        return PontryaginSubspace(namespace(self.scattering).concatenate(_image(self), axis=-2))

    def distribution(self, rank: int | None = None, tolerance: float = STRUCTURE_RANK) -> Float[Array, "*batch n k"]:
        """Orthonormal basis, by columns, of F_D, the projection of D on V ([BLM] Proposition 2.3).

        Raises `UndecidableRank` where k is unclear, ValueError where it varies over the batch; with `rank` given it is
        not asked for, as is necessary under tracing.
        """
        return range_basis(_image(self)[0], "the projection of D on V", rank, tolerance)

    def two_form(self, tolerance: float = STRUCTURE_RANK) -> Float[Array, "*batch n n"]:
        """ω_D, the two-form on F_D given by ω_D(u, v) = α(v) for (u, α) ∈ D ([BLM] Proposition 2.3).

        Returned on all of V, extended by zero on the Euclidean complement of F_D; `distribution()` and it
        determine D. Raises `UndecidableRank` where the dimension of F_D is unclear.
        """
        A, B = _image(self)
        flat = B @ inverse_on_range(A, "the projection of D on V", tolerance)
        return jnp.asarray((matrix_transpose(flat) - flat) / 2)

    def codistribution(self, rank: int | None = None, tolerance: float = STRUCTURE_RANK) -> Float[Array, "*batch n k"]:
        """Orthonormal basis, by columns, of F*_D, the projection of D on V* ([BLM] Theorem 2.5).

        Raises as `distribution` does.
        """
        return range_basis(_image(self)[1], "the projection of D on V*", rank, tolerance)

    def bivector(self, tolerance: float = STRUCTURE_RANK) -> Float[Array, "*batch n n"]:
        """Λ_D on F*_D, given by Λ_D(β, α) = β(v) for (v, α) ∈ D ([BLM] Theorem 2.5).

        Returned on all of V*, extended by zero on the Euclidean complement; `codistribution()` and it determine D.
        Raises `UndecidableRank` where the dimension of F*_D is unclear.
        """
        A, B = _image(self)
        sharp = A @ inverse_on_range(B, "the projection of D on V*", tolerance)
        return jnp.asarray((sharp - matrix_transpose(sharp)) / 2)

    # Tests

    def contains(self, v: ArrayLike, covector: ArrayLike, tolerance: float = STRUCTURE_DEFECT) -> Bool[AnyArray, "*batch"]:
        """Whether (v, α) ∈ D: its distance from D is at most `tolerance` times its length; v and α (..., n)."""
        vector, one_form = known(v).astype(float), known(covector).astype(float)
        if vector.shape[-1:] != (self.n,) or one_form.shape[-1:] != (self.n,):
            raise ValueError(f"v has shape {vector.shape} and covector {one_form.shape}; both must be (..., {self.n}).")
        F, E = _kernel(self)
        residual = (F @ vector[..., None] + E @ one_form[..., None])[..., 0]
        size = ((vector**2).sum(axis=-1) + (one_form**2).sum(axis=-1)) ** 0.5
        return (residual**2).sum(axis=-1) ** 0.5 <= tolerance * size

    def orthogonal(self) -> "LinearDirac":
        """D^⊥ with respect to the pairing; it is D itself when D is Dirac ([BLM] Definition 2.1)."""
        # ⟨s, O d⟩ = ⟨d', d⟩ for all d says d' = Oᵀ s.
        O = known(self.scattering)
        return LinearDirac(namespace(O).linalg.inv(matrix_transpose(O)))

    def isotropy_defect(self) -> Float[AnyArray, "*batch"]:
        """Largest pairing between two members of the basis `image()`, max |AᵀB + BᵀA|."""
        return pairing_defect(*_image(self))

    def is_isotropic(self, tolerance: float = STRUCTURE_DEFECT) -> Bool[AnyArray, "*batch"]:
        """Whether D ⊆ D^⊥."""
        return self.isotropy_defect() <= tolerance

    def is_coisotropic(self, tolerance: float = STRUCTURE_DEFECT) -> Bool[AnyArray, "*batch"]:
        """Whether D^⊥ ⊆ D."""
        return self.orthogonal().is_isotropic(tolerance)

    def is_dirac(self, tolerance: float = STRUCTURE_DEFECT) -> Bool[AnyArray, "*batch"]:
        """Whether D = D^⊥ ([BLM] Definition 2.1); False where unchecked input under tracing was not Dirac."""
        return self.is_isotropic(tolerance) & self.is_coisotropic(tolerance)

    def distance(self, other: "LinearDirac") -> Float[AnyArray, "*batch"]:
        """Sine of the largest angle between the two subspaces, in [0, 1]."""
        difference = known(self.scattering) - known(other.scattering)
        return namespace(difference).linalg.norm(difference, ord=2, axis=(-2, -1)) / 2

    def equals(self, other: "LinearDirac", tolerance: float = STRUCTURE_DEFECT) -> Bool[AnyArray, "*batch"]:
        """Whether both are the same subspace, up to a distance of `tolerance`."""
        return self.distance(other) <= tolerance

    # New structures from old ones

    def direct_sum(self, other: "LinearDirac") -> "LinearDirac":
        """D ⊕ D' on V ⊕ V', coordinates of V first."""
        return LinearDirac(block_diagonal(known(self.scattering), known(other.scattering)))

    def pull_back(self, linear_map: ArrayLike, tolerance: float = TRANSVERSALITY) -> "LinearDirac":
        """φ*D = {(w, φᵀβ) : (φ w, β) ∈ D} on W, for φ: W → V given as a matrix (..., n, dim W), of any rank.

        φ should be scaled to entries of order one. Raises `UndecidableRank` where the result hangs on roundoff.
        """
        phi = self._map_matrix(linear_map, axis=-2)
        F, E = _kernel(self)
        # F φ w + E β = 0 and α − φᵀβ = 0, β internal.
        width = phi.shape[-1]
        vectors = rows(F @ phi, np.zeros((width, width)))
        covectors = rows(np.zeros((self.n, width)), np.eye(width))
        return LinearDirac(eliminate(vectors, covectors, rows(E, -matrix_transpose(phi)), "the pull-back", tolerance))

    def push_forward(self, linear_map: ArrayLike, tolerance: float = TRANSVERSALITY) -> "LinearDirac":
        """φ_*D = {(φ v, β) : (v, φᵀβ) ∈ D} on W, for φ: V → W given as a matrix (..., dim W, n), of any rank.

        φ should be scaled to entries of order one. Raises `UndecidableRank` where the result hangs on roundoff.
        """
        phi = self._map_matrix(linear_map, axis=-1)
        F, E = _kernel(self)
        # F v + E φᵀβ = 0 and w − φ v = 0, v internal.
        height = phi.shape[-2]
        vectors = rows(np.zeros((self.n, height)), np.eye(height))
        covectors = rows(E @ matrix_transpose(phi), np.zeros((height, height)))
        return LinearDirac(eliminate(vectors, covectors, rows(F, -phi), "the push-forward", tolerance))

    def compose(
        self,
        other: "LinearDirac",
        ports: Sequence[int],
        other_ports: Sequence[int] | None = None,
        common: Literal["covectors", "vectors"] = "covectors",
        tolerance: float = TRANSVERSALITY,
    ) -> "LinearDirac":
        """Interconnection of two Dirac structures over shared ports, again a Dirac structure, transversal or not.

        `ports` are coordinates of V and `other_ports` (the same numbers by default) those of V' joined to them, in this
        order. There the covectors agree and the vectors sum to zero (a common effort), or the other way round for
        `common="vectors"`. The result lives on the remaining coordinates of V followed by those of V'.
        Raises `UndecidableRank` where the result hangs on roundoff.
        """
        ports = _port_list("ports", ports, self.n)
        other_ports = _port_list("other_ports", ports if other_ports is None else other_ports, other.n)
        if len(ports) != len(other_ports):
            raise ValueError(f"{len(ports)} ports cannot be joined to {len(other_ports)} other_ports.")
        if common not in COMMON:
            raise ValueError(f"common is {common!r}; 'covectors' or 'vectors' was expected.")
        F, E = _kernel(self.direct_sum(other))
        first = np.array(ports, dtype=int)
        second = self.n + np.array(other_ports, dtype=int)
        kept = np.setdiff1d(np.arange(self.n + other.n), np.concatenate([first, second]))
        sign = -1.0 if common == "covectors" else 1.0
        vectors = F[..., first] + sign * F[..., second]
        covectors = E[..., first] - sign * E[..., second]
        internal = namespace(F).concatenate([vectors, covectors], axis=-1)
        return LinearDirac(eliminate(F[..., kept], E[..., kept], internal, "the composition", tolerance))

    def _map_matrix(self, linear_map: ArrayLike, axis: int) -> Float[AnyArray, "*batch i j"]:
        matrix = as_matrix("linear_map", linear_map)
        if matrix.shape[axis] != self.n:
            expected = f"(..., {self.n}, dim W)" if axis == -2 else f"(..., dim W, {self.n})"
            raise ValueError(f"linear_map has shape {matrix.shape}; {expected} was expected.")
        return matrix


def _kernel(structure: LinearDirac) -> KernelPair:
    O, identity = known(structure.scattering), np.eye(structure.n)
    return (identity - O) / 2, (identity + O) / 2


def _image(structure: LinearDirac) -> tuple[Float[AnyArray, "*batch n n"], Float[AnyArray, "*batch n n"]]:
    O, identity = known(structure.scattering), np.eye(structure.n)
    return (O + identity) / 2, (O - identity) / 2


def _port_list(name: str, ports: Sequence[int], n: int) -> list[int]:
    ports = [int(port) for port in ports]
    if len(set(ports)) != len(ports) or any(not 0 <= port < n for port in ports):
        raise ValueError(f"{name} is {ports}; distinct coordinates in 0, …, {n - 1} were expected.")
    return ports
