"""Compositions of a scheme with itself, or with its adjoint, to higher order."""

import warnings
from collections.abc import Sequence
from typing import Any

from dirax.schemes.adjoint_step import AdjointStep
from dirax.schemes.composition_coefficients import COEFFICIENTS
from dirax.schemes.discrete_structure import AbstractDiscreteStructure
from dirax.schemes.step import AbstractScheme, Shape, StepEquation, StepSequence, make_step_equation


class Composition(AbstractScheme):
    """A step of size h as steps γ_1 h, …, γ_s h of another scheme: its structure is kept, its order is raised.

    `coefficients`: "yoshida4", "suzuki4", "suzuki6", "suzuki8", "yoshida6", "kahan-li6", "kahan-li8", "mclachlan8", or numbers
    that sum to 1. The named ones need a self-adjoint scheme of order 2 (midpoint or trapezoidal ones, Methods 1 and 2
    with the midpoint map); for any other compose it with its `Adjoint` first: `SymmetricComposition(scheme)`.

    Of a singular Lagrangian a composition has the order that is named where the scheme maps the final manifold to itself: the
    p = α(q) of L = ⟨α(q), q̇⟩ − H is kept by Method 1 for linear α alone, and by Method 2 for any. `dx.simulate` refuses others,
    which with check_initial=False stay at the order of the scheme.

    A saved row is the whole step's: impulses of its parts are summed, rates are means. Parts of a discrete Lagrange–d'Alembert
    scheme or of Method 1 on a Lagrangian with constraints end at the momentum whose velocity satisfies them, so that p and the
    multipliers have the order of q; a Lagrangian that is singular on the constraint distribution determines no such momentum,
    and is refused at the start. So are Method 1 and discrete gradients of systems in x that leave their constraints: what is off
    them changes its sign in every step, and stays of second order. Method 2 composes to the order that is named. Lobatto
    collocation with one-forms, whose state holds a multiplier of the step before, has order 4 at most: more is warned of.

    Raises `ValueError` for unknown names and for numbers that do not sum to 1, `TypeError` for what is neither.
    """

    scheme: AbstractScheme
    coefficients: tuple[float, ...]

    def __init__(self, scheme: AbstractScheme, coefficients: str | Sequence[float] = "suzuki4"):
        _check_scheme(scheme)
        if isinstance(coefficients, str):
            if coefficients not in COEFFICIENTS:
                raise ValueError(_no_coefficients(coefficients))
            coefficients = COEFFICIENTS[coefficients]
        try:
            numbers = tuple(map(float, coefficients))
        except (TypeError, ValueError):
            raise TypeError(_no_coefficients(coefficients)) from None
        if not numbers or not abs(sum(numbers) - 1.0) <= 1e-12:
            raise ValueError(f"the coefficients must sum to 1, but {numbers} sum to {sum(numbers):.15g}.")
        self.scheme, self.coefficients = scheme, numbers

    def step_equation(self, system: Any, shape: Shape) -> StepSequence:
        inner = make_step_equation(self.scheme.part(system, shape), system, shape)
        most = self.scheme.composed_order(system, shape)
        if most is not None and most < order_by_powers(self.coefficients):
            warnings.warn(
                f"compositions of {self.scheme!r} have order {most} here, whatever their coefficients: those of "
                "dx.LagrangeDAlembert and dx.DiscreteDirac have the order that is named.",
                RuntimeWarning,
                stacklevel=2,
            )
        return StepSequence(tuple((eq, a * c) for c in self.coefficients for eq, a in inner.stages))

    def discrete_structure(self, system: Any, shape: Shape, step: Any) -> str:
        return between_the_parts(self)

    @property
    def keeps_no_form(self) -> str:
        return self.scheme.keeps_no_form

    @property
    def constraints_at_rows(self) -> bool:
        return self.scheme.constraints_at_rows


def order_by_powers(coefficients: Sequence[float]) -> int:
    """The order up to which Σ γ^3 = Σ γ^5 = … = 0 holds, as it does for compositions of that order of self-adjoint schemes of
    order 2; 2 where none does."""
    order = 2
    while order < 8 and abs(sum(c ** (order + 1) for c in coefficients)) < 1e-9:
        order += 2
    return order


