"""One step of the (±)-Lagrange–Poincaré–Dirac equations: a step on Q seen on the quotient by its symmetry ([RL] (4.6), (4.8))."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import jax.numpy as jnp

from dirax.program.user_functions import UserFunction
from dirax.reduction.reduced import ReducedLagrangeDirac
from dirax.schemes.abstract_step import AbstractStep
from dirax.schemes.lagrange_dalembert_part import LagrangeDAlembertPart
from dirax.schemes.lagrange_dalembert_step import LagrangeDAlembertStep
from dirax.schemes.layout import Layout
from dirax.schemes.quotient_state import Quotient
from dirax.schemes.step import Field


@dataclass(frozen=True, eq=False)
class LagrangePoincareDiracStep(AbstractStep):
    """The step on (Q × Q)/G of a step on Q with state (q, p, …) and unknowns (v, …) that the symmetry leaves alone: [RL] (4.6)
    (sign +1) or (4.8) (sign −1) for the discrete Lagrange–Dirac equations.

    State (x, w, μ, g, …), unknowns (ẋ, γ, …): the equation at (x, 0), for (+), or with the other point at group
    coordinate 0, for (−), its covectors trivialized by λ̂_d: (r_x + A(x)ᵀ r_g, r_g). For linear h_d these are −∂l/∂x0 = w_k,
    ∂l/∂g1 = μ_k, ∂l/∂x1 = w_{k+1}, μ_{k+1} = μ_k, and g_{k+1} = g_k + hγ + A(x_{k+1} − x_k) reconstructs the group coordinate.
    Forces f and constraint forces Wᵀλ have the trivializations ((f_x + A(x)ᵀ f_g), f_g); their group part moves μ.
    A discrete Lagrangian and a discrete constraint that are the user's functions are checked for invariance.
    """

    system: ReducedLagrangeDirac
    unreduced: LagrangeDAlembertStep | LagrangeDAlembertPart
    sign: int = +1

    @property
    def plain(self) -> LagrangeDAlembertStep:
        """The step on Q, where that is a part of a composed step without its projection."""
        return self.unreduced.inner if isinstance(self.unreduced, LagrangeDAlembertPart) else self.unreduced

    @cached_property
    def quotient(self) -> Quotient:
        """Σ × G × g*."""
        return Quotient(self.system.connection, self.unreduced.shape.n)

    @property
    def state(self) -> Layout:
        return Layout(**self.quotient.state, **self.unreduced.state.without("q", "p"))

    @property
    def unknowns(self) -> Layout:
        return Layout(rate=self.quotient.s, vertical=self.quotient.k, **self.unreduced.unknowns.without("v"))

    @property
    def fields(self) -> dict[str, Field]:
        of_q = self.unreduced.fields
        return self.quotient.fields() | {name: field for name, field in of_q.items() if name not in ("q", "p")}

    @property
    def labels(self) -> Sequence[str]:
        horizontal = tuple(f"horizontal equation {i}" for i in range(self.quotient.s))
        vertical = tuple(f"vertical equation {a}" for a in range(self.quotient.k))
        return horizontal + vertical + self.unreduced.labels[self.unreduced.shape.n :]

    def lifted(self, state, u, h):
        """The state and the unknowns on Q, with the start at group coordinate 0 or minus the end."""
        connection, quotient = self.system.connection, self.quotient
        x, w, mu, *_ = self.state.split(state)
        rate, vertical, *_ = self.unknowns.split(u)
        along = quotient.group_rate(x, rate, vertical, h)
        q = connection.join(x, jnp.zeros(quotient.k) if self.sign > 0 else -h * along)
        p = connection.untrivialize_covector(x, w, mu)
        on_q = self.unreduced.state.join(q=q, p=p, **self.state.rest(state, *quotient.state))
        return on_q, self.unreduced.unknowns.join(v=connection.join(rate, along), **self.unknowns.rest(u, "rate", "vertical"))

    def lowered(self, on_q, g):
        """(x, w, μ, g, …) of (q, p, …), g being the group coordinate."""
        connection, layout = self.system.connection, self.unreduced.state
        q, p, *_ = layout.split(on_q)
        _, w, mu = connection.trivialize_covector(q, p)
        return self.state.join(x=connection.split(q)[0], w=w, mu=mu, g=g, **layout.rest(on_q, "q", "p"))

    def residual(self, u, state, t, h, params):
        on_q, v = self.lifted(state, u, h)
        missed = self.unreduced.residual(v, on_q, t, h, params)
        covector = self.unreduced.unknowns.split(missed).v
        _, across, along = self.system.connection.trivialize_covector(self.unreduced.state.split(on_q).q, covector)
        return jnp.concatenate([across, along, missed[covector.size :]])

    def advance(self, u, state, t, h, params):
        on_q, v = self.lifted(state, u, h)
        before, rate = self.state.split(state), self.system.connection.split(self.unreduced.unknowns.split(v).v)[1]
        after = self.lowered(self.unreduced.advance(v, on_q, t, h, params), before.g + h * rate)
        # without forces the equation ∂l/∂g1 = μ_k is the law μ_{k+1} = μ_k
        return self.state.replace(after, mu=before.mu) if self.system.conserves_momentum else after

    def unpack(self, state, u, t, h, params):
        on_q, v = self.lifted(state, u, h)
        row = dict(self.unreduced.unpack(on_q, v, t, h, params))
        here, q = self.state.split(state), self.unreduced.state.split(on_q).q
        row.pop("q")
        _, w, mu = self.system.connection.trivialize_covector(q, row.pop("p"))
        vertical = h * self.unknowns.split(u).vertical
        return {"x": here.x, "w": w, "mu": mu, "g": here.g, "vertical": vertical} | row

    def start(self, data, h, params):
        return self._begun(self.unreduced.start, data, h, params)

    def resume(self, data, h, params):
        return self._begun(self.unreduced.resume, data, h, params)

    def _begun(self, begin, data, h, params):
        """The state and the unknowns of those on Q, begun at group coordinate 0: one-forms may turn along the group."""
        connection, layout = self.system.connection, self.unreduced.unknowns
        _, first = connection.split(data["q"] if "q" in data else data["q0"])
        origin = connection.join(jnp.zeros(self.quotient.s), first)
        state, u = begin({name: a - origin if name in ("q", "q0", "q1") else a for name, a in data.items()}, h, params)
        x, g = connection.split(self.unreduced.state.split(state).q)
        rate, along = connection.split(layout.split(u).v)
        vertical = self.quotient.vertical(x, rate, along, h)
        return self.lowered(state, first + g), self.unknowns.join(rate=rate, vertical=vertical, **layout.rest(u, "v"))

    def check(self, data, h, params):
        own = {"discrete_lagrangian": self.plain.rule, "constraint": self.plain.constraint}
        own = {name: function for name, function in own.items() if isinstance(function, UserFunction)}
        if own:
            self.system.refuse_asymmetric(own, data, h, params)
        if self.plain is not self.unreduced:
            self.system.refuse_moved_one_forms(data, params)
