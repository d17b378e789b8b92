"""What a step whose unknowns are s copies of one relation says of it, beside its flat functions."""

from collections.abc import Callable
from typing import NamedTuple

from dirax.schemes.collocation_tables import Quadrature, Tableau


class StageRelation(NamedTuple):
    """A differential equation as it holds at one node of a collocation method: state (a, b), ȧ = y unknown and ḃ given.

    `rates(a, y, t, params)` (β,) is ḃ, and `relation(a, b, y, t, params)` (α,) is zero at the right y (α,). An ordinary
    differential equation has b empty and ρ = y − f(a), a Lagrangian a = q, b = p, ḃ = ∂L/∂q and ρ = p − ∂L/∂v. The unknowns of
    the step are y_1, …, y_s one after the other, with a_i = a_0 + h Σ_j A_ij y_j, b_i = b_0 + h Σ_j A_ij ḃ_j and the new state
    (a_0 + h Σ_i w_i y_i, b_0 + h Σ_i w_i ḃ_i) for the `tableau` (nodes c, weights w, matrix A).
    """

    first: int
    second: int
    rates: Callable
    relation: Callable
    tableau: Tableau


class MeanRelation(NamedTuple):
    """A differential equation as it holds at one node of a method that takes means over the step: state (a, b), ȧ = y unknown.

    `slopes(a, ȧ, t, params)` (γ,) are taken at the points τ_k of the `quadrature`, on the polynomials a(τ) and ȧ(τ) through the
    rates y_i at the nodes; `rates(a, mean, t, params)` (α + β,) are (ȧ, ḃ) at node i, of the mean of the slopes over the step
    with the weight ℓ_i/b_i. The unknowns of the step are y_1, …, y_s one after the other, y_i = ȧ. The new state is
    x = x_0 + h Σ_i w_i (ȧ_i, ḃ_i) and what `settle(x_0, x, ȧ(1), t, h, params)` (α + β,) adds to it.
    """

    first: int
    second: int
    slopes: Callable
    rates: Callable
    settle: Callable
    tableau: Tableau
    quadrature: Quadrature
