"""Discrete Routh reduction: the momentum μ is fixed and the group variable eliminated, n − dim G unknowns a step."""

from collections.abc import Callable
from typing import Any

from dirax.program.user_functions import UserFunction
from dirax.schemes.lagrange_dirac import LagrangeDAlembert
from dirax.schemes.lagrange_poincare_dirac import LagrangePoincareDiracStep
from dirax.schemes.routh_step import RouthStep
from dirax.schemes.step import AbstractScheme, Shape, StepEquation


class DiscreteRouth(AbstractScheme):
    """The discrete Routh equations on the quotient: γ from ∂l_d/∂γ(x_k, ẋ, γ) = μ, and the discrete Euler–Lagrange
    equations of the discrete Routhian r_μ(x_k, ẋ) = l_d − ⟨μ, hγ⟩ in the shape alone.

    `discrete_lagrangian`, `constraint` and `momentum` as in `LagrangeDAlembert`, whose trajectory on a system made by
    `dx.reduce` this is, to roundoff. γ has a closed form where L is quadratic in the group velocity (found from L itself),
    else Newton's method is unrolled from the γ of the step before. The group inertia ∂²l_d/∂γ² must be invertible: where
    it is not, μ is a singular value.

    Constraints and forces that do no work along the group stay, as forces on the shape: the one-forms vanish on the
    vertical directions, ⟨ω^r(q), ξ_Q(q)⟩ = 0, and ⟨f, ξ_Q(q)⟩ = 0 (holonomic constraints that are invariant have this
    property). Others move μ, by the nonholonomic momentum equation: a run refuses them with `ValueError`, which says by how
    much and where; `LagrangeDAlembert` steps such systems on the quotient. Looked at: the initial data and points near them;
    under a JAX transformation nothing is.
    """

    discrete_lagrangian: str | UserFunction
    constraint: str | UserFunction
    momentum: str

    def __init__(
        self,
        discrete_lagrangian: str | Callable = "midpoint",
        constraint: str | Callable = "midpoint",
        momentum: str | None = None,
    ):
        scheme = LagrangeDAlembert(discrete_lagrangian, constraint, momentum)
        self.discrete_lagrangian, self.constraint, self.momentum = scheme.discrete_lagrangian, scheme.constraint, scheme.momentum

    @property
    def lagrange_dalembert(self) -> LagrangeDAlembert:
        """The scheme on Q × Q whose equations are reduced."""
        return LagrangeDAlembert(self.discrete_lagrangian, self.constraint, self.momentum)

    def step_equation(self, system: Any, shape: Shape) -> StepEquation:
        return self.equation(system, shape)

    def equation(self, system: Any, shape: Shape, part: bool = False) -> StepEquation:
        """The Routh equations, also of a `part` of a composed step; raises `TypeError` for a system that is no quotient in
        coordinates."""
        quotient = system.quotient_form()
        if quotient is None:
            raise TypeError(
                f"dx.DiscreteRouth steps a system made by dx.reduce, but a {type(system).__name__} was given: name its "
                "symmetry, dx.reduce(system, dx.LinearConnection(fibre=[…]))."
            )
        if quotient.unreduced().manifold_form() is not None:
            raise TypeError(
                "dx.DiscreteRouth steps quotients in coordinates, but this one is of a system on a manifold, in charts: step it "
                "by dx.LagrangeDAlembert, whose trajectory that of Routh's equations is."
            )
        unreduced = self.lagrange_dalembert.step_on_q(quotient.unreduced(), shape, part)
        return RouthStep(LagrangePoincareDiracStep(quotient, unreduced)).equation()

    def part(self, system: Any, shape: Shape) -> AbstractScheme:
        return _Part(self) if shape.m + shape.c else self

    def adjoint(self, system: Any) -> "DiscreteRouth":
        """The Routh equations of the adjoint on Q × Q."""
        adjoint = self.lagrange_dalembert.adjoint(system)
        return DiscreteRouth(adjoint.discrete_lagrangian, adjoint.constraint, adjoint.momentum)


class _Part(AbstractScheme):
    """Routh's equations whose steps end at the projected momentum."""

    scheme: DiscreteRouth

    def step_equation(self, system: Any, shape: Shape) -> StepEquation:
        return self.scheme.equation(system, shape, part=True)
