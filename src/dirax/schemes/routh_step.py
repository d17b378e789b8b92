"""One step of the discrete Routh equations: the momentum μ is fixed, and the vertical velocity follows from it."""

from dataclasses import dataclass
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np

from dirax.numerics.tolerances import INERTIA_RANK
from dirax.program.user_functions import evaluated
from dirax.reduction.reduced import ReducedLagrangeDirac
from dirax.schemes.abstract_step import AbstractStep
from dirax.schemes.lagrange_poincare_dirac import LagrangePoincareDiracStep
from dirax.schemes.layout import Layout
from dirax.schemes.quotient_state import Quotient
from dirax.schemes.reduced_discrete_lagrangian import ReducedDiscreteLagrangian
from dirax.schemes.step import Field
from dirax.schemes.vertical_velocity import vertical_velocity

REGULAR = "which needs the group inertia ∂²l/∂γ² to be invertible: μ is not to be a singular value of the momentum map"


@dataclass(frozen=True, eq=False)
class RouthStep(AbstractStep):
    """The `reduced` step without the vertical equations and without γ, which ∂l/∂γ = μ determines.

    State (x, w, μ, g, …, γ), with the γ of the step before; unknowns (ẋ, multipliers, v̂, σ) with ẋ and v̂ (n − k,) of the
    shape.
    """

    reduced: LagrangePoincareDiracStep

    @property
    def system(self) -> ReducedLagrangeDirac:
        """The system on the quotient."""
        return self.reduced.system

    @property
    def quotient(self) -> Quotient:
        """Σ × G × g*."""
        return self.reduced.quotient

    @property
    def projected(self) -> str:
        """The velocity among the unknowns that belongs to a projected momentum: to the saved one, for holonomic constraints, or
        to that at the end of a part of a composed step; empty where none does."""
        return next((name for name in ("saved_v", "end_v") if self.reduced.unknowns.get(name, (0,)) != (0,)), "")

    @cached_property
    def discrete_lagrangian(self) -> ReducedDiscreteLagrangian:
        """l_d as a function of (t, x, ẋ, γ, h, params)."""
        on_q = self.reduced.plain
        return ReducedDiscreteLagrangian(self.system, on_q.shape.n, on_q.rule)

    @property
    def state(self) -> Layout:
        return Layout(**self.reduced.state, vertical=self.quotient.k)

    @property
    def unknowns(self) -> Layout:
        s, whole = self.quotient.s, self.reduced.unknowns
        rest = {"multipliers": whole["multipliers"], "projected_rate": s if self.projected else 0, "sigma": whole["sigma"]}
        return Layout(rate=s, **rest)

    @property
    def fields(self) -> dict[str, Field]:
        return self.reduced.fields

    @property
    def labels(self) -> tuple[str, ...]:
        own = (f"discrete Routh equation {i}, {REGULAR}" for i in range(self.quotient.s))
        of_constraints = self.reduced.labels[self.reduced.unknowns.place("multipliers")]
        projected = range(self.unknowns.size - self.unknowns.place("projected_rate").start)
        return (*own, *of_constraints, *(f"projection of the momentum {i}" for i in projected))

    # ------------------------------------------------------------------------------------------------ the eliminated part

    @cached_property
    def _vertical(self):
        l = self.discrete_lagrangian
        return vertical_velocity(lambda gamma, t, x, rate, h, params: l.momentum(t, x, rate, gamma, h, params), self.quotient.k)

    @cached_property
    def _projected_vertical(self):
        system, connection, k = self.system.unreduced(), self.system.connection, self.quotient.k

        def momentum(along, t, x, rate, params):
            """μ at a point over x, of a velocity (ẋ, ġ)."""
            return connection.split(system.legendre(connection.join(x, jnp.zeros(k)), connection.join(rate, along), params, t))[1]

        return vertical_velocity(momentum, k)

    def vertical(self, u, state, t, h, params):
        """γ with ∂l/∂γ = μ."""
        state = self.state.split(state)
        return self._vertical(state.mu, state.vertical, t, state.x, self.unknowns.split(u).rate, h, params)

    def whole(self, u, state, t, h, params):
        """The unknowns of the reduced step, γ and the group part of v̂ among them."""
        x, _, mu, *_ = self.state.split(state)
        gamma, u = self.vertical(u, state, t, h, params), self.unknowns.split(u)
        parts = {"rate": u.rate, "vertical": gamma, "multipliers": u.multipliers, "sigma": u.sigma}
        if self.projected:
            t, x = (t + h, x + h * u.rate) if self.projected == "end_v" else (t, x)
            guess = self.quotient.group_rate(x, u.projected_rate, gamma, h)
            along = self._projected_vertical(mu, guess, t, x, u.projected_rate, params)
            parts[self.projected] = self.system.connection.join(u.projected_rate, along)
        return self.reduced.unknowns.join(**parts)

    def kept(self, whole):
        """What is kept of the unknowns, or of the equations, of the reduced step."""
        whole = self.reduced.unknowns.split(whole)._asdict()
        kept = {name: whole[name] for name in ("rate", "multipliers", "sigma")}
        if self.projected:
            kept["projected_rate"] = self.system.connection.split(whole[self.projected])[0]
        return self.unknowns.join(**kept)

    def before(self, state):
        """The state of the reduced step."""
        return self.reduced.state.join(**self.state.rest(state, "vertical"))

    # -------------------------------------------------------------------------------------------------- the equations

    def residual(self, u, state, t, h, params):
        if self.system.free:  # the derivatives of the Routhian are those of l at fixed γ, since ∂l/∂γ = μ
            x, w, *_ = self.state.split(state)
            return w + self.discrete_lagrangian.slots(t, x, u, self.vertical(u, state, t, h, params), h, params)[0]
        return self.kept(self.reduced.residual(self.whole(u, state, t, h, params), self.before(state), t, h, params))

    def advance(self, u, state, t, h, params):
        x, _, mu, g, *_ = self.state.split(state)
        if not self.system.free:
            whole = self.whole(u, state, t, h, params)
            after = self.reduced.state.split(self.reduced.advance(whole, self.before(state), t, h, params))
            return self.state.join(**after._asdict() | {"mu": mu}, vertical=self.reduced.unknowns.split(whole).vertical)
        l, gamma = self.discrete_lagrangian, self.vertical(u, state, t, h, params)
        inside = l.finite(t, x, u, gamma, h, params)
        w = jnp.where(inside, l.slots(t, x, u, gamma, h, params)[1], jnp.nan)
        return self.state.join(x=x + h * u, w=w, mu=mu, g=g + h * self.quotient.group_rate(x, u, gamma, h), vertical=gamma)

    def unpack(self, state, u, t, h, params):
        return self.reduced.unpack(self.before(state), self.whole(u, state, t, h, params), t, h, params)

    def start(self, data, h, params):
        state, u = self.reduced.start(data, h, params)
        before, vertical = self.reduced.state.split(state)._asdict(), self.reduced.unknowns.split(u).vertical
        return self.state.join(**before, vertical=vertical), self.kept(u)

    # ------------------------------------------------------------------------------------------------------ the premises

    def group_inertia(self, data, h, params):
        """∂²l/∂γ² (k, k) at initial data, over h."""
        connection = self.system.connection
        q = data["q"] if "q" in data else data["q0"]
        v = (data["q1"] - q) / h if "q1" in data else self.system.complete(data, params, False)["v"]
        (x, _), (rate, along) = connection.split(q), connection.split(v)
        momentum = lambda gamma: self.discrete_lagrangian.momentum(data.get("t", 0.0), x, rate, gamma, h, params)
        return jax.jacfwd(momentum)(self.quotient.vertical(x, rate, along, h))

    def check(self, data, h, params):
        self.reduced.check(data, h, params)
        matrix, k = np.asarray(evaluated(self.group_inertia, data, h, params)), self.quotient.k
        units = np.sqrt(np.max(np.abs(matrix), axis=1))
        scaled = matrix / np.outer(units, units) if np.all(units > 0) else matrix
        rank = int(np.linalg.matrix_rank(scaled, tol=INERTIA_RANK)) if np.all(np.isfinite(scaled)) else k
        if rank < k:
            raise ValueError(
                f"μ has a singular value at the initial data: the group inertia ∂²l_d/∂γ² = {matrix.tolist()} has rank {rank} of "
                f"{k} there, so that ∂l_d/∂γ = μ does not determine γ. Start elsewhere, or use dx.LagrangeDAlembert, which "
                "keeps γ among its unknowns."
            )
        moved = self.system.moves_momentum(data, params)
        if moved:
            raise ValueError(
                f"dx.DiscreteRouth fixes μ, which {moved}; μ then obeys an equation of its own (for constraints the "
                "nonholonomic momentum equation): use dx.LagrangeDAlembert on the reduced system, which solves it."
            )
