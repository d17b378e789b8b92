"""Retractions τ: 𝔤 → G of a Lie group, their trivialized tangents, and the coadjoint action, on body momenta."""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.geometry.lie_group import AbstractLieGroup, Algebra
from dirax.geometry.lie_groups import cross, quarter_turn
from dirax.geometry.manifolds import Vector
from dirax.program.tracing import gradient

RETRACTIONS = ("exp", "cayley")


def retraction(group: AbstractLieGroup, name: str) -> Callable[[Algebra], Vector]:
    """τ(ζ) for "exp" or "cayley"; both have τ(−ζ) = τ(ζ)⁻¹. Raises `ValueError` for another name."""
    if name not in RETRACTIONS:
        raise ValueError(f"map must be {' or '.join(map(repr, RETRACTIONS))}, but {name!r} was given.")
    return group.group_exp if name == "exp" else lambda zeta: cayley(group, zeta)


def cayley(group: AbstractLieGroup, zeta: Algebra) -> Vector:
    """cay(ζ) = (1 − ζ/2)⁻¹(1 + ζ/2) of matrices, homogeneous ones for rigid motions: a rotation by 2 arctan(|ω|/2)."""
    velocity, omega = zeta[: group.translations], zeta[group.translations :]
    size = 1.0 + jnp.sum(omega * omega) / 4.0
    if omega.shape[0] == 1:
        rotation, turned = jnp.concatenate([2.0 - size[None], omega]) / size, quarter_turn
        shift = lambda: (velocity + omega / 2.0 * turned(velocity)) / size
    else:
        rotation = jnp.concatenate([jnp.ones(1), omega / 2.0]) / jnp.sqrt(size)
        shift = lambda: (velocity + cross(omega, velocity) / 2.0 + omega * jnp.sum(omega * velocity) / 4.0) / size
    return jnp.concatenate([rotation, shift()]) if group.translations else rotation


def rotate(group: AbstractLieGroup, g: Vector, vector: Float[Array, " k"]) -> Float[Array, " k"]:
    """The rotation of g applied to a vector of the plane (2,) or of space (3,)."""
    rotation, _ = group._split(g)
    if rotation.shape[0] == 2:
        return group._product(rotation, vector)
    # unlike r v r*, this is wrong by |sin|² of the error of |r| only, which adds up over many small steps
    twice = 2.0 * cross(rotation[1:], vector)
    return vector + rotation[0] * twice + cross(rotation[1:], twice)


def coadjoint(group: AbstractLieGroup, g: Vector, momentum: Algebra) -> Algebra:
    """Ad*_g μ, with ⟨Ad*_g μ, η⟩ = ⟨μ, Ad_g η⟩: the body momentum at g of the spatial momentum μ."""
    k = group.translations
    back = group._join(group._conjugate(group._split(g)[0]), lambda: g[-k:])
    shift, linear, angular = g[g.shape[0] - k :], momentum[:k], momentum[k:]
    if k:
        moment = cross(linear, shift) if k == 3 else (linear[0:1] * shift[1:2] - linear[1:2] * shift[0:1])
        angular = angular + moment
    if angular.shape[0] == 3:
        angular = rotate(group, back, angular)
    return jnp.concatenate([rotate(group, back, linear), angular]) if k else angular


def pulled_back(group: AbstractLieGroup, tau: Callable, zeta: Algebra, momentum: Algebra) -> Algebra:
    """(dτ_ζ)*μ for the right-trivialized tangent dτ_ζ(δ) = (Dτ(ζ)·δ) τ(ζ)⁻¹, whose inverse it spares."""
    f = tau(zeta)
    body = coadjoint(group, f, momentum)
    # to_algebra(f, ·) is linear, so that this is the derivative of one number
    return gradient(lambda near: body @ group.to_algebra(f, tau(near)))(zeta)
