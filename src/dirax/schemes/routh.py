"""Discrete Routh reduction: the momentum μ is fixed and the group variable eliminated, n − dim G unknowns a step."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import jaxprs_in_params
from jaxtyping import Array, Float

from dirax.functions import UserFunction, is_traced
from dirax.reduction.reduced import ReducedLagrangeDirac
from dirax.schemes.discrete_lagrangian import RULES, checked_rule
from dirax.schemes.quotient import Quotient
from dirax.schemes.reduced_lagrangian import ReducedDiscreteLagrangian
from dirax.schemes.step import AbstractScheme, Shape, StepEquation

NEWTON_STEPS = 6
"""Newton steps for γ where L is not quadratic in it; the step that carries h ẋ carries their error with it."""

SAMPLES = 5


class DiscreteRouth(AbstractScheme):
    """The discrete Routh equations on the quotient: γ from ∂l_d/∂γ(x_k, ẋ, γ) = μ, and the discrete Euler–Lagrange
    equations of the discrete Routhian r_μ(x_k, ẋ) = l_d − ⟨μ, hγ⟩ in the shape alone.

    `discrete_lagrangian` as in `PlusLagrangeDirac`, whose trajectory on a system made by `dx.reduce` this is, to roundoff.
    γ has a closed form where L is quadratic in the group velocity (found from L itself), else Newton's method is unrolled
    from the γ of the step before. The group inertia ∂²l_d/∂γ² must be invertible: where it is not, μ is a singular value.
    """

    discrete_lagrangian: str | UserFunction

    def __init__(self, discrete_lagrangian: str | Callable = "midpoint"):
        self.discrete_lagrangian = checked_rule(discrete_lagrangian, RULES, "discrete_lagrangian")

    def step_equation(self, system: Any, shape: Shape) -> StepEquation:
        if not isinstance(system, ReducedLagrangeDirac):
            raise TypeError(
                f"dx.DiscreteRouth steps a system made by dx.reduce, but a {type(system).__name__} was given: name its "
                "symmetry, dx.reduce(system, dx.LinearConnection(fibre=[…]))."
            )
        moved = [f"the forces of the {shape.m + shape.c} constraints"] * bool(shape.m + shape.c)
        moved += ["the forces f(t, q, v)"] * (system.system.forces is not None)
        if moved:
            raise ValueError(f"dx.DiscreteRouth fixes μ, which {' and '.join(moved)} may move: use dx.LagrangeDAlembert.")
        return discrete_routh(system, shape, self.discrete_lagrangian)


def discrete_routh(system: ReducedLagrangeDirac, shape: Shape, rule) -> StepEquation:
    """The StepEquation of the discrete Routh equations: state (x, w, μ, g, γ), unknowns ẋ (n − k,)."""
    quotient, l = Quotient(system.connection, shape.n), ReducedDiscreteLagrangian(system, shape.n, rule)
    connection, k, s = system.connection, quotient.k, quotient.s

    def equation(t, x, rate, gamma, h, params):
        """∂l/∂γ, and the group inertia ∂²l/∂γ² (k, k) as its columns."""
        along = lambda gamma: l.momentum(t, x, rate, gamma, h, params)
        columns = [jax.jvp(along, (gamma,), (unit,)) for unit in jnp.eye(k)]
        return columns[0][0], [column for _, column in columns]

    quadratic: dict[Any, bool] = {}  # by the structure of params

    @jax.custom_jvp
    def vertical(t, x, rate, mu, guess, h, params):
        """γ with ∂l/∂γ = μ."""

        def update(gamma):
            momentum, columns = equation(t, x, rate, gamma, h, params)
            return gamma + solve_small(columns, mu - momentum)

        structure = jax.tree.structure(params)
        if structure not in quadratic:
            inertia = lambda *values: jnp.stack(equation(*values)[1])
            quadratic[structure] = independent(inertia, 3, (t, x, rate, guess, h, params))
        if quadratic[structure]:
            return update(jnp.zeros_like(guess))
        gamma = guess
        for _ in range(NEWTON_STEPS):
            gamma = update(gamma)
        return gamma

    @vertical.defjvp
    def derivative(primals, tangents):
        """By the implicit function theorem: no derivative of the inertia, and none of Newton's steps."""
        t, x, rate, _, _, h, params = primals
        gamma = vertical(*primals)
        along = lambda t, x, rate, h, params: l.momentum(t, x, rate, gamma, h, params)
        others = lambda values: tuple(values[i] for i in (0, 1, 2, 5, 6))
        change = jax.jvp(along, others(primals), others(tangents))[1]
        return gamma, solve_small(equation(t, x, rate, gamma, h, params)[1], tangents[3] - change)

    def split(state):
        return quotient.split(state[: 2 * shape.n]), state[2 * shape.n :]

    def residual(u, state, t, h, params):
        (x, w, mu, _), guess = split(state)
        # the derivatives of the Routhian are those of l at fixed γ, since ∂l/∂γ = μ
        return w + l.slots(t, x, u, vertical(t, x, u, mu, guess, h, params), h, params)[0]

    def advance(u, state, t, h, params):
        (x, _, mu, g), guess = split(state)
        gamma = vertical(t, x, u, mu, guess, h, params)
        inside = l.finite(t, x, u, gamma, h, params)
        w = jnp.where(inside, l.slots(t, x, u, gamma, h, params)[1], jnp.nan)
        return jnp.concatenate([x + h * u, w, mu, g + h * quotient.group_rate(x, u, gamma, h), gamma])

    def unpack(state, u, t, h, params):
        (x, w, mu, g), guess = split(state)
        return {"x": x, "w": w, "mu": mu, "g": g, "vertical": h * vertical(t, x, u, mu, guess, h, params)}

    def start(data, h, params):
        if "q0" in data:
            (x, g), (x1, g1) = connection.split(data["q0"]), connection.split(data["q1"])
            rate, t = (x1 - x) / h, data.get("t", 0.0)
            gamma = quotient.vertical(x, rate, (g1 - g) / h, h)
            w, mu = -l.slots(t, x, rate, gamma, h, params)[0], l.momentum(t, x, rate, gamma, h, params)
        else:
            (x, g), (rate, along) = connection.split(data["q"]), connection.split(data["v"])
            gamma = quotient.vertical(x, rate, along, h)
            _, w, mu = connection.trivialize_covector(data["q"], data["p"])
        return jnp.concatenate([x, w, mu, g, gamma]), rate

    why = "which needs the group inertia ∂²l/∂γ² to be invertible: μ is not to be a singular value of the momentum map"
    return StepEquation(
        start=start,
        residual=residual,
        advance=advance,
        unpack=unpack,
        state_size=2 * shape.n + k,
        unknowns=s,
        fields=quotient.fields(),
        labels=tuple(f"discrete Routh equation {i}, {why}" for i in range(s)),
    )


