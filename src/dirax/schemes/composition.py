"""Compositions of a scheme with itself, or with its adjoint, to higher order."""

from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp

from dirax.program.user_functions import UserFunction
from dirax.reduction.reduced import ReducedLagrangeDirac
from dirax.schemes.discrete_lagrangian import LD_ARGUMENTS
from dirax.schemes.lagrange_dirac import LagrangeDAlembert, MinusLagrangeDirac, PlusLagrangeDirac
from dirax.schemes.routh import DiscreteRouth
from dirax.schemes.step import AbstractScheme, Shape, StepEquation, StepSequence, make_step_equation
from dirax.systems.lagrange_dirac import LagrangeDirac
from dirax.systems.nonholonomic import as_lagrange_dirac


def _symmetric(half: Sequence[float], middle: float | None = None) -> tuple[float, ...]:
    """(γ1, …, γs, γ_middle, γs, …, γ1), with the middle that makes the sum 1 unless it is given."""
    centre = 1.0 - 2.0 * sum(half) if middle is None else middle
    return (*half, centre, *reversed(half))


def _triple_jump(order: int) -> tuple[float, ...]:
    """From order − 2 to `order` by three steps (Yoshida 1990; Creutz–Gocksch)."""
    outer = 1.0 / (2.0 - 2.0 ** (1.0 / (order - 1)))
    return (outer, 1.0 - 2.0 * outer, outer)


def _quintuple_jump(order: int) -> tuple[float, ...]:
    """From order − 2 to `order` by five steps (Suzuki 1990)."""
    outer = 1.0 / (4.0 - 4.0 ** (1.0 / (order - 1)))
    return (outer, outer, 1.0 - 4.0 * outer, outer, outer)


def _nested(jump, order: int) -> tuple[float, ...]:
    coefficients = (1.0,)
    for current in range(4, order + 1, 2):
        coefficients = tuple(a * b for a in jump(current) for b in coefficients)
    return coefficients


COEFFICIENTS: dict[str, tuple[float, ...]] = {
    "yoshida4": _nested(_triple_jump, 4),
    "suzuki4": _nested(_quintuple_jump, 4),
    "suzuki6": _nested(_quintuple_jump, 6),
    "suzuki8": _nested(_quintuple_jump, 8),
    # Yoshida 1990, solution A of order 6
    "yoshida6": _symmetric((0.784513610477560, 0.235573213359357, -1.17767998417887)),
    # Kahan, Li 1997: order 6 with nine, order 8 with seventeen steps
    "kahan-li6": _symmetric((0.39216144400731413928, 0.33259913678935943860, -0.70624617255763935981, 0.08221359629355080023)),
    "kahan-li8": _symmetric(
        (
            0.13020248308889008088,
            0.56116298177510838456,
            -0.38947496264484728641,
            0.15884190655515560090,
            -0.39590389413323757734,
            0.18453964097831570709,
            0.25837438768632204729,
            0.29501172360931029887,
        )
    ),
    # Suzuki, Umeno 1993; McLachlan 1995: order 8 with fifteen steps
    "mclachlan8": _symmetric(
        (
            0.74167036435061295345,
            -0.40910082580003159400,
            0.19075471029623837995,
            -0.57386247111608226666,
            0.29906418130365592384,
            0.33462491824529818378,
            0.31529309239676659663,
        )
    ),
}
"""Symmetric compositions of a self-adjoint scheme of order 2, by the name of their authors and their order."""


class Composition(AbstractScheme):
    """A step of size h as steps γ_1 h, …, γ_s h of another scheme: its structure is kept, its order is raised.

    `coefficients`: "yoshida4", "suzuki4", "suzuki6", "suzuki8", "yoshida6", "kahan-li6", "kahan-li8", "mclachlan8", or numbers
    that sum to 1. The named ones need a self-adjoint scheme of order 2 (midpoint or trapezoidal ones, Methods 1 and 2
    with the midpoint map); for any other compose it with its `Adjoint` first: `SymmetricComposition(scheme)`.

    Raises `ValueError` for unknown names and for numbers that do not sum to 1.
    """

    scheme: AbstractScheme
    coefficients: tuple[float, ...]

    def __init__(self, scheme: AbstractScheme, coefficients: str | Sequence[float] = "suzuki4"):
        if not isinstance(scheme, AbstractScheme):
            raise TypeError(f"scheme must be a dirax scheme, but {scheme!r} was given.")
        if isinstance(coefficients, str):
            if coefficients not in COEFFICIENTS:
                raise ValueError(
                    f"coefficients must be one of {', '.join(map(repr, COEFFICIENTS))} or numbers, "
                    f"but {coefficients!r} was given."
                )
            coefficients = COEFFICIENTS[coefficients]
        numbers = tuple(float(c) for c in coefficients)
        if not numbers or abs(sum(numbers) - 1.0) > 1e-12:
            raise ValueError(f"the coefficients must sum to 1, but {numbers} sum to {sum(numbers):.15g}.")
        self.scheme, self.coefficients = scheme, numbers

    def step_equation(self, system: Any, shape: Shape) -> StepSequence:
        inner = make_step_equation(self.scheme, system, shape)
        return StepSequence(tuple((eq, a * c) for c in self.coefficients for eq, a in inner.stages))

    def discrete_structure(self, system: Any, shape: Shape, step: Any) -> str:
        return between_the_parts(self)

    @property
    def constraints_at_rows(self) -> bool:
        return self.scheme.constraints_at_rows


