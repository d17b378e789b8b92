"""StageRelation: what a step whose unknowns are s copies of one relation says of it, beside its flat functions."""

from collections.abc import Callable
from typing import NamedTuple

from dirax.schemes.collocation_tables import Tableau


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
