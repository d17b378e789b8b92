"""Variable steps that stay reversible: the step density as a part of the state, after Hairer and Söderlind."""

from collections.abc import Callable
from typing import Any

from dirax.program.user_functions import UserFunction
from dirax.schemes.step import AbstractScheme, Shape, StepEquation, make_step_equation
from dirax.schemes.step_density import LocalFrequency
from dirax.schemes.variable_step import VariableStep


class VariableSteps(AbstractScheme):
    """The steps of another scheme, each as long as the motion there allows: h = step/z with the step density z, a number of
    the state that follows `density` along the motion (the integrating controller of Hairer, Söderlind, SIAM J. Sci. Comput.
    26 (2005), (3.3)–(3.4)):

        z_{k+1/2} = z_k + ε G(x_k)/2,   x_{k+1} = Φ_h(x_k) with h = ε/z_{k+1/2},   z_{k+1} = z_{k+1/2} + ε G(x_{k+1})/2,

    where ε is `step=` and G = d ln ρ/dt along the motion of ρ = `density`, at which z_0 begins. Nothing looks back, no step
    is rejected: the map of (x, z, t) is self-adjoint where the scheme is, and reversible, so that it keeps energies
    as well as steps of equal length do. It is not symplectic.

    `density(q[, params])` or `density(t, q[, params])` is a positive number, of x instead of q where the system has points x;
    the more of it, the shorter the steps: h = step/ρ(q), up to an error that step² sets. Where none is given, it is the local
    frequency √‖∂a/∂q‖, a(q) the acceleration from rest, ‖·‖ in the metric of the masses (for Kepler's problem a multiple of
    |q|^(−3/2)); of systems ẋ = f(x) it is √‖S‖, S = (∂f/∂x)², ‖S‖² = Σ |S_ij S_ji|. It vanishes where forces do not change
    from place to place, and then one has to be given.

        scheme = dx.VariableSteps(dx.Collocation(4), density=lambda q: (q @ q) ** -0.75)

    `sol.t` are the times of the rows, in a batch (B, rows) those of each trajectory, and `sol.step_density` is z; the order is
    that of the scheme. Impulses, as the multipliers of `dx.LagrangeDAlembert` and `dx.Collocation`, are those of the whole step:
    over its length, `sol.step_length`, they are the mean of the force in the step, up to h², and not its value at the row.
    Takes schemes of one part whose q and p at a row are in their state; may itself be composed.
    Raises `TypeError` for other schemes and densities, `ValueError` for densities that are not positive where the run begins;
    one in which z does not stay positive ends there.
    """

    scheme: AbstractScheme
    density: UserFunction | None

    def __init__(self, scheme: AbstractScheme, density: Callable | None = None):
        if not isinstance(scheme, AbstractScheme):
            raise TypeError(f"scheme must be a dirax scheme such as dx.Collocation(4), but {scheme!r:.80} was given.")
        self.scheme = scheme
        given = isinstance(density, UserFunction) or density is None
        self.density = density if given else UserFunction(density, "density", ("q",), timed=True)

    def step_equation(self, system: Any, shape: Shape) -> StepEquation:
        if system.quotient_form() is not None:
            raise TypeError("dx.VariableSteps takes systems that are not reduced.")
        if shape.redundant:
            raise ValueError(
                "dx.VariableSteps asks for velocities of momenta, for which constraints must not follow from others, as number "
                f"{', '.join(map(str, shape.redundant))} does (in the order of the multipliers: one_forms, then holonomic): "
                "leave it out of the system."
            )
        # momenta that are means over both steps at a row are those of equal steps: as in compositions
        inner = make_step_equation(self.scheme.part(system, shape), system, shape)
        if not isinstance(inner, StepEquation):
            raise TypeError(
                f"dx.VariableSteps takes a scheme of one part, but {type(self.scheme).__name__} has {len(inner.stages)}: "
                "compose the variable steps instead, dx.Composition(dx.VariableSteps(scheme), …)."
            )
        if not ("x" in inner.fields or {"q", "p"} <= set(inner.fields)):
            raise TypeError(
                f"dx.VariableSteps takes schemes that save q and p, or x, but {type(self.scheme).__name__} saves "
                f"{', '.join(inner.fields)}."
            )
        if (density := self.density) is None:
            if system.lagrangian_form() is None and "x" not in inner.fields:
                raise TypeError(
                    f"the local frequency is that of a Lagrangian or of points x, and a {type(system).__name__} has neither: "
                    "give dx.VariableSteps(scheme, density=lambda q: …)."
                )
            return VariableStep(inner, system, LocalFrequency(system, system.lagrangian_form()).at).equation()
        one = density.returning(())
        return VariableStep(inner, system, lambda t, *values: one(*density.given(t, *values))).equation()

    def adjoint(self, system: Any) -> "VariableSteps | None":
        """The same with the adjoint of the scheme."""
        adjoint = self.scheme.adjoint(system)
        return self if adjoint == self.scheme else None if adjoint is None else VariableSteps(adjoint, self.density)

    def discrete_structure(self, system: Any, shape: Shape, step: Any) -> str:
        return "its steps have lengths of their own"

    def step_form(self, system: Any, shape: Shape, step: Any) -> str:
        return "variable steps are reversible, not symplectic"

    @property
    def constraints_at_rows(self) -> bool:
        return self.scheme.constraints_at_rows