class Adjoint(AbstractScheme):
    """The adjoint Φ*_h = (Φ_{−h})⁻¹ of a scheme: x1 = Φ*_h(x0) iff x0 = Φ_{−h}(x1).

    A scheme is self-adjoint where it equals its adjoint. A discrete Lagrange–d'Alembert or Routh scheme has one of the same
    family, with L_d*(q0, q1, h) = −L_d(q1, q0, −h) and w_d*(q0, q1, h) = w_d(q1, q0, −h): with constraints its p matters
    only modulo the forces Wᵀμ, so that the inverse as a map of (q, p) does not exist. The unknowns of any other scheme are
    its own and the increment of the state.
    """

    scheme: AbstractScheme

    def step_equation(self, system: Any, shape: Shape) -> StepEquation:
        return _adjoint_of(self.scheme, system, shape, "Adjoint takes a one-stage scheme: compose the parts' adjoints instead.")

    @property
    def constraints_at_rows(self) -> bool:
        return self.scheme.constraints_at_rows


class SymmetricComposition(AbstractScheme):
    """Φ_{h/2} ∘ Φ*_{h/2}: a self-adjoint scheme, of order 2 at least, from any scheme."""

    scheme: AbstractScheme

    def step_equation(self, system: Any, shape: Shape) -> StepSequence:
        refusal = "SymmetricComposition takes a one-stage scheme."
        adjoint = _adjoint_of(self.scheme, system, shape, refusal)
        return StepSequence(((adjoint, 0.5), (_one_stage(self.scheme, system, shape, refusal), 0.5)))

    def discrete_structure(self, system: Any, shape: Shape, step: Any) -> str:
        return between_the_parts(self)

    @property
    def constraints_at_rows(self) -> bool:
        return self.scheme.constraints_at_rows


def between_the_parts(scheme: AbstractScheme) -> str:
    """Why the rows of a composed step belong to no structure."""
    return f"the points between the parts of a step of {type(scheme).__name__}, which the structure joins, are not saved"


def _adjoint_of(scheme: AbstractScheme, system: Any, shape: Shape, refusal: str) -> StepEquation:
    if isinstance(as_lagrange_dirac(system), LagrangeDirac | ReducedLagrangeDirac) and isinstance(scheme, FAMILY):
        return _one_stage(adjoint_scheme(scheme), system, shape, refusal)
    return adjoint_equation(_one_stage(scheme, system, shape, refusal))


def _one_stage(scheme: AbstractScheme, system: Any, shape: Shape, refusal: str) -> StepEquation:
    equation = make_step_equation(scheme, system, shape)
    if not isinstance(equation, StepEquation):
        raise TypeError(refusal)
    return equation


FAMILY = (LagrangeDAlembert, PlusLagrangeDirac, MinusLagrangeDirac, DiscreteRouth)
MIRRORED = {"left": "right", "right": "left", "midpoint": "midpoint", "trapezoidal": "trapezoidal"}


def adjoint_scheme(scheme: AbstractScheme) -> LagrangeDAlembert | DiscreteRouth:
    """The adjoint of a discrete Lagrange–d'Alembert or Routh scheme within the family."""
    if isinstance(scheme, LagrangeDAlembert | DiscreteRouth):
        rule, constraint = scheme.discrete_lagrangian, scheme.constraint
    elif isinstance(scheme, PlusLagrangeDirac | MinusLagrangeDirac):
        rule, constraint = scheme.discrete_lagrangian, "right" if isinstance(scheme, PlusLagrangeDirac) else "left"
    else:
        raise TypeError(f"adjoint_scheme takes a discrete Lagrange–d'Alembert scheme, but {scheme!r} was given.")
    kind = DiscreteRouth if isinstance(scheme, DiscreteRouth) else LagrangeDAlembert
    return kind(_mirror(rule, -1.0), _mirror(constraint, 1.0), "incoming")


def _mirror(rule: str | UserFunction, sign: float) -> str | Callable:
    """sign·f(q1, q0, −h) of a function f(q0, q1, h), or the rule of that name's mirror image."""
    if isinstance(rule, str):
        return MIRRORED[rule]
    name = f"adjoint of {rule.name}"
    if rule.takes_time:
        return UserFunction(lambda t, q0, q1, h, params: sign * rule(t + h, q1, q0, -h, params), name, LD_ARGUMENTS, timed=True)
    return UserFunction(lambda q0, q1, h, params: sign * rule(q1, q0, -h, params), name, LD_ARGUMENTS)


def adjoint_equation(inner: StepEquation) -> StepEquation:
    """The equation of Φ*_h: unknowns (w, u) with x1 = x0 + h w, Φ_{−h}(x1) = x0 by the unknowns u."""
    s = inner.state_size

    def target(u, state, h):
        return state + h * u[:s]

    def residual(u, state, t, h, params):
        end = target(u, state, h)
        back = inner.advance(u[s:], end, t + h, -h, params)
        return jnp.concatenate([(back - state) / h, inner.residual(u[s:], end, t + h, -h, params)])

    def start(data, h, params):
        state, u = inner.start(data, -h, params)
        return state, jnp.concatenate([(state - inner.advance(u, state, data.get("t", 0.0), -h, params)) / h, u])

    def unpack(state, u, t, h, params):
        return inner.unpack(state, u[s:], t, h, params)

    def guess(state, previous, h, params):
        return jnp.concatenate([previous[:s], inner.guess(target(previous, state, h), previous[s:], -h, params)])

    return StepEquation(
        start=start,
        residual=residual,
        advance=lambda u, state, t, h, params: target(u, state, h),
        unpack=unpack,
        guess=guess,
        state_size=s,
        unknowns=s + inner.unknowns,
        fields=inner.fields,
        scale=(1.0,) * s + inner.scale,
        labels=tuple(f"adjoint: component {i} of the state" for i in range(s)) + inner.labels,
        needs_leaving_step=inner.needs_leaving_step,
        canonical=inner.canonical,
        check=lambda data, h, params: inner.check(data, -h, params),
    )
