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

from dirax.functions import is_traced
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
from dirax.geometry.subspaces import (
    RANK_TOLERANCE,
    STRUCTURE_TOLERANCE,
    PontryaginSubspace,
    UndecidableRank,
    as_matrix,
    decide_rank,
    matrix_transpose,
    pseudo_inverse,
    uniform_rank,
)


class LinearDirac(eqx.Module):
    """A linear Dirac structure D = D^⊥ ⊂ V ⊕ V* on V = R^n ([BLM] Definition 2.1), or a batch of them.

    `scattering` (..., n, n) is the orthogonal matrix O with D = {(v, α) : v + α = O (v − α)}; leading axes are a batch.
    Use the constructors `from_…`; they work under jit, vmap and grad, where checks of values are skipped.

    Ranks are decided on singular values relative to the unit length of an orthonormal basis of D (to the largest one in
    `pull_back`, `push_forward` and `compose`): below `tolerance` (1e-10 by default) they are zero, and one within a
    factor 100 of `tolerance` raises `UndecidableRank`, naming the values. Under tracing there is only the threshold.
    So state two-forms, bivectors and maps in units that make their entries of order one.

        D = LinearDirac.from_two_form([[0.0, 1.0], [-1.0, 0.0]])
        D.contains([1.0, 2.0], [-2.0, 1.0])  # (−ṗ, q̇) for (q̇, ṗ) = (1, 2): True
    """

    scattering: Float[Array, "*batch n n"]

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

    def kernel(self) -> tuple[Float[Array, "*batch n n"], Float[Array, "*batch n n"]]:
        """(F, E) with D = {F v + E α = 0} and F Fᵀ + E Eᵀ = I."""
        identity = jnp.eye(self.n)
        return (identity - self.scattering) / 2, (identity + self.scattering) / 2

    def image(self) -> tuple[Float[Array, "*batch n n"], Float[Array, "*batch n n"]]:
        """(A, B) with D = {(A s, B s)} and AᵀA + BᵀB = I."""
        identity = jnp.eye(self.n)
        return (self.scattering + identity) / 2, (self.scattering - identity) / 2

    def subspace(self) -> PontryaginSubspace:
        """D as a subspace of V ⊕ V*."""
        return PontryaginSubspace(jnp.concatenate(self.image(), axis=-2))

    def distribution(self, rank: int | None = None, tolerance: float = RANK_TOLERANCE) -> Float[Array, "*batch n k"]:
        """Orthonormal basis, by columns, of F_D, the projection of D on V ([BLM] Proposition 2.3).

        Raises `UndecidableRank` where k is unclear, ValueError where it varies over the batch; with `rank` given it is
        not asked for, as is necessary under tracing.
        """
        return _range_basis(self.image()[0], "the projection of D on V", rank, tolerance)

    def two_form(self, tolerance: float = RANK_TOLERANCE) -> Float[Array, "*batch n n"]:
        """ω_D, the two-form on F_D given by ω_D(u, v) = α(v) for (u, α) ∈ D ([BLM] Proposition 2.3).

        Returned on all of V, extended by zero on the Euclidean complement of F_D; with
        `distribution()` it determines D. Raises `UndecidableRank` where the dimension of F_D is unclear.
        """
        A, B = self.image()
        return matrix_transpose(B @ _inverse_on_range(A, "the projection of D on V", tolerance))

    def codistribution(self, rank: int | None = None, tolerance: float = RANK_TOLERANCE) -> Float[Array, "*batch n k"]:
        """Orthonormal basis, by columns, of F*_D, the projection of D on V* ([BLM] Theorem 2.5).

        Raises as `distribution` does.
        """
        return _range_basis(self.image()[1], "the projection of D on V*", rank, tolerance)

    def bivector(self, tolerance: float = RANK_TOLERANCE) -> Float[Array, "*batch n n"]:
        """Λ_D on F*_D, given by Λ_D(β, α) = β(v) for (v, α) ∈ D ([BLM] Theorem 2.5).

        Returned on all of V*, extended by zero on the Euclidean complement; with
        `codistribution()` it determines D. Raises `UndecidableRank` where the dimension of F*_D is unclear.
        """
        A, B = self.image()
        return A @ _inverse_on_range(B, "the projection of D on V*", tolerance)

    # Tests

    def contains(self, v: ArrayLike, covector: ArrayLike, tolerance: float = STRUCTURE_TOLERANCE) -> Bool[Array, "*batch"]:
        """Whether (v, α) ∈ D: its distance from D is at most `tolerance` times its length; v and α (..., n)."""
        v, covector = jnp.asarray(v, dtype=float), jnp.asarray(covector, dtype=float)
        if v.shape[-1:] != (self.n,) or covector.shape[-1:] != (self.n,):
            raise ValueError(f"v has shape {v.shape} and covector {covector.shape}; both must be (..., {self.n}).")
        F, E = self.kernel()
        distance = jnp.linalg.norm(jnp.einsum("...ij,...j", F, v) + jnp.einsum("...ij,...j", E, covector), axis=-1)
        return distance <= tolerance * jnp.sqrt(jnp.sum(v**2, axis=-1) + jnp.sum(covector**2, axis=-1))

    def orthogonal(self) -> "LinearDirac":
        """D^⊥ with respect to the pairing; it is D itself when D is Dirac ([BLM] Definition 2.1)."""
        # ⟨s, O d⟩ = ⟨d', d⟩ for all d says d' = Oᵀ s.
        return LinearDirac(jnp.linalg.inv(matrix_transpose(self.scattering)))

    def isotropy_defect(self) -> Float[Array, "*batch"]:
        """Largest pairing between two members of the basis `image()`, max |AᵀB + BᵀA|."""
        A, B = self.image()
        product = matrix_transpose(A) @ B
        return jnp.max(jnp.abs(product + matrix_transpose(product)), axis=(-1, -2), initial=0.0)

    def is_isotropic(self, tolerance: float = STRUCTURE_TOLERANCE) -> Bool[Array, "*batch"]:
        """Whether D ⊆ D^⊥."""
        return self.isotropy_defect() <= tolerance

    def is_coisotropic(self, tolerance: float = STRUCTURE_TOLERANCE) -> Bool[Array, "*batch"]:
        """Whether D^⊥ ⊆ D."""
        return self.orthogonal().is_isotropic(tolerance)

    def is_dirac(self, tolerance: float = STRUCTURE_TOLERANCE) -> Bool[Array, "*batch"]:
        """Whether D = D^⊥ ([BLM] Definition 2.1); False where unchecked input under tracing was not Dirac."""
        return self.is_isotropic(tolerance) & self.is_coisotropic(tolerance)

    def distance(self, other: "LinearDirac") -> Float[Array, "*batch"]:
        """Sine of the largest angle between the two subspaces, in [0, 1]."""
        return jnp.linalg.norm(self.scattering - other.scattering, ord=2, axis=(-2, -1)) / 2

    def equals(self, other: "LinearDirac", tolerance: float = STRUCTURE_TOLERANCE) -> Bool[Array, "*batch"]:
        """Whether both are the same subspace, up to a distance of `tolerance`."""
        return self.distance(other) <= tolerance

    # New structures from old ones

    def direct_sum(self, other: "LinearDirac") -> "LinearDirac":
        """D ⊕ D' on V ⊕ V', coordinates of V first."""
        return LinearDirac(block_diagonal(self.scattering, other.scattering))

    def pull_back(self, linear_map: ArrayLike, tolerance: float = RANK_TOLERANCE) -> "LinearDirac":
        """φ*D = {(w, φᵀβ) : (φ w, β) ∈ D} on W, for φ: W → V given as a matrix (..., n, dim W), of any rank.

        φ should be scaled to entries of order one. Raises `UndecidableRank` where the result hangs on roundoff.
        """
        phi = self._map_matrix(linear_map, axis=-2)
        F, E = self.kernel()
        # F φ w + E β = 0, α − φᵀβ = 0.
        width = phi.shape[-1]
        vectors = _rows(F @ phi, jnp.zeros((width, width)))
        covectors = _rows(jnp.zeros((self.n, width)), jnp.eye(width))
        return _eliminate(vectors, covectors, _rows(E, -matrix_transpose(phi)), "the pull-back", tolerance)

    def push_forward(self, linear_map: ArrayLike, tolerance: float = RANK_TOLERANCE) -> "LinearDirac":
        """φ_*D = {(φ v, β) : (v, φᵀβ) ∈ D} on W, for φ: V → W given as a matrix (..., dim W, n), of any rank.

        φ should be scaled to entries of order one. Raises `UndecidableRank` where the result hangs on roundoff.
        """
        phi = self._map_matrix(linear_map, axis=-1)
        F, E = self.kernel()
        # F v + E φᵀβ = 0, w − φ v = 0.
        height = phi.shape[-2]
        vectors = _rows(jnp.zeros((self.n, height)), jnp.eye(height))
        covectors = _rows(E @ matrix_transpose(phi), jnp.zeros((height, height)))
        return _eliminate(vectors, covectors, _rows(F, -phi), "the push-forward", tolerance)

    def compose(
        self,
        other: "LinearDirac",
        ports: Sequence[int],
        other_ports: Sequence[int] | None = None,
        common: Literal["covectors", "vectors"] = "covectors",
        tolerance: float = RANK_TOLERANCE,
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
        if common not in ("covectors", "vectors"):
            raise ValueError(f"common is {common!r}; 'covectors' or 'vectors' was expected.")
        F, E = self.direct_sum(other).kernel()
        first = np.array(ports, dtype=int)
        second = self.n + np.array(other_ports, dtype=int)
        kept = np.setdiff1d(np.arange(self.n + other.n), np.concatenate([first, second]))
        sign = -1.0 if common == "covectors" else 1.0
        internal = jnp.concatenate([F[..., first] + sign * F[..., second], E[..., first] - sign * E[..., second]], axis=-1)
        return _eliminate(F[..., kept], E[..., kept], internal, "the composition", tolerance)

    def _map_matrix(self, linear_map: ArrayLike, axis: int) -> Float[Array, "*batch i j"]:
        matrix = as_matrix("linear_map", linear_map)
        if matrix.shape[axis] != self.n:
            expected = f"(..., {self.n}, dim W)" if axis == -2 else f"(..., dim W, {self.n})"
            raise ValueError(f"linear_map has shape {matrix.shape}; {expected} was expected.")
        return matrix


def block_diagonal(first: Float[Array, "*batch i j"], second: Float[Array, "*batch k l"]) -> Float[Array, "*batch m n"]:
    """[[first, 0], [0, second]] over broadcast leading axes."""
    batch = jnp.broadcast_shapes(first.shape[:-2], second.shape[:-2])
    first = jnp.broadcast_to(first, (*batch, *first.shape[-2:]))
    second = jnp.broadcast_to(second, (*batch, *second.shape[-2:]))
    upper = jnp.zeros((*batch, first.shape[-2], second.shape[-1]))
    lower = jnp.zeros((*batch, second.shape[-2], first.shape[-1]))
    return jnp.concatenate([jnp.concatenate([first, upper], axis=-1), jnp.concatenate([lower, second], axis=-1)], axis=-2)


def scattering_matrix(pair: KernelPair) -> Float[Array, "*batch n n"]:
    """The orthogonal matrix O of D = {F v + E α = 0}, smooth in the pair."""
    # F v + E α = 0 with v = (s + d)/2 and α = (s − d)/2 reads (F + E) s = (E − F) d; on a Dirac structure F + E has the
    # singular values of [F E], so this is as well conditioned as the pair itself.
    F, E = pair
    return _nearest_orthogonal(jnp.linalg.solve(F + E, E - F))


def _nearest_orthogonal(matrix: Float[Array, "*batch n n"]) -> Float[Array, "*batch n n"]:
    # Two Newton–Schulz steps for the polar factor: a defect of roundoff size, magnified by an ill-conditioned solve, is
    # removed (ε → ε⁴), and a matrix far from orthogonal stays so and can be told by is_dirac().
    for _ in range(2):
        matrix = 1.5 * matrix - 0.5 * matrix @ (matrix_transpose(matrix) @ matrix)
    return matrix


def _eliminate(
    F: Float[Array, "*batch m n"],
    E: Float[Array, "*batch m n"],
    internal: Float[Array, "*batch m l"],
    what: str,
    tolerance: float,
) -> LinearDirac:
    """The Dirac structure {(v, α) : F v + E α + G z = 0 for some z}, with m = n + l equations.

    The wave s is unique for every d even where z is not: d = 0 makes v = α, and a structure without power through its
    internal ports has ⟨α, v⟩ = 0. So a least-squares solution of low rank gives the non-transversal case as well.
    """
    n = F.shape[-1]
    batch = jnp.broadcast_shapes(F.shape[:-2], E.shape[:-2], internal.shape[:-2])
    internal = jnp.broadcast_to(internal, (*batch, *internal.shape[-2:]))
    waves = jnp.broadcast_to(F + E, (*batch, *F.shape[-2:]))
    matrix = jnp.concatenate([waves, internal], axis=-1)
    if not is_traced(matrix):
        decide_rank(np.linalg.svd(np.asarray(matrix), compute_uv=False), what, tolerance)
    scattering = (pseudo_inverse(matrix, tolerance) @ (E - F))[..., :n, :]
    if not is_traced(scattering) and n:
        product = np.swapaxes(scattering, -1, -2) @ np.asarray(scattering)
        defect = np.max(np.abs(product - np.eye(n)))
        if defect > np.sqrt(STRUCTURE_TOLERANCE):
            raise UndecidableRank(
                f"The rank of {what} is undecidable: dropping singular values below {tolerance:.0e} leaves a defect of "
                f"{defect:.3e} in D = D^⊥. Rescale the map to entries of order one, or give another tolerance."
            )
    return LinearDirac(_nearest_orthogonal(scattering))


def _rows(upper: Float[Array, "*batch i k"], lower: Float[Array, "*batch j k"]) -> Float[Array, "*batch m k"]:
    batch = jnp.broadcast_shapes(upper.shape[:-2], lower.shape[:-2])
    return jnp.concatenate([jnp.broadcast_to(part, (*batch, *part.shape[-2:])) for part in (upper, lower)], axis=-2)


def _range_basis(matrix: Float[Array, "*batch n n"], what: str, rank: int | None, tolerance: float) -> Float[Array, "*batch n k"]:
    left, values, _ = jnp.linalg.svd(matrix)
    if rank is None:
        if is_traced(matrix):
            raise ValueError(f"The dimension of {what} must be given as `rank` under jit, vmap or grad.")
        rank = uniform_rank(decide_rank(np.asarray(values), what, tolerance, scale=1.0), what)
    return left[..., :rank]


def _inverse_on_range(matrix: Float[Array, "*batch n n"], what: str, tolerance: float) -> Float[Array, "*batch n n"]:
    if not is_traced(matrix):
        decide_rank(np.linalg.svd(np.asarray(matrix), compute_uv=False), what, tolerance, scale=1.0)
    return pseudo_inverse(matrix, tolerance, 1.0)


def _port_list(name: str, ports: Sequence[int], n: int) -> list[int]:
    ports = [int(port) for port in ports]
    if len(set(ports)) != len(ports) or any(not 0 <= port < n for port in ports):
        raise ValueError(f"{name} is {ports}; distinct coordinates in 0, …, {n - 1} were expected.")
    return ports
