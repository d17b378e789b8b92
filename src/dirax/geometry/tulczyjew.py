"""Tulczyjew triples, continuous and discrete: their arrows, Dirac differentials and discrete Legendre transforms."""

from collections.abc import Callable
from typing import Any

import jax
from jaxtyping import Array, Float

Vector = Float[Array, " n"]
Covector = Float[Array, " n"]
Point = tuple[Vector, Covector]
DiscreteLagrangian = Callable[[Vector, Vector], Any]


def slot_derivatives(discrete_lagrangian: DiscreteLagrangian, q0: Vector, q1: Vector) -> tuple[Covector, Covector]:
    """(D1 L_d, D2 L_d) at (q0, q1), each (n,)."""
    return jax.grad(discrete_lagrangian, argnums=(0, 1))(q0, q1)


def plus_dirac_differential(
    discrete_lagrangian: DiscreteLagrangian, q0: Vector, q1: Vector, q2: Vector, step: Any
) -> tuple[Point, Point]:
    """d_D⁺L_d at (q0, v0 = q1): the base point (q1, D2 L_d(q0, q1)) and the covector (β, γ) over it ([PY] (46)).

    β = −(D2 L_d + D1 L_d)(q1, q2)/h, which needs the next point, and γ = (q1 − q0)/h.
    """
    _, p1 = slot_derivatives(discrete_lagrangian, q0, q1)
    d1, d2 = slot_derivatives(discrete_lagrangian, q1, q2)
    return (q1, p1), (-(d2 + d1) / step, (q1 - q0) / step)


def minus_dirac_differential(
    discrete_lagrangian: DiscreteLagrangian, q_before: Vector, q0: Vector, q1: Vector, step: Any
) -> tuple[Point, Point]:
    """d_D⁻L_d at (v1 = q0, q1): the base point (q0, −D1 L_d(q0, q1)) and the covector (β, γ) over it ([PY] (47)).

    β = −(D2 L_d + D1 L_d)(q_{−1}, q0)/h, which needs the point before, and γ = (q1 − q0)/h.
    """
    p0, _ = slot_derivatives(discrete_lagrangian, q0, q1)
    d1, d2 = slot_derivatives(discrete_lagrangian, q_before, q0)
    return (q0, -p0), (-(d2 + d1) / step, (q1 - q0) / step)
