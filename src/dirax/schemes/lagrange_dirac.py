"""Discrete Lagrange–Dirac schemes: (+), (−) and the general discrete Lagrange–d'Alembert equations they belong to."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp

from dirax.program.roots import nearest_root
from dirax.program.tracing import once
from dirax.program.user_functions import UserFunction
from dirax.reduction.reduced import ReducedLagrangeDirac
from dirax.schemes.constraint_rows import ConstraintRows, step_constraints
from dirax.schemes.discrete_lagrangian import (
    CONSTRAINTS,
    RULES,
    checked_rule,
    discrete_constraint,
    discrete_forces,
    discrete_lagrangian,
    slot_derivatives,
)
from dirax.schemes.discrete_structure_pairs import LagrangianPairs, structure_on_pairs
from dirax.schemes.reduced import lagrange_poincare_dirac
from dirax.schemes.step import AbstractScheme, Field, Shape, StepEquation
from dirax.schemes.work import WorkBook, work_field
from dirax.systems.lagrange_dirac import LagrangeDirac
from dirax.systems.nonholonomic import as_lagrange_dirac

MOMENTA = {"incoming": 0.0, "mean": 0.5, "outgoing": 1.0}
"""The part of the constraint force at a node that is taken off the incoming momentum before it is saved."""


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

    Holonomic constraints g = 0 hold at every node: p_k + D1 L_d − W(q_k)ᵀ μ_k − G(q_k)ᵀ λ_k = 0, g(q_{k+1}) = 0, the
    (SHAKE) discrete Dirac equations of Δ = ker W ∩ ker G. The saved p is projected along im Gᵀ onto G q̇ + ∂g/∂t = 0
    (RATTLE), which changes nothing in q; without W the map of saved (q, p) is symplectic on the constraint manifold, and
    of second order in q, p and λ for the midpoint and trapezoidal L_d.

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
        self.discrete_lagrangian = checked_rule(discrete_lagrangian, RULES, "discrete_lagrangian")
        self.constraint = checked_rule(constraint, CONSTRAINTS, "constraint")
        one_sided = self.constraint in ("left", "right")
        self.momentum = momentum or ("incoming" if one_sided else "mean")
        if self.momentum not in MOMENTA:
            raise ValueError(f"momentum must be one of {', '.join(map(repr, MOMENTA))}, but {momentum!r} was given.")

    def step_equation(self, system: Any, shape: Shape) -> StepEquation:
        return _on_q_or_quotient(system, shape, self.discrete_lagrangian, self.constraint, self.momentum)

    def discrete_structure(self, system: Any, shape: Shape, step: Any) -> LagrangianPairs | str:
        share = MOMENTA[self.momentum]
        return structure_on_pairs(system, shape, step, self.discrete_lagrangian, self.constraint, share=share)


class PlusLagrangeDirac(AbstractScheme):
    """The (+)-discrete Lagrange–Dirac scheme ([PY] Def 6.7, (53), (58)): the constraint holds at the new point q_{k+1}.

        p_{k+1} = D2 L_d(q_k, q_{k+1}),   p_k + D1 L_d(q_k, q_{k+1}) = W(q_k)ᵀ μ_k,   W(q_{k+1}) (q_{k+1} − q_k)/h = 0.

    `discrete_lagrangian` as in `LagrangeDAlembert`, of which this is the case `constraint="right"`; the paper uses "left".
    First order; on long runs its energy can grow: measure with `dx.verify`.
    """

    discrete_lagrangian: str | UserFunction

    def __init__(self, discrete_lagrangian: str | Callable = "left"):
        self.discrete_lagrangian = checked_rule(discrete_lagrangian, RULES, "discrete_lagrangian")

    def step_equation(self, system: Any, shape: Shape) -> StepEquation:
        return _on_q_or_quotient(system, shape, self.discrete_lagrangian, "right", "incoming")

    def discrete_structure(self, system: Any, shape: Shape, step: Any) -> LagrangianPairs | str:
        return structure_on_pairs(system, shape, step, self.discrete_lagrangian, "right", sign="+")


class MinusLagrangeDirac(AbstractScheme):
    """The (−)-discrete Lagrange–Dirac scheme ([PY] Def 6.7, (54), (59)): the constraint holds at the old point q_k.

        p_{k+1} = D2 L_d(q_k, q_{k+1}),   p_k + D1 L_d(q_k, q_{k+1}) = W(q_k)ᵀ μ_k,   W(q_k) (q_{k+1} − q_k)/h = 0.

    `discrete_lagrangian` as in `LagrangeDAlembert`, of which this is the case `constraint="left"`. The p_k of (54),
    −D1 L_d(q_k, q_{k+1}), is the outgoing momentum p_k − W(q_k)ᵀ μ_k; the multipliers printed in [PY] for (−) have the
    opposite sign. First order.
    """

    discrete_lagrangian: str | UserFunction

    def __init__(self, discrete_lagrangian: str | Callable = "left"):
        self.discrete_lagrangian = checked_rule(discrete_lagrangian, RULES, "discrete_lagrangian")

    def step_equation(self, system: Any, shape: Shape) -> StepEquation:
        return _on_q_or_quotient(system, shape, self.discrete_lagrangian, "left", "incoming", -1)

    def discrete_structure(self, system: Any, shape: Shape, step: Any) -> LagrangianPairs | str:
        return structure_on_pairs(system, shape, step, self.discrete_lagrangian, "left", sign="-")


def _on_q_or_quotient(system: Any, shape: Shape, rule, constraint, momentum: str, sign: int = +1) -> StepEquation:
    """The discrete Lagrange–d'Alembert equations of a system on Q, or on the quotient by its symmetry."""
    if not isinstance(system, ReducedLagrangeDirac):
        return discrete_lagrange_dalembert(as_lagrange_dirac(system), shape, rule, constraint, momentum)
    unreduced = discrete_lagrange_dalembert(system.system, shape, rule, constraint, momentum)
    return lagrange_poincare_dirac(system, shape, unreduced, rule, constraint, sign)