def solve_small(columns: list[Float[Array, " k"]], right: Float[Array, " k"]) -> Float[Array, " k"]:
    """The solution of the equations with a matrix of these columns; one equation by the reciprocal, whose derivatives need
    no other division."""
    return right * (1.0 / columns[0]) if len(columns) == 1 else jnp.linalg.solve(jnp.stack(columns, axis=1), right)


def independent(function: Callable, argument: int, values: tuple) -> bool:
    """Whether function(*values) does not depend on one of its arguments: a NaN there goes wherever the argument does.

    Never a wrong yes: where a branch of the function could hide the NaN, or nothing can be evaluated, the answer is no.
    Traced values are replaced by random ones.
    """
    random = np.random.default_rng(0)

    def concrete(leaf):
        if not is_traced(leaf):
            return leaf
        kind = np.dtype(leaf.dtype)
        return random.uniform(0.3, 1.7, leaf.shape) if np.issubdtype(kind, np.floating) else np.ones(leaf.shape, kind)

    if _branches(jax.make_jaxpr(function)(*jax.tree.map(concrete, values)).jaxpr):
        return False
    with jax.ensure_compile_time_eval():
        compiled = jax.jit(function)
        for _ in range(SAMPLES):
            sample = list(jax.tree.map(concrete, values))
            sample[argument] = np.full(np.shape(sample[argument]), np.nan)
            result = compiled(*sample)
            if is_traced(result):
                return False
            if np.all(np.isfinite(result)):
                return True
    return False


def _branches(jaxpr) -> bool:
    """Whether real numbers are chosen by conditions anywhere in it."""
    for equation in jaxpr.eqns:
        real = any(jnp.issubdtype(getattr(v.aval, "dtype", bool), jnp.floating) for v in equation.outvars)
        if real and equation.primitive.name in ("select_n", "cond", "while", "scan", "clamp", "sort"):
            return True
        if any(_branches(inner) for inner in jaxprs_in_params(equation.params)):
            return True
    return False
