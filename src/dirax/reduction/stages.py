"""Reduction by stages: the quotient of a quotient is the quotient by the product of the groups."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dirax.geometry.lie_group import AbstractLieGroup
from dirax.geometry.lie_groups import SE2, SE3, SO2, SO3
from dirax.numerics.tolerances import STRUCTURE_DEFECT
from dirax.program.user_functions import evaluated
from dirax.reduction.connection import SAMPLES, AbstractConnection, LinearConnection
from dirax.reduction.euler_poincare import EulerPoincare
from dirax.reduction.left_invariant import reduced_by_left_translations
from dirax.reduction.reduced import ReducedLagrangeDirac

MOTIONS = {SO2: SE2, SO3: SE3}
"""The semidirect product of the translations with each group of rotations."""


def reduced_again(system: ReducedLagrangeDirac, second: Any, params: Any) -> ReducedLagrangeDirac | EulerPoincare:
    """The second stage of `dx.reduce`: by a connection on the shape space Σ of the first, or by a group of rotations that acts
    on it."""
    if isinstance(second, AbstractLieGroup):
        return _by_rotations(system, second, params)
    return ReducedLagrangeDirac(system.system, in_stages(system.connection, second))


def in_stages(first: AbstractConnection, second: AbstractConnection) -> AbstractConnection:
    """The connection for the product G₁ × G₂ of one on Q for G₁ and one on Σ₁ = Q/G₁ for G₂, whose fibre counts the shape
    coordinates of the first: horizontal is what both call horizontal.

    h⁰_d(y0, y1) = (h¹_d((y0, 0), (y1, h²_d(y0, y1))), h²_d(y0, y1)) for shapes y ∈ Σ₁/G₂, in the order (G₁, G₂). Raises
    `ValueError` for linear connections of sizes that do not belong together; for others `check` does, as soon as n is known.
    """
    if not (isinstance(first, LinearConnection) and isinstance(second, LinearConnection)):
        return StagedConnection(first, second)
    fibre, k = _joined_fibre(first, second), len(first.fibre)
    if first.horizontal is None and second.horizontal is None:
        return LinearConnection(fibre)
    if first.horizontal is not None:
        shapes = len(first.horizontal[0])
        second.check(shapes)
    else:
        assert second.horizontal is not None
        shapes = len(second.fibre) + len(second.horizontal[0])
    outer, inner = np.asarray(first.matrix(k + shapes)), np.asarray(second.matrix(shapes))
    rest = np.setdiff1d(np.arange(shapes), second.fibre)
    rows = outer[:, rest] + outer[:, list(second.fibre)] @ inner
    return LinearConnection(fibre, np.concatenate([rows, inner]))


def _joined_fibre(first: AbstractConnection, second: AbstractConnection) -> tuple[int, ...]:
    """The indices of q in the fibre of the first, then those of the second, which counts the others."""
    most = max(first.fibre) + max(second.fibre) + 2
    others = np.setdiff1d(np.arange(most), first.fibre)
    return (*first.fibre, *(int(others[i]) for i in second.fibre))


class StagedConnection(AbstractConnection):
    """The connection of `in_stages` where one of the two is not linear.

    `check` raises `ValueError` as those of both, and where h¹_d((y0, g0), (y1, g1)) changes with a translation of g0 and
    g1 by the same element of G₂: then G₂ does not act on what the first stage calls horizontal.
    """

    first: AbstractConnection
    second: AbstractConnection
    fibre: tuple[int, ...] = eqx.field(static=True)

    def __init__(self, first: AbstractConnection, second: AbstractConnection):
        self.first, self.second, self.fibre = first, second, _joined_fibre(first, second)

    def check(self, n: int, nearest: Callable | None = None) -> None:
        self.first.check(n)
        shapes, random = n - len(self.first.fibre), np.random.default_rng(0)
        self.second.check(shapes)
        with jax.ensure_compile_time_eval():
            for _ in range(SAMPLES):
                (x0, x1), move = random.normal(size=(2, shapes)), np.zeros(shapes)
                move[list(self.second.fibre)] = random.normal(size=len(self.second.fibre))
                lifts = (evaluated(self.first.lift_of_shapes, x0 + by, x1 + by) for by in (np.zeros(shapes), move))
                here, there = map(np.asarray, lifts)
                defect = float(np.max(np.abs(there - here)))
                if not defect <= STRUCTURE_DEFECT * (1.0 + float(np.max(np.abs(here)))):
                    raise ValueError(
                        "the second stage does not act on the connection of the first: its horizontal lift changes by "
                        f"{defect:.3g} under a translation of x[{list(self.second.fibre)}] at x0 = {x0}, "
                        f"x1 = {x1}; take a first connection that does not depend on them."
                    )

    def lift_of_shapes(self, x0: Float[Array, " n-k"], x1: Float[Array, " n-k"]) -> Float[Array, " k"]:
        along = self.second.lift_of_shapes(x0, x1)
        ends = self.second.join(x0, jnp.zeros_like(along)), self.second.join(x1, along)
        return jnp.concatenate([self.first.lift_of_shapes(*ends), along])

    def matrix_at(self, x: Float[Array, " n-k"]) -> Float[Array, "k n-k"]:
        return jax.jacfwd(self.lift_of_shapes, argnums=1)(x, x)

    def momentum_shift(self, x: Float[Array, " n-k"], mu: Float[Array, " k"]) -> Float[Array, " n-k"]:
        return jax.vjp(lambda x1: self.lift_of_shapes(x, x1), x)[1](mu)[0]


def _by_rotations(system: ReducedLagrangeDirac, group: AbstractLieGroup, params: Any) -> EulerPoincare:
    """(TG/V)/H ≅ TG/G for G = H ⋉ V: left-invariance under G is what the second stage needs, and is checked."""
    whole = next((motions() for rotations, motions in MOTIONS.items() if isinstance(group, rotations)), None)
    expected: Sequence[int] = () if whole is None else range(group.ambient_dimension, whole.ambient_dimension)
    if whole is None or tuple(system.connection.fibre) != tuple(expected):
        raise ValueError(
            "a second stage by a Lie group takes dx.SO2() or dx.SO3() after the translations of dx.SE2() or dx.SE3(), a "
            "dx.LagrangeDirac in the coordinates of their elements reduced with fibre=[2, 3] or [4, 5, 6], but "
            f"{type(group).__name__} came after fibre={list(system.connection.fibre)}: reduce by the whole group at once."
        )
    return reduced_by_left_translations(system.system, whole, params)