def discrete_lagrange_dalembert(system: Any, shape: Shape, rule, constraint, momentum: str) -> StepEquation:
    """The StepEquation of the discrete Lagrange–d'Alembert equations: state (q, p), with forces (q, p, work); unknowns
    (v, μ, λ) with q_{k+1} = q_k + h v, and with holonomic constraints (v̂, σ) of the projection of the saved momentum."""
    if not isinstance(system, LagrangeDirac):
        raise TypeError(
            "this scheme discretizes a dx.LagrangeDirac or dx.NonholonomicMechanics system (a Lagrangian with constraints), but "
            f"a {type(system).__name__} was given: use dx.DiscreteDirac for the others."
        )
    n, m, rows = shape.n, shape.m, ConstraintRows(system, shape)
    k, holonomic, book = rows.count, rows.holonomic, WorkBook(system, n)
    if isinstance(constraint, UserFunction) and not m:
        raise ValueError(
            "constraint is a function w_d(q0, q1, h), but the system has no one_forms, whose forces would impose it: "
            "give the system one_forms=, or leave constraint out."
        )
    ld = discrete_lagrangian(system.lagrangian, rule)
    wd = discrete_constraint(system.constraints, constraint, m)
    step_constraint = step_constraints(rows, wd)
    impulses = None if system.forces is None else discrete_forces(system.forces, rule)
    share = MOMENTA[momentum] if m else 0.0

    def slots(t, q, v, h, params):
        return once(both_slots)(t, q, v, h, params)

    def both_slots(t, q, v, h, params):
        """(D1 L_d + f_d^−, D2 L_d + f_d^+): a step leaves its first point with minus the one, and arrives with the other."""
        d1, d2 = slot_derivatives(ld, t, q, v, h, params)
        if impulses is None:
            return d1, d2
        first, last = impulses(t, q, v, h, params)
        return d1 + first, d2 + last

    def equations(u, q, p, t, h, params):
        balance = p + slots(t, q, u[:n], h, params)[0]
        if not k:
            return balance
        imposed = rows.pick(step_constraint(t, q, u[:n], h, params, unit=h))  # all in the unit of W v
        return jnp.concatenate([balance - rows.matrix(t, q, params).T @ u[n : n + k], imposed])

    def saved_momentum(u, q, p, t, params):
        """p_k − share·Wᵀμ − Gᵀσ."""
        if share:
            p = p - share * (rows.matrix(t, q, params)[: rows.nonholonomic].T @ u[n : n + rows.nonholonomic])
        return p - rows.holonomic_matrix(t, q, params).T @ u[n + k + n :] if holonomic else p

    def projection(u, q, p, t, params):
        """∂L/∂v(q, v̂) is the saved momentum, and G v̂ + ∂g/∂t = 0."""
        v = u[n + k : n + k + n]
        missed = system.legendre(q, v, params, t) - saved_momentum(u, q, p, t, params)
        return jnp.concatenate([missed, rows.hidden(t, q, v, params)])

    def residual(u, state, t, h, params):
        q, p = state[:n], state[n : 2 * n]
        if not holonomic:
            return equations(u, q, p, t, h, params)
        return jnp.concatenate([equations(u, q, p, t, h, params), projection(u, q, p, t, params)])

    def advance(u, state, t, h, params):
        q, v = state[:n], u[:n]
        _, p1 = slots(t, q, v, h, params)
        # outside the domain of L its derivatives can still be numbers: those of log q are, for q < 0
        inside = jnp.isfinite(system.lagrangian.at(t + h, q + h * v, v, params))
        end = [q + h * v, jnp.where(inside, p1, jnp.nan)]
        return jnp.concatenate(end) if impulses is None else book.add(state, end, sum(impulses(t, q, v, h, params)) @ v)

    def unpack(state, u, t, h, params):
        q, p = state[:n], state[n : 2 * n]
        row = {"q": q, "p": saved_momentum(u, q, p, t, params)}
        if m + rows.c:
            row |= {"multipliers": rows.all(u[n : n + k]), "constraint": step_constraint(t, q, u[:n], h, params)}
        return row | book.row(state)

    def start(data, h, params):
        t = data.get("t", 0.0)
        if "q0" in data:
            q, v = data["q0"], (data["q1"] - data["q0"]) / h
            p, u = -slots(t, q, v, h, params)[0], jnp.concatenate([v, jnp.zeros(k)])
            if holonomic:
                end = jnp.concatenate([v, jnp.zeros(holonomic)])
                end = nearest_root(lambda end: projection(jnp.concatenate([u, end]), q, p, t, params), end)
                u = jnp.concatenate([u, end])
            return book.start(q, p), u
        q, p, v = data["q"], data["p"], data["v"]
        u = jnp.concatenate([v, jnp.zeros(k)])
        if share or holonomic:
            p, u = incoming_momentum(q, p, u, t, h, params)
        return book.start(q, p), u

    def incoming_momentum(q, p, guess, t, h, params):
        """The incoming momentum whose saved momentum is p, with the unknowns of the step that leaves it.

        λ is that of the leaving step and of one that would arrive at (q, p): the whole impulse, of second order here too.
        """
        nonholonomic = slice(n, n + rows.nonholonomic)

        def both(u):
            leaving = equations(u[: n + k], q, p, t, h, params)
            return jnp.concatenate([leaving, arriving(u[n + k :], q, p, t, h, params)]) if holonomic else leaving

        found = nearest_root(both, jnp.tile(guess, 1 + bool(holonomic)))
        found = jnp.where(jnp.all(jnp.isfinite(found)), found, jnp.tile(guess, 1 + bool(holonomic)))
        first, before = found[: n + k], found[n + k :]
        # with incoming p + s/(1−s) Wᵀμ the multiplier is μ/(1−s), and its share is taken off again; at s = 1 nothing is added
        jump = share / (1.0 - share) * first[nonholonomic] if share < 1.0 else 0.0 * first[nonholonomic]
        if not holonomic:
            return p + rows.matrix(t, q, params).T @ jump, first.at[nonholonomic].add(jump)
        sigma = before[n + rows.nonholonomic :]
        jump = jnp.concatenate([jump, sigma])
        return p + rows.matrix(t, q, params).T @ jump, jnp.concatenate([first.at[n:].add(jump), guess[:n], sigma])

    def arriving(u, q, p, t, h, params):
        """The equations of (v, μ, σ) for a step from q − h v on the constraints to (q, p)."""
        before, v = q - h * u[:n], u[:n]
        missed = p - slots(t - h, before, v, h, params)[1] + rows.matrix(t, q, params).T @ u[n:]
        g = rows.constraints.position_defect(t - h, before, params) / h
        return jnp.concatenate([missed, rows.pick(jnp.concatenate([wd(t - h, before, v, h, params), g]))])

    return StepEquation(
        start=start,
        residual=residual,
        advance=advance,
        unpack=unpack,
        state_size=2 * n + book.size,
        unknowns=n + k + (n + holonomic) * bool(holonomic),
        fields={"q": Field((n,)), "p": Field((n,)), **rows.fields(), **work_field(system)},
        labels=tuple(f"discrete Lagrange–d'Alembert equation {i}" for i in range(n))
        + rows.labels()
        + tuple(f"projection of the momentum {i}" for i in range((n + holonomic) * bool(holonomic))),
        needs_leaving_step=bool(share or holonomic),
        canonical=not book.size,
    )
