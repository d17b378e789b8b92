"""Discrete Lagrange–Dirac schemes: (+), (−) and the general discrete Lagrange–d'Alembert equations they belong to."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.functions import UserFunction
from dirax.reduction.reduced import ReducedLagrangeDirac
from dirax.roots import nearest_root
from dirax.schemes.discrete_lagrangian import (
    CONSTRAINTS,
    RULES,
    checked_rule,
    discrete_constraint,
    discrete_lagrangian,
    slot_derivatives,
)
from dirax.schemes.reduced import lagrange_poincare_dirac
from dirax.schemes.step import AbstractScheme, Field, Shape, StepEquation
from dirax.systems.lagrange_dirac import LagrangeDirac

LD_ARGUMENTS = ("q0", "q1", "h")
MOMENTA = ("incoming", "mean", "outgoing")


class LagrangeDAlembert(AbstractScheme):
    """The discrete Lagrange–d'Alembert equations (Cortés–Martínez) of a discrete Lagrangian and a discrete constraint:

        p_k + D1 L_d(q_k, q_{k+1}) = W(q_k)ᵀ μ_k,   w_d(q_k, q_{k+1}) = 0,   p_{k+1} = D2 L_d(q_k, q_{k+1}).

    `discrete_lagrangian`: "left" h L(q0, Δq/h), "right" h L(q1, Δq/h), "midpoint", "trapezoidal", or a function
    L_d(q0, q1, h[, params]) returning a scalar. `constraint`: W(q) Δq/h at q0 ("left"), q1 ("right") or the midpoint,
    or a function w_d(q0, q1, h[, params]) of shape (m,). The midpoint pair is self-adjoint and of second order.

    `momentum` says what is saved as p at a node where the constraint force jumps: p_k itself ("incoming", the default
    with a one-sided constraint), p_k − W(q_k)ᵀ μ_k = −D1 L_d(q_k, q_{k+1}) ("outgoing"), or the mean of both (default
    otherwise), which has the order of q. Without constraints the three are the same.
    Solvable where [[D2 D1 L_d, Wᵀ], [D2 w_d, 0]] is invertible ([PY] (21)); L itself may be degenerate.
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
        self.discrete_lagrangian = checked_rule(discrete_lagrangian, RULES, "discrete_lagrangian", LD_ARGUMENTS)
        self.constraint = checked_rule(constraint, CONSTRAINTS, "constraint", LD_ARGUMENTS)
        one_sided = self.constraint in ("left", "right")
        self.momentum = momentum or ("incoming" if one_sided else "mean")
        if self.momentum not in MOMENTA:
            raise ValueError(f"momentum must be one of {', '.join(map(repr, MOMENTA))}, but {momentum!r} was given.")

    def step_equation(self, system: Any, shape: Shape) -> StepEquation:
        return discrete_lagrange_dalembert(system, shape, self.discrete_lagrangian, self.constraint, self.momentum)


class PlusLagrangeDirac(AbstractScheme):
    """The (+)-discrete Lagrange–Dirac scheme ([PY] Def 6.7, (53), (58)): the constraint holds at the new point q_{k+1}.

        p_{k+1} = D2 L_d(q_k, q_{k+1}),   p_k + D1 L_d(q_k, q_{k+1}) = W(q_k)ᵀ μ_k,   W(q_{k+1}) (q_{k+1} − q_k)/h = 0.

    `discrete_lagrangian` as in `LagrangeDAlembert`, of which this is the case `constraint="right"`; the paper uses "left".
    First order; on long runs its energy can grow: measure with `dx.verify`.
    """

    discrete_lagrangian: str | UserFunction

    def __init__(self, discrete_lagrangian: str | Callable = "left"):
        self.discrete_lagrangian = checked_rule(discrete_lagrangian, RULES, "discrete_lagrangian", LD_ARGUMENTS)

    def step_equation(self, system: Any, shape: Shape) -> StepEquation:
        if isinstance(system, ReducedLagrangeDirac):
            return lagrange_poincare_dirac(system, shape, self.discrete_lagrangian, +1)
        return discrete_lagrange_dalembert(system, shape, self.discrete_lagrangian, "right", "incoming")


class MinusLagrangeDirac(AbstractScheme):
    """The (−)-discrete Lagrange–Dirac scheme ([PY] Def 6.7, (54), (59)): the constraint holds at the old point q_k.

        p_{k+1} = D2 L_d(q_k, q_{k+1}),   p_k + D1 L_d(q_k, q_{k+1}) = W(q_k)ᵀ μ_k,   W(q_k) (q_{k+1} − q_k)/h = 0.

    `discrete_lagrangian` as in `LagrangeDAlembert`, of which this is the case `constraint="left"`. The p_k of (54),
    −D1 L_d(q_k, q_{k+1}), is the outgoing momentum p_k − W(q_k)ᵀ μ_k; the multipliers printed in [PY] for (−) have the
    opposite sign. First order.
    """

    discrete_lagrangian: str | UserFunction

    def __init__(self, discrete_lagrangian: str | Callable = "left"):
        self.discrete_lagrangian = checked_rule(discrete_lagrangian, RULES, "discrete_lagrangian", LD_ARGUMENTS)

    def step_equation(self, system: Any, shape: Shape) -> StepEquation:
        if isinstance(system, ReducedLagrangeDirac):
            return lagrange_poincare_dirac(system, shape, self.discrete_lagrangian, -1)
        return discrete_lagrange_dalembert(system, shape, self.discrete_lagrangian, "left", "incoming")


