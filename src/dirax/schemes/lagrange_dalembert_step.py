"""One step of the discrete Lagrange–d'Alembert equations on Q: the step of the (+), (−), midpoint and trapezoidal schemes."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.program.roots import nearest_root
from dirax.program.tracing import gradient, once
from dirax.program.user_functions import UserFunction
from dirax.schemes.abstract_step import AbstractStep
from dirax.schemes.constraint_rows import ConstraintRows, step_constraints
from dirax.schemes.discrete_lagrangian import derivatives_by_slots, discrete_constraint, discrete_forces
from dirax.schemes.discrete_lagrangian_premise import ConsistentWith
from dirax.schemes.hermite import hermite
from dirax.schemes.labels import Labels
from dirax.schemes.layout import Layout
from dirax.schemes.step import Field, Shape
from dirax.schemes.work_of_forces import BEYOND, WorkOfForces
from dirax.systems.lagrange_dirac import LagrangeDirac

MOMENTA = {"incoming": 0.0, "mean": 0.5, "outgoing": 1.0}
"""The share of the constraint force at a node that is taken off its incoming momentum p_k before p is saved, by the name of
the momentum."""

PROJECTION = "projection of the momentum"

ONE_SIDED = "left", "right"
"""Quadratures of first order."""


@dataclass(frozen=True, eq=False)
class LagrangeDAlembertStep(AbstractStep):
    """p_k + D1 L_d = Wᵀμ + Gᵀλ, w_d(q_k, q_{k+1}) = 0, g(q_{k+1}) = 0, p_{k+1} = D2 L_d, where D1 L_d and D2 L_d include the
    impulses of forces.

    The state is (q, p, work); the unknowns are v with q_{k+1} = q_k + h v, the multipliers (μ, λ), and with holonomic
    constraints those of the projection of the saved momentum: the velocity v̂ that belongs to it, and σ. Where the mean of the
    momenta before and after Wᵀμ is saved, the p that a run begins at determines the half of μ after it, and a first p_k at which
    the half before it is the same. What that half is more, by a step that would arrive at p, is the part `beyond` of the first
    state, which is added to μ where it is saved.
    Raises `ValueError` for a w_d without one-forms.
    """

    system: LagrangeDirac
    shape: Shape
    rule: str | UserFunction
    constraint: str | UserFunction
    momentum: str
    quadrature: Callable | None = None
    """f_d^± as a function (t, q0, v, h, params), where they are not by the quadrature of L_d."""

    def __post_init__(self):
        if isinstance(self.constraint, UserFunction) and not self.shape.m:
            raise ValueError(
                "constraint is a function w_d(q0, q1, h), but the system has no one_forms, whose forces would impose it: "
                "give the system one_forms=, or leave constraint out."
            )

    # ------------------------------------------------------------------------------------------- what it is made of

    @cached_property
    def rows(self) -> ConstraintRows:
        """The constraints that enter the equations."""
        return ConstraintRows(self.system, self.shape)

    @cached_property
    def work(self) -> WorkOfForces:
        """The state with the work of the forces."""
        return WorkOfForces(self.system, self.shape.n, **({BEYOND: self.rows.nonholonomic} if 0.0 < self.share < 1.0 else {}))

    @cached_property
    def derivatives(self):
        """(D1 L_d, D2 L_d) as a function (t0, q0, v, h, params)."""
        return derivatives_by_slots(self.system.lagrangian, self.rule)

    @cached_property
    def consistent(self) -> ConsistentWith | None:
        """The premise of a discrete Lagrangian of the user's."""
        if not isinstance(self.rule, UserFunction):
            return None
        return ConsistentWith(self.derivatives, gradient(self.system.lagrangian.at, (2, 1)))

    def check(self, data, h, params):
        if self.consistent is not None:
            self.consistent.check(data, h, params)

    @cached_property
    def discrete_constraint(self):
        """w_d as a function (t0, q0, v, h, params)."""
        return discrete_constraint(self.system.constraints, self.constraint, self.shape.m)

    def impulses(self, t, q, v, h, params, of_constraints=None):
        """(f_d^−, f_d^+), for forces; `of_constraints` are the impulses (μ, λ) of the step, for those that see them."""
        if self.quadrature is not None:
            return self.quadrature(t, q, v, h, params)
        seen = None if of_constraints is None else self.rows.all(of_constraints) / h
        forces = self.system.forces_at(seen)
        assert forces is not None
        return discrete_forces(forces, self.rule)(t, q, v, h, params)

    @property
    def projects(self) -> bool:
        """Whether the saved momentum is projected, for holonomic constraints."""
        return self.rows.holonomic > 0

    @property
    def share(self) -> float:
        """The share of Wᵀμ that is taken off p_k before it is saved."""
        return MOMENTA[self.momentum] if self.shape.m else 0.0

    @property
    def state(self) -> Layout:
        return self.work.layout

    @property
    def unknowns(self) -> Layout:
        n, rows = self.shape.n, self.rows
        return Layout(v=n, multipliers=rows.count, saved_v=n if self.projects else 0, sigma=rows.holonomic)

    @property
    def fields(self) -> dict[str, Field]:
        n = self.shape.n
        return {"q": Field((n,)), "p": Field((n,)), **self.rows.fields(), **self.work.fields}

    @property
    def labels(self) -> Labels:
        balance = Labels.numbered("discrete Lagrange–d'Alembert equation {}", self.shape.n)
        projected = self.shape.n + self.rows.holonomic if self.projects else 0
        return balance + self.rows.labels() + Labels.numbered(PROJECTION + " {}", projected)

    @property
    def canonical(self) -> bool:
        return self.state.size == 2 * self.shape.n

    # -------------------------------------------------------------------------------------------------- the equations

    @once
    def slots(self, t, q, v, h, params, of_constraints=None):
        """(D1 L_d + f_d^−, D2 L_d + f_d^+): a step leaves its first point with minus the one, and arrives with the other."""
        d1, d2 = self.derivatives(t, q, v, h, params)
        if self.system.forces is None:
            return d1, d2
        first, last = self.impulses(t, q, v, h, params, of_constraints)
        return d1 + first, d2 + last

    def step_constraint(self, t, q, v, h, params, unit=1.0):
        """(w_d(q0, q1), g(q1)/unit), of all constraints."""
        return step_constraints(self.rows, self.discrete_constraint)(t, q, v, h, params, unit)

    def equations(self, v, multipliers, q, p, t, h, params, of_constraints=None):
        """The balance of momentum and the constraints, all in the unit of W v."""
        balance = p + self.slots(t, q, v, h, params, of_constraints)[0]
        if not self.rows.count:
            return balance
        imposed = self.rows.pick(self.step_constraint(t, q, v, h, params, unit=h))
        return jnp.concatenate([balance - self.rows.force(t, q, multipliers, params), imposed])

    def saved_momentum(self, multipliers, sigma, q, p, t, params):
        """p_k − share·Wᵀμ − Gᵀσ."""
        if self.share:
            count = self.rows.nonholonomic
            p = p - self.share * (self.rows.matrix(t, q, params)[:count].T @ multipliers[:count])
        return p - self.rows.holonomic_force(t, q, sigma, params) if self.projects else p

    def projection(self, saved_v, sigma, multipliers, q, p, t, params):
        """∂L/∂v(q, v̂) is the saved momentum, and G v̂ + ∂g/∂t = 0."""
        missed = self.system.legendre(q, saved_v, params, t) - self.saved_momentum(multipliers, sigma, q, p, t, params)
        return jnp.concatenate([missed, self.rows.hidden(t, q, saved_v, params)])

    def residual(self, u, state, t, h, params):
        u, (q, p, *_) = self.unknowns.split(u), self.state.split(state)
        missed = self.equations(u.v, u.multipliers, q, p, t, h, params)
        if not self.projects:
            return missed
        return jnp.concatenate([missed, self.projection(u.saved_v, u.sigma, u.multipliers, q, p, t, params)])

    def advance(self, u, state, t, h, params, of_constraints=None):
        q, v = self.state.split(state).q, self.unknowns.split(u).v
        _, p1 = self.slots(t, q, v, h, params, of_constraints)
        # outside the domain of L its derivatives can still be numbers: those of log q are, for q < 0
        inside = jnp.isfinite(self.system.lagrangian.at(t + h, q + h * v, v, params))
        end = [q + h * v, jnp.where(inside, p1, jnp.nan)]
        return self.work.add(
            state, end, None if self.system.forces is None else sum(self.impulses(t, q, v, h, params, of_constraints)) @ v
        )

    def unpack(self, state, u, t, h, params):
        u, (q, p, _, *beyond) = self.unknowns.split(u), self.state.split(state)
        row = {"q": q, "p": self.saved_momentum(u.multipliers, u.sigma, q, p, t, params)}
        if self.shape.m + self.shape.c:
            impulses = u.multipliers + jnp.concatenate([*beyond, jnp.zeros(self.rows.holonomic)]) if beyond else u.multipliers
            row |= {"multipliers": self.rows.all(impulses), "constraint": self.step_constraint(t, q, u.v, h, params)}
        return row | self.work.row(state)

    @property
    def hermite(self):
        one_sided = self.rule in ONE_SIDED or (self.shape.m > 0 and self.constraint in ONE_SIDED)
        return hermite(self.system, one_sided)

    # ------------------------------------------------------------------------------------------------------ the start

    def start(self, data, h, params):
        t = data.get("t", 0.0)
        if "q0" in data:
            return self._start_from_two_points(data["q0"], (data["q1"] - data["q0"]) / h, t, h, params)
        q, p, v = data["q"], data["p"], data["v"]
        if self.share or self.projects:
            return self._start_at_saved_momentum(q, p, v, t, h, params)
        return self.work.start(q, p), self.unknowns.join(v=v)

    def resume(self, data, h, params):
        """With the saved momentum, which is p_k modulo the forces of the constraints: the step takes no notice of these."""
        if self.share == 1.0:
            raise ValueError("outgoing momenta do not say by which one the run began.")
        u = self.unknowns.join(v=data["v"], saved_v=data["v"] if self.projects else jnp.zeros(0))
        return self.state.join(q=data["q"], p=data["p"]), u

    def _start_from_two_points(self, q, v, t, h, params):
        p = -self.slots(t, q, v, h, params)[0]
        if not self.projects:
            return self.work.start(q, p), self.unknowns.join(v=v)
        end, none = Layout(saved_v=self.shape.n, sigma=self.rows.holonomic), jnp.zeros(self.rows.count)

        def projection(found):
            saved_v, sigma = end.split(found)
            return self.projection(saved_v, sigma, none, q, p, t, params)

        saved_v, sigma = end.split(nearest_root(projection, end.join(saved_v=v)))
        return self.work.start(q, p), self.unknowns.join(v=v, saved_v=saved_v, sigma=sigma)

    def _start_at_saved_momentum(self, q, p, v, t, h, params) -> tuple[Float[Array, " s"], Float[Array, " k"]]:
        """The first state, with the incoming momentum whose saved momentum is p, and the unknowns of the step that leaves it.

        The impulses at (q, p) are those of the leaving step and of one that would arrive there: of second order here too. Where
        L or the forces are not defined before, it is a step of −h, whose impulses are nearly the opposite ones.
        """
        rows, share, step = self.rows, self.share, Layout(v=self.shape.n, multipliers=self.rows.count)

        def solved(equations, guess):
            found = nearest_root(equations, guess)
            return jnp.where(jnp.all(jnp.isfinite(found)), found, guess)

        def missed(equations, h):
            return lambda u: equations(step.split(u).v, step.split(u).multipliers, q, p, t, h, params)

        guess = step.join(v=v)
        defined = jnp.all(jnp.isfinite(missed(self._arriving, h)(guess)))
        sign = jnp.where(defined, 1.0, -1.0)
        leaves, arrives = missed(self.equations, h), missed(self._arriving, sign * h)

        if self.projects:
            both = lambda u: jnp.concatenate([leaves(u[: step.size]), arrives(u[step.size :])])
            leaving, arriving = jnp.split(solved(both, jnp.tile(guess, 2)), 2)
        else:
            leaving = solved(leaves, guess)
            arriving = solved(arrives, guess) if BEYOND in self.state else guess
        (v1, mu), mu0 = step.split(leaving), sign * step.split(arriving).multipliers
        # with incoming p + s/(1−s) Wᵀμ the multiplier is μ/(1−s), and its share is taken off again; at s = 1 nothing is added
        own, sigma = mu[: rows.nonholonomic], mu0[rows.nonholonomic :]
        jump = share / (1.0 - share) * own if share < 1.0 else 0.0 * own
        beyond = {BEYOND: mu0[: rows.nonholonomic] - jump} if BEYOND in self.state else {}
        projected = {"saved_v": v, "sigma": sigma} if self.projects else {}
        added = jnp.concatenate([jump, sigma])
        state = self.work.start(q, p + rows.force(t, q, added, params), **beyond)
        return state, self.unknowns.join(v=v1, multipliers=mu + added, **projected)

    def _arriving(self, v, multipliers, q, p, t, h, params):
        """The equations of (v, μ, λ) for a step from q − h v on the constraints to (q, p)."""
        rows, before = self.rows, q - h * v
        missed = p - self.slots(t - h, before, v, h, params)[1] + rows.force(t, q, multipliers, params)
        g = rows.constraints.position_defect(t - h, before, params) / h
        imposed = rows.pick(jnp.concatenate([self.discrete_constraint(t - h, before, v, h, params), g]))
        return jnp.concatenate([missed, imposed])
