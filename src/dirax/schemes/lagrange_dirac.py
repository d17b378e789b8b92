"""Discrete Lagrange–Dirac schemes: (+), (−) and the general discrete Lagrange–d'Alembert equations they belong to."""

from collections.abc import Callable
from typing import Any

from dirax.geometry.charts import Atlas
from dirax.program.user_functions import UserFunction
from dirax.schemes.discrete_lagrangian import CONSTRAINTS, RULES, checked_rule, mirrored
from dirax.schemes.discrete_structure import AbstractDiscreteStructure
from dirax.schemes.discrete_structure_charts import PairsInCharts
from dirax.schemes.discrete_structure_pairs import structure_on_pairs
from dirax.schemes.lagrange_dalembert_part import LagrangeDAlembertPart
from dirax.schemes.lagrange_dalembert_step import MOMENTA, ONE_SIDED, LagrangeDAlembertStep
from dirax.schemes.lagrange_poincare_dirac import LagrangePoincareDiracStep
from dirax.schemes.reduced_step_in_charts import ReducedStepInCharts
from dirax.schemes.step import AbstractScheme, Shape, StepEquation
from dirax.schemes.step_in_charts import StepInCharts, lagrangian_in_charts
from dirax.systems.system import AbstractSystem


class LagrangeDAlembert(AbstractScheme):
    """The discrete Lagrange–d'Alembert equations (Cortés–Martínez) of a discrete Lagrangian and a discrete constraint:

        p_k + D1 L_d(q_k, q_{k+1}) = W(q_k)ᵀ μ_k,   w_d(q_k, q_{k+1}) = 0,   p_{k+1} = D2 L_d(q_k, q_{k+1}).

    `discrete_lagrangian`: "left" h L(q0, Δq/h), "right" h L(q1, Δq/h), "midpoint", "trapezoidal", or a function
    L_d(q0, q1, h[, params]) returning a scalar. `constraint`: W(q) Δq/h + b(q) at q0 ("left"), q1 ("right") or the midpoint,
    or a function w_d(q0, q1, h[, params]) of shape (m,). Both functions may take t0 first, called `t`. The midpoint pair is
    self-adjoint and of second order.

    Forces enter as impulses f_d^− and f_d^+ at both ends, added to D1 L_d and D2 L_d, by the quadrature of L_d ("midpoint"
    for a function L_d): discrete Lagrange–d'Alembert forces (Marsden, West 2001, §3.2). Their work ⟨f_d^− + f_d^+, Δq/h⟩
    is summed up in `sol.work`, so that E_N − E_0 − work is what the method itself changes.

    Forces that see the multipliers are given the mean of the step, so that they keep its order; then a step begins and ends at
    the momentum projected onto the constraints, as it does in a composition.

    Holonomic constraints g = 0 hold at every node: p_k + D1 L_d − W(q_k)ᵀ μ_k − G(q_k)ᵀ λ_k = 0, g(q_{k+1}) = 0, the
    (SHAKE) discrete Dirac equations of Δ = ker W ∩ ker G. The saved p is projected along im Gᵀ onto G q̇ + ∂g/∂t = 0
    (RATTLE), which changes nothing in q; without W the map of saved (q, p) is symplectic on the constraint manifold, and
    of second order in q, p and λ for the midpoint and trapezoidal L_d.

    `momentum` says what is saved as p at a node where the constraint force jumps: p_k itself ("incoming", the default
    with a one-sided constraint), p_k − W(q_k)ᵀ μ_k = −D1 L_d(q_k, q_{k+1}) ("outgoing"), or the mean of both (default
    otherwise), which has the order of q. Without constraints the three are the same. A run begins at the given p_0. Where that is
    the mean, up to h², μ_0 is the whole impulse at the first row, that of a step which would arrive there included. Where it is
    not, no impulse of one-forms has led to it: μ_0 is the impulse from p_0 on, which is a part of that of later rows, half of it
    for the midpoint pair. From two points, whose step is given, it is zero, and λ_0 is.
    Solvable where [[D2 D1 L_d, Wᵀ], [D2 w_d, 0]] is invertible ([PY] (21)); L itself may be degenerate.

    Of a `dx.ManifoldLagrangian` L_d and w_d are on its manifold, functions being of points of R^N, and the equations those of
    T*_{q_k}Q, solved in charts ([RL] §6): R⁻¹_{q0}(q1)/h at q0 ("left") and −R⁻¹_{q1}(q0)/h at q1 ("right") take the place of
    Δq/h, with the retraction R of the manifold, and "midpoint" is the middle of the geodesic with the velocity there.
    Raises `TypeError` for a manifold without a retraction. A run starts from two points of the manifold, q0= and q1=, too.
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
        self.discrete_lagrangian = checked_rule(discrete_lagrangian, RULES, "discrete_lagrangian")
        self.constraint = checked_rule(constraint, CONSTRAINTS, "constraint")
        one_sided = self.constraint in ONE_SIDED
        self.momentum = checked_momentum(("incoming" if one_sided else "mean") if momentum is None else momentum)

    def step_equation(self, system: Any, shape: Shape) -> StepEquation:
        return _equation(self, system, shape)

    def step_on_q(
        self, system: AbstractSystem, shape: Shape, part: bool = False
    ) -> LagrangeDAlembertStep | LagrangeDAlembertPart:
        """The step of a system on Q, or a `part` of a composed step; raises `TypeError` for one that has no Lagrangian form, or
        whose motion is known to lie on a smaller manifold than T*Q: two-point methods have modes off it, that grow."""
        lagrangian = system.lagrangian_form()
        if lagrangian is None or system.final_relation(shape) is not None:
            raise TypeError(
                "this scheme discretizes a dx.LagrangeDirac or dx.NonholonomicMechanics system (a Lagrangian with constraints), "
                f"but a {type(system).__name__} was given: use dx.DiscreteDirac for the others."
            )
        # forces that see the multipliers are given those of both ends, which are of the order of the step
        part = part or lagrangian.forces_see_multipliers
        momentum = _momentum(self, part)
        step = LagrangeDAlembertStep(lagrangian, shape, self.discrete_lagrangian, self.constraint, momentum)
        return LagrangeDAlembertPart(step) if part else step

    def adjoint(self, system: Any) -> "LagrangeDAlembert":
        """That of L_d*(q0, q1, h) = −L_d(q1, q0, −h) and w_d*(q0, q1, h) = w_d(q1, q0, −h); the mean of the momenta before
        and after the jump at a node is that of the adjoint too."""
        momentum = "mean" if self.momentum == "mean" else "incoming"
        return LagrangeDAlembert(mirrored(self.discrete_lagrangian, -1.0), mirrored(self.constraint, 1.0), momentum)

    def part(self, system: Any, shape: Shape) -> AbstractScheme:
        return _part(self, self, shape)

    def discrete_structure(self, system: Any, shape: Shape, step: Any) -> AbstractDiscreteStructure | str:
        return _structure(self, system, shape, step)


def checked_momentum(momentum: str) -> str:
    """The name of what is saved as p; raises `ValueError` for another."""
    if momentum not in MOMENTA:
        raise ValueError(f"momentum must be one of {', '.join(map(repr, MOMENTA))}, but {momentum!r} was given.")
    return momentum


class PlusLagrangeDirac(AbstractScheme):
    """The (+)-discrete Lagrange–Dirac scheme ([PY] Def 6.7, (53), (58)): the constraint holds at the new point q_{k+1}.

        p_{k+1} = D2 L_d(q_k, q_{k+1}),   p_k + D1 L_d(q_k, q_{k+1}) = W(q_k)ᵀ μ_k,   W(q_{k+1}) (q_{k+1} − q_k)/h = 0.

    `discrete_lagrangian` as in `LagrangeDAlembert`, of which this is the case `constraint="right"`; the paper uses "left".
    `momentum` as there: p_k of (53) is the incoming one, the default. First order; on long runs its energy can grow: measure
    with `dx.verify`.
    """

    discrete_lagrangian: str | UserFunction
    momentum: str = "incoming"

    def __init__(self, discrete_lagrangian: str | Callable = "left", momentum: str = "incoming"):
        self.discrete_lagrangian = checked_rule(discrete_lagrangian, RULES, "discrete_lagrangian")
        self.momentum = checked_momentum(momentum)

    @property
    def lagrange_dalembert(self) -> LagrangeDAlembert:
        """The general scheme of which this is a case."""
        return LagrangeDAlembert(self.discrete_lagrangian, "right", self.momentum)

    def step_equation(self, system: Any, shape: Shape) -> StepEquation:
        return _equation(self.lagrange_dalembert, system, shape)

    def adjoint(self, system: Any) -> LagrangeDAlembert:
        """That of the general scheme."""
        return self.lagrange_dalembert.adjoint(system)

    def part(self, system: Any, shape: Shape) -> AbstractScheme:
        return _part(self, self.lagrange_dalembert, shape)

    def discrete_structure(self, system: Any, shape: Shape, step: Any) -> AbstractDiscreteStructure | str:
        return _structure(self.lagrange_dalembert, system, shape, step, "+")


class MinusLagrangeDirac(AbstractScheme):
    """The (−)-discrete Lagrange–Dirac scheme ([PY] Def 6.7, (54), (59)): the constraint holds at the old point q_k.

        p_{k+1} = D2 L_d(q_k, q_{k+1}),   p_k + D1 L_d(q_k, q_{k+1}) = W(q_k)ᵀ μ_k,   W(q_k) (q_{k+1} − q_k)/h = 0.

    `discrete_lagrangian` and `momentum` as in `LagrangeDAlembert`, of which this is the case `constraint="left"`. The p_k of
    (54), −D1 L_d(q_k, q_{k+1}), is the outgoing momentum p_k − W(q_k)ᵀ μ_k, which `momentum="outgoing"` saves; the default is the
    incoming one, which a run can begin with and which is that of (+). The multipliers printed in [PY] for (−) have the opposite
    sign. First order.
    """

    discrete_lagrangian: str | UserFunction
    momentum: str = "incoming"

    def __init__(self, discrete_lagrangian: str | Callable = "left", momentum: str = "incoming"):
        self.discrete_lagrangian = checked_rule(discrete_lagrangian, RULES, "discrete_lagrangian")
        self.momentum = checked_momentum(momentum)

    @property
    def lagrange_dalembert(self) -> LagrangeDAlembert:
        """The general scheme of which this is a case."""
        return LagrangeDAlembert(self.discrete_lagrangian, "left", self.momentum)

    def step_equation(self, system: Any, shape: Shape) -> StepEquation:
        return _equation(self.lagrange_dalembert, system, shape, -1)

    def adjoint(self, system: Any) -> LagrangeDAlembert:
        """That of the general scheme."""
        return self.lagrange_dalembert.adjoint(system)

    def part(self, system: Any, shape: Shape) -> AbstractScheme:
        return _part(self, self.lagrange_dalembert, shape)

    def discrete_structure(self, system: Any, shape: Shape, step: Any) -> AbstractDiscreteStructure | str:
        return _structure(self.lagrange_dalembert, system, shape, step, "-")


class _Part(AbstractScheme):
    """A discrete Lagrange–d'Alembert scheme whose steps end at the projected momentum."""

    scheme: LagrangeDAlembert

    def step_equation(self, system: Any, shape: Shape) -> StepEquation:
        return _equation(self.scheme, system, shape, part=True)