def discrete_lagrange_dalembert(system: Any, shape: Shape, rule, constraint, momentum: str) -> StepEquation:
    """The StepEquation of the discrete Lagrange–d'Alembert equations: state (q, p), unknowns (v, μ), q_{k+1} = q_k + h v."""
    if not isinstance(system, LagrangeDirac):
        raise TypeError(
            "this scheme discretizes a dx.LagrangeDirac system (a Lagrangian with one-forms), but a "
            f"{type(system).__name__} was given: use dx.DiscreteDirac for the others."
        )
    n, m = shape.n, shape.m
    if isinstance(constraint, UserFunction) and not m:
        raise ValueError(
            "constraint is a function w_d(q0, q1, h), but the system has no one_forms, whose forces would impose it: "
            "give the system one_forms=, or leave constraint out."
        )
    ld = discrete_lagrangian(system.lagrangian, rule)
    wd = discrete_constraint(system.constraint_matrix, constraint, m)
    share = {"incoming": 0.0, "mean": 0.5, "outgoing": 1.0}[momentum] if m else 0.0

    def residual(u, state, t, h, params):
        q, p, v = state[:n], state[n:], u[:n]
        d1, _ = slot_derivatives(ld, q, v, h, params)
        if not m:
            return p + d1
        force = system.constraint_matrix(q, params).T @ u[n:]
        return jnp.concatenate([p + d1 - force, wd(q, v, h, params)])

    def advance(u, state, t, h, params):
        q, v = state[:n], u[:n]
        _, d2 = slot_derivatives(ld, q, v, h, params)
        # outside the domain of L its derivatives can still be numbers: those of log q are, for q < 0
        inside = jnp.isfinite(system.lagrangian(q + h * v, v, params))
        return jnp.concatenate([q + h * v, jnp.where(inside, d2, jnp.nan)])

    def unpack(state, u, t, h, params):
        q, p = state[:n], state[n:]
        if not m:
            return {"q": q, "p": p}
        jump = system.constraint_matrix(q, params).T @ u[n:]
        saved = p - share * jump if share else p
        return {"q": q, "p": saved, "multipliers": u[n:], "constraint": wd(q, u[:n], h, params)}

    def start(data, h, params):
        if "q0" in data:
            q, v = data["q0"], (data["q1"] - data["q0"]) / h
            d1, _ = slot_derivatives(ld, q, v, h, params)
            return jnp.concatenate([q, -d1]), jnp.concatenate([v, jnp.zeros(m)])
        state = jnp.concatenate([data["q"], data["p"]])
        u = jnp.concatenate([data["v"], jnp.zeros(m)])
        if share:
            state, u = _start_from_saved_momentum(residual, system.constraint_matrix, share, n, state, u, h, params)
        return state, u

    fields = {"q": Field((n,)), "p": Field((n,))}
    if m:
        fields["multipliers"] = Field((m,), "step", ("constraint",), "Lagrange multipliers of the constraints")
        fields["constraint"] = Field((m,), "step", ("constraint",), "discrete constraint w_d(q_k, q_{k+1})")
    return StepEquation(
        start=start,
        residual=residual,
        advance=advance,
        unpack=unpack,
        state_size=2 * n,
        unknowns=n + m,
        fields=fields,
        labels=tuple(f"discrete Lagrange–d'Alembert equation {i}" for i in range(n))
        + tuple(f"discrete constraint {r}" for r in range(m)),
        needs_leaving_step=bool(share),
        canonical=True,
    )


def _start_from_saved_momentum(residual, constraint_matrix, share: float, n: int, state, u, h, params):
    """The incoming momentum whose saved momentum p − share·Wᵀμ is the given one: solve the first step once for μ."""
    first = nearest_root(lambda u: residual(u, state, 0.0, h, params), u)
    jump: Float[Array, " n"] = constraint_matrix(state[:n], params).T @ first[n:]
    # with incoming p + s/(1−s) j the multiplier is μ/(1−s), and its share is taken off again; at s = 1 nothing is added
    factor = share / (1.0 - share) if share < 1.0 else 0.0
    scaled = first[n:] * (1.0 + factor)
    incoming = state.at[n:].add(factor * jump)
    finite = jax.numpy.all(jnp.isfinite(first))
    return jnp.where(finite, incoming, state), jnp.where(finite, jnp.concatenate([first[:n], scaled]), u)
