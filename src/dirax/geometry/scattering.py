"""Matrices of the scattering representation: from equations to the orthogonal matrix, with and without internal ports."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dirax.geometry.representations import KernelPair
from dirax.geometry.subspaces import (
    AnyArray,
    matrix_transpose,
    namespace,
    pseudo_inverse,
    uniform_rank,
)
from dirax.numerics.ranks import UndecidableRank, decide_rank
from dirax.program.user_functions import is_traced


def block_diagonal(first: Float[AnyArray, "*#batch i j"], second: Float[AnyArray, "*#batch k l"]) -> Float[AnyArray, "*all m n"]:
    """[[first, 0], [0, second]] over broadcast leading axes."""
    upper = np.zeros((*first.shape[:-1], second.shape[-1]))
    lower = np.zeros((*second.shape[:-1], first.shape[-1]))
    xp = namespace(first, second)
    return rows(xp.concatenate([first, upper], axis=-1), xp.concatenate([lower, second], axis=-1))


def scattering_matrix(pair: KernelPair) -> Float[AnyArray, "*batch n n"]:
    """The orthogonal matrix O of D = {F v + E α = 0}, smooth in the pair."""
    # With v = (s + d)/2 and α = (s − d)/2 this reads (F + E) s = (E − F) d; on a Dirac structure F + E has the singular
    # values of [F E], so it is as well conditioned as the pair itself.
    F, E = pair
    return nearest_orthogonal(namespace(F, E).linalg.solve(F + E, E - F))


def nearest_orthogonal(matrix: Float[AnyArray, "*batch n n"]) -> Float[AnyArray, "*batch n n"]:
    """The orthogonal polar factor of a matrix that is orthogonal up to roundoff."""
    # Two Newton–Schulz steps for the polar factor: a defect of roundoff size, magnified by an ill-conditioned solve, is
    # removed (ε → ε⁴), and a matrix far from orthogonal stays so and can be told by is_dirac().
    for _ in range(2):
        matrix = 1.5 * matrix - 0.5 * matrix @ (matrix_transpose(matrix) @ matrix)
    return matrix


def eliminate(
    F: Float[AnyArray, "*#batch m n"],
    E: Float[AnyArray, "*#batch m n"],
    internal: Float[AnyArray, "*#batch m l"],
    what: str,
    tolerance: float,
) -> Float[AnyArray, "*all n n"]:
    """The scattering matrix of {(v, α) : F v + E α + G z = 0 for some z}, from m = n + l equations with G = `internal`.

    With v = (s + d)/2 and α = (s − d)/2 the unknowns are the wave s and z. The wave is unique for every d even where z
    is not: d = 0 makes v = α, and no power through the internal ports makes ⟨α, v⟩ = 0. So a least-squares solution of
    low rank gives the case that is not transversal as well. Roundoff is divided by its smallest nonzero singular value.
    """
    xp, n = namespace(F, E, internal), F.shape[-1]
    batch = np.broadcast_shapes(F.shape[:-2], E.shape[:-2], internal.shape[:-2])
    blocks = [xp.broadcast_to(block, (*batch, *block.shape[-2:])) for block in (F + E, internal)]
    matrix = xp.concatenate(blocks, axis=-1)
    if not is_traced(matrix):
        _require_decided(matrix, blocks[1], what, tolerance)
    scattering = (pseudo_inverse(matrix, tolerance) @ (E - F))[..., :n, :]
    return nearest_orthogonal(scattering)


def _require_decided(matrix: np.ndarray, internal: np.ndarray, what: str, tolerance: float) -> None:
    """Raise where the elimination is closer to a degenerate one than roundoff lets us see.

    The kernel of G and that of the whole matrix are the same space of (0, z) ∈ D. Next to a degenerate case the singular
    values of G measure the angle, those of the matrix possibly its square, so they may disagree.
    """
    values = np.linalg.svd(matrix, compute_uv=False)
    scale = values.max(axis=-1, keepdims=True, initial=0.0)
    values, angles = values / scale, np.linalg.svd(internal, compute_uv=False) / scale
    nullity = values.shape[-1] - decide_rank(values, what, tolerance, scale=1.0)
    hidden = nullity != angles.shape[-1] - decide_rank(angles, what, tolerance, scale=1.0)
    if np.any(hidden):
        raise UndecidableRank(
            f"The rank of {what} is undecidable: a relative singular value of {values[hidden].min():.1e} counts as zero at "
            f"the tolerance {tolerance:.0e}, but comes from an angle of {angles[hidden].min():.1e}, which does not."
        )


def rows(upper: Float[AnyArray, "*#batch i k"], lower: Float[AnyArray, "*#batch j k"]) -> Float[AnyArray, "*all m k"]:
    """[upper; lower] over broadcast leading axes."""
    xp = namespace(upper, lower)
    batch = np.broadcast_shapes(upper.shape[:-2], lower.shape[:-2])
    return xp.concatenate([xp.broadcast_to(part, (*batch, *part.shape[-2:])) for part in (upper, lower)], axis=-2)


def range_basis(
    matrix: Float[AnyArray, "*batch n n"], what: str, rank: int | None, tolerance: float
) -> Float[Array, "*batch n k"]:
    """An orthonormal basis of the range, of the given rank or the one decided; `ValueError` if traced without a rank."""
    left, values, _ = namespace(matrix).linalg.svd(matrix)
    if rank is None:
        if is_traced(matrix):
            raise ValueError(f"The dimension of {what} must be given as `rank` under jit, vmap or grad.")
        rank = uniform_rank(decide_rank(values, what, tolerance, scale=1.0), what)
    return jnp.asarray(left[..., :rank])


def inverse_on_range(matrix: Float[AnyArray, "*batch n n"], what: str, tolerance: float) -> Float[AnyArray, "*batch n n"]:
    """The pseudo-inverse, where the rank is decidable; raises `UndecidableRank` where it is not. `what` names the matrix."""
    if not is_traced(matrix):
        decide_rank(np.linalg.svd(matrix, compute_uv=False), what, tolerance, scale=1.0)
    return pseudo_inverse(matrix, tolerance, 1.0)