def _no_coefficients(given: Any) -> str:
    return f"coefficients must be one of {', '.join(map(repr, COEFFICIENTS))} or numbers, but {given!r} was given."


class Adjoint(AbstractScheme):
    """The adjoint Φ*_h = (Φ_{−h})⁻¹ of a scheme: x1 = Φ*_h(x0) iff x0 = Φ_{−h}(x1).

    A scheme is self-adjoint where it equals its adjoint. A discrete Lagrange–d'Alembert or Routh scheme has one of the same
    family, with L_d*(q0, q1, h) = −L_d(q1, q0, −h) and w_d*(q0, q1, h) = w_d(q1, q0, −h): with constraints its p matters
    only modulo the forces Wᵀμ, so that the inverse as a map of (q, p) does not exist. Nor does it for Method 2, whose states are
    on the final manifold: in coordinates the adjoint of that of θ is that of 1 − θ. The unknowns of any other scheme are its own
    and the increment of the state.
    """

    scheme: AbstractScheme

    def __check_init__(self):
        _check_scheme(self.scheme)

    def step_equation(self, system: Any, shape: Shape) -> StepEquation:
        return _adjoint_of(self.scheme, system, shape, "Adjoint takes a one-stage scheme: compose the parts' adjoints instead.")

    def discrete_structure(self, system: Any, shape: Shape, step: Any) -> AbstractDiscreteStructure | str:
        adjoint = self.scheme.adjoint(system)
        if adjoint is None:
            name = type(self.scheme).__name__
            return f"the inverse of a step of {name} has its structure from the last row to the first, which is not measured"
        return adjoint.discrete_structure(system, shape, step)

    @property
    def keeps_no_form(self) -> str:
        return self.scheme.keeps_no_form

    @property
    def constraints_at_rows(self) -> bool:
        return self.scheme.constraints_at_rows


class SymmetricComposition(AbstractScheme):
    """Φ_{h/2} ∘ Φ*_{h/2}: a self-adjoint scheme, of order 2 at least, from any scheme."""

    scheme: AbstractScheme

    def __check_init__(self):
        _check_scheme(self.scheme)

    def step_equation(self, system: Any, shape: Shape) -> StepSequence:
        refusal = "SymmetricComposition takes a one-stage scheme."
        adjoint = _adjoint_of(self.scheme, system, shape, refusal, part=True)
        return StepSequence(((adjoint, 0.5), (_one_stage(self.scheme.part(system, shape), system, shape, refusal), 0.5)))

    def discrete_structure(self, system: Any, shape: Shape, step: Any) -> str:
        return between_the_parts(self)

    @property
    def keeps_no_form(self) -> str:
        return self.scheme.keeps_no_form

    @property
    def constraints_at_rows(self) -> bool:
        return self.scheme.constraints_at_rows


def _check_scheme(scheme: Any) -> None:
    """Raise `TypeError` for something that is no scheme."""
    if not isinstance(scheme, AbstractScheme):
        way = ": add parentheses." if isinstance(scheme, type) else "."
        raise TypeError(f"scheme must be a dirax scheme such as dx.PlusLagrangeDirac(), but {scheme!r} was given{way}")


def between_the_parts(scheme: AbstractScheme) -> str:
    """Why the rows of a composed step belong to no structure."""
    return f"the points between the parts of a step of {type(scheme).__name__}, which the structure joins, are not saved"


def _adjoint_of(scheme: AbstractScheme, system: Any, shape: Shape, refusal: str, part: bool = False) -> StepEquation:
    adjoint = scheme.adjoint(system)
    if adjoint is not None:
        adjoint = adjoint.part(system, shape) if part else adjoint
        return _one_stage(adjoint, system, shape, refusal)
    return AdjointStep(_one_stage(scheme, system, shape, refusal)).equation()


def _one_stage(scheme: AbstractScheme, system: Any, shape: Shape, refusal: str) -> StepEquation:
    equation = make_step_equation(scheme, system, shape)
    if not isinstance(equation, StepEquation):
        raise TypeError(refusal)
    return equation