def _part(scheme: AbstractScheme, general: LagrangeDAlembert, shape: Shape) -> AbstractScheme:
    """A scheme as a part of a composed step. Without constraints it is the scheme itself."""
    return _Part(general) if shape.m + shape.c else scheme


def _momentum(scheme: LagrangeDAlembert, part: bool) -> str:
    """The momentum that is saved: a part of a composed step begins and ends at one, and saves no mean of two."""
    return "incoming" if part else scheme.momentum


def _equation(
    scheme: LagrangeDAlembert, system: AbstractSystem, shape: Shape, sign: int = +1, part: bool = False
) -> StepEquation:
    """The discrete Lagrange–d'Alembert equations of a system on Q or in charts of Q, or on the quotient by its symmetry."""
    quotient = system.quotient_form()
    whole = system if quotient is None else quotient.unreduced()
    if whole.manifold_form() is not None:
        in_charts = _in_charts(scheme, whole, shape, part)
        return (in_charts if quotient is None else ReducedStepInCharts(quotient, in_charts)).equation()
    step = scheme.step_on_q(whole, shape, part)
    return (step if quotient is None else LagrangePoincareDiracStep(quotient, step, sign)).equation()


def _in_charts(scheme: LagrangeDAlembert, system: AbstractSystem, shape: Shape, part: bool) -> StepInCharts:
    local = lagrangian_in_charts(system, scheme.discrete_lagrangian, scheme.constraint)
    return StepInCharts(local, Atlas(local.manifold), shape, _momentum(scheme, part), part)


def _structure(
    scheme: LagrangeDAlembert, system: AbstractSystem, shape: Shape, step: Any, sign: str | None = None
) -> AbstractDiscreteStructure | str:
    rule, constraint, share = scheme.discrete_lagrangian, scheme.constraint, MOMENTA[scheme.momentum]
    if system.manifold_form() is not None:
        return PairsInCharts(lagrangian_in_charts(system, rule, constraint), step, shape, sign, share)
    return structure_on_pairs(system, shape, step, rule, constraint, sign=sign, share=share)
