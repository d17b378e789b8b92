"""Discrete Routh reduction: the momentum μ is fixed and the group variable eliminated, n − dim G unknowns a step."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Literal, jaxprs_in_params
from jaxtyping import Array, Float

from dirax.functions import UserFunction
from dirax.reduction.reduced import ReducedLagrangeDirac
from dirax.schemes.discrete_lagrangian import RULES, checked_rule
from dirax.schemes.reduced import QuotientState, quotient_fields, reduced_discrete_lagrangian
from dirax.schemes.step import AbstractScheme, Shape, StepEquation

NEWTON_STEPS = 6
"""Newton steps for γ where L is not quadratic in it; the step that carries h ẋ carries their error with it."""


class DiscreteRouth(AbstractScheme):
    """The discrete Routh equations on the quotient: γ from ∂l_d/∂γ(x_k, ẋ, γ) = μ, and the discrete Euler–Lagrange
    equations of the discrete Routhian r_μ(x_k, ẋ) = l_d − ⟨μ, hγ⟩ in the shape alone.

    `discrete_lagrangian` as in `PlusLagrangeDirac`, whose trajectory on a system made by `dx.reduce` this is, to roundoff.
    γ has a closed form where L is quadratic in the group velocity (found from L itself), else Newton's method is unrolled
    from the γ of the step before. The group inertia ∂²l_d/∂γ² must be invertible: where it is not, μ is a singular value.
    """

    discrete_lagrangian: str | UserFunction

    def __init__(self, discrete_lagrangian: str | Callable = "midpoint"):
        self.discrete_lagrangian = checked_rule(discrete_lagrangian, RULES, "discrete_lagrangian", ("q0", "q1", "h"))

    def step_equation(self, system: Any, shape: Shape) -> StepEquation:
        if not isinstance(system, ReducedLagrangeDirac):
            raise TypeError(
                f"dx.DiscreteRouth steps a system made by dx.reduce, but a {type(system).__name__} was given: name its "
                "symmetry, dx.reduce(system, dx.LinearConnection(fibre=[…]))."
            )
        if shape.m:
            raise ValueError(
                f"dx.DiscreteRouth fixes μ, which the forces of the {shape.m} constraints move: use dx.PlusLagrangeDirac."
            )
        return discrete_routh(system, shape, self.discrete_lagrangian)


def discrete_routh(system: ReducedLagrangeDirac, shape: Shape, rule) -> StepEquation:
    """The StepEquation of the discrete Routh equations: state (x, w, μ, g, γ), unknowns ẋ (n − k,)."""
    quotient = QuotientState(system.connection, shape.n)
    k, s = quotient.k, quotient.s
    l = reduced_discrete_lagrangian(system, rule, +1)

    def vertical(x, rate, mu, guess, h, params):
        """γ with ∂l/∂γ = h μ, for l of slots (x, ẋ, γ)."""
        slope = lambda gamma: jax.grad(l, argnums=2)(x, rate, gamma, h, params)
        inertia = jax.jacfwd(slope)
        if not _depends(inertia, guess):
            zero = jnp.zeros_like(guess)
            return solve_small(inertia(zero), h * mu - slope(zero))
        gamma = guess
        for _ in range(NEWTON_STEPS):
            gamma = gamma + solve_small(inertia(gamma), h * mu - slope(gamma))
        return gamma

    def split(state):
        return quotient.split(state[: 2 * shape.n]), state[2 * shape.n :]

    def residual(u, state, t, h, params):
        (x, w, mu, _), guess = split(state)
        # the derivatives of the Routhian are those of l at fixed γ, since ∂l/∂γ = hμ
        return w + quotient.slot_derivatives(l, x, u, vertical(x, u, mu, guess, h, params), h, params)[0]

    def advance(u, state, t, h, params):
        (x, _, mu, g), guess = split(state)
        gamma = vertical(x, u, mu, guess, h, params)
        _, d1, _ = quotient.slot_derivatives(l, x, u, gamma, h, params)
        return jnp.concatenate([x + h * u, d1, mu, g + h * quotient.group_rate(x, u, gamma, h), gamma])

    def unpack(state, u, t, h, params):
        (x, w, mu, g), guess = split(state)
        gamma = vertical(x, u, mu, guess, h, params)
        return {"x": x, "w": w, "mu": mu, "g": g, "vertical": h * gamma}

    def start(data, h, params):
        state, u = quotient.start(l, data, h, params)
        return jnp.concatenate([state, u[s:]]), u[:s]

    why = "which needs the group inertia ∂²l/∂γ² to be invertible: μ is not to be a singular value of the momentum map"
    return StepEquation(
        start=start,
        residual=residual,
        advance=advance,
        unpack=unpack,
        state_size=2 * shape.n + k,
        unknowns=s,
        fields=quotient_fields(s, k),
        labels=tuple(f"discrete Routh equation {i}, {why}" for i in range(s)),
    )


def solve_small(matrix: Float[Array, "k k"], right: Float[Array, " k"]) -> Float[Array, " k"]:
    """matrix⁻¹ right; for one equation by the reciprocal, whose derivatives need no other division."""
    return right * (1.0 / matrix[0]) if right.shape[0] == 1 else jnp.linalg.solve(matrix, right)


def _depends(function: Callable, argument: Float[Array, " k"]) -> bool:
    """Whether the result depends on the argument, as far as one can see from the operations (never a wrong no)."""
    jaxpr = jax.make_jaxpr(function)(jax.ShapeDtypeStruct(argument.shape, argument.dtype)).jaxpr
    return any(_flow(jaxpr, [True]))


def _flow(jaxpr, dependent: list[bool]) -> list[bool]:
    """Which outputs of a jaxpr depend on the inputs that are marked."""
    marked = {var for var, is_dependent in zip(jaxpr.invars, dependent, strict=True) if is_dependent}
    reaches = lambda atom: not isinstance(atom, Literal) and atom in marked
    for equation in jaxpr.eqns:
        inputs = [reaches(atom) for atom in equation.invars]
        inner = list(jaxprs_in_params(equation.params))
        if not any(inputs):
            continue
        whole = len(inner) == 1 and equation.primitive.name in ("jit", "pjit", "closed_call")
        outputs = _flow(inner[0], inputs) if whole else [True] * len(equation.outvars)
        marked |= {var for var, is_dependent in zip(equation.outvars, outputs, strict=True) if is_dependent}
    return [reaches(atom) for atom in jaxpr.outvars]
