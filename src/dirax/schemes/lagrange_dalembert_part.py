"""One step of the discrete Lagrange–d'Alembert equations as a part of a composed step: it ends at the projected momentum."""

from dataclasses import dataclass

import jax.numpy as jnp

from dirax.schemes.labels import Labels
from dirax.schemes.lagrange_dalembert_step import PROJECTION, LagrangeDAlembertStep
from dirax.schemes.layout import Layout
from dirax.schemes.part_of_step import PartOfStep


@dataclass(frozen=True, eq=False)
class LagrangeDAlembertPart(PartOfStep):
    """The step of `inner` from a momentum on the constraints to one on them:

        p_k + D1 L_d = [W; G](q_k)ᵀμ,   w_d = 0,   g(q_{k+1}) = 0,
        p_{k+1} = D2 L_d − [W; G](q_{k+1})ᵀσ = ∂L/∂v(q_{k+1}, v̂),   W v̂ + b = 0,   G v̂ + ∂g/∂t = 0 at q_{k+1}.

    The inner step takes p modulo the constraint forces, so that σ changes nothing in q. The impulse of the step, μ + σ, is
    that of both its ends: with it (q, p, ∫λ dt) is a one-step map, self-adjoint where the inner step is, and a composition
    has its order in all three. Forces that see the multipliers are given the mean of the step, (μ + σ)/h. The state is
    (q, p, work), the unknowns are (v, μ, v̂, σ).
    """

    inner: LagrangeDAlembertStep

    @property
    def unknowns(self) -> Layout:
        n, count = self.inner.shape.n, self.rows.count
        return Layout(v=n, multipliers=count, end_v=n, sigma=count)

    @property
    def labels(self) -> Labels:
        n, count = self.inner.shape.n, self.rows.count
        return self.inner.labels[: n + count] + Labels.numbered(PROJECTION + " {}", n + count)

    def end(self, u, state, t, h, params):
        """(q_{k+1}, p_{k+1})."""
        v, sigma = self.unknowns.split(u).v, self.unknowns.split(u).sigma
        q = self.state.split(state).q
        q1, p1 = q + h * v, self.inner.slots(t, q, v, h, params, self.of_constraints(u))[1]
        return q1, p1 - self.rows.force(t + h, q1, sigma, params)

    def residual(self, u, state, t, h, params):
        v, multipliers, end_v, _ = self.unknowns.split(u)
        q, p, _ = self.state.split(state)
        q1, p1 = self.end(u, state, t, h, params)
        balance = self.inner.equations(v, multipliers, q, p, t, h, params, self.of_constraints(u))
        return jnp.concatenate([balance, self.projection(t + h, q1, end_v, p1, params)])

    def advance(self, u, state, t, h, params):
        work = self.inner.state.split(self.inner.advance(self.of_inner(u), state, t, h, params, self.of_constraints(u)))
        q1, p1 = self.end(u, state, t, h, params)
        # the inner step marks the domain of L in its momentum
        return self.state.join(q=q1, p=jnp.where(jnp.isfinite(work.p), p1, jnp.nan), work=work.work)

    def of_constraints(self, u):
        """The impulses of the constraints at both ends, which forces may see; None for forces that do not."""
        u = self.unknowns.split(u)
        return u.multipliers + u.sigma if self.inner.system.forces_see_multipliers else None

    def of_inner(self, u):
        """The unknowns of the inner step, without its projection."""
        v, multipliers, *_ = self.unknowns.split(u)
        return self.inner.unknowns.join(v=v, multipliers=multipliers)

    def unpack(self, state, u, t, h, params):
        v, multipliers, _, sigma = self.unknowns.split(u)
        q, p, _ = self.state.split(state)
        row = {"q": q, "p": p, "multipliers": self.rows.all(multipliers + sigma)}
        return row | {"constraint": self.inner.step_constraint(t, q, v, h, params)} | self.inner.work.row(state)

    def start(self, data, h, params):
        if "q0" in data:
            raise ValueError(
                "a composition, and a step whose forces see the multipliers, starts from q= with v= or p=, not from two points, "
                "which belong to one step."
            )
        return self.inner.work.start(data["q"], data["p"]), self.unknowns.join(v=data["v"], end_v=data["v"])
