"""Method 1 of [BLM] for Lagrangians with constraints: the cotangent lift of a discretization map on S_0."""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.numerics.arrays import Data
from dirax.schemes.labels import Labels
from dirax.schemes.lagrangian_step import LagrangianStep
from dirax.schemes.layout import Layout
from dirax.schemes.map_lift import Base, Lift, ThetaLift
from dirax.schemes.part_of_step import PartOfStep


@dataclass(frozen=True, eq=False)
class MethodOneStep(LagrangianStep):
    """The lifted map on p = ∂L/∂q̇, ṗ = ∂L/∂q + f + Wᵀλ, W q̇ + b = 0 ([BLM] §6, (36)–(38)):

        p0 + D₁Bᵀ(h ṗ, p) = 0,   W(q) v + b = 0,   p1 = D₂Bᵀ(h ṗ, p),

    which for the θ map is p0 = p − (1 − θ)h ṗ, p1 = p + θh ṗ at q = q0 + θh q̇ and the time t + θh. Unknowns are q1 in a local
    parametrization at q0, as a velocity, and λ. Without constraints these are the discrete Euler–Lagrange equations of
    L_d = h L(B(q0, q1)/h), also for degenerate L. Of holonomic constraints the Dirac structure has their distribution,
    G q̇ + ∂g/∂t = 0 at the base point: the midpoint map keeps quadratic g.
    """

    lift: Lift | ThetaLift

    @property
    def unknowns(self) -> Layout:
        return Layout(velocity=self.lift.dimension, multipliers=self.rows.count)

    @property
    def canonical(self) -> bool:
        return self.lift.flat and super().canonical

    @property
    def one_sided(self) -> bool:
        return isinstance(self.lift, ThetaLift) and self.lift.theta != 0.5

    @property
    def labels(self) -> Labels:
        balance = Labels.numbered("momentum balance {}", self.lift.dimension)
        return balance + tuple(f"constraint {r} at the base point" for r in self.rows.kept)

    def start(self, data: Data, h: Any, params: Any) -> tuple[Float[Array, " s"], Float[Array, " k"]]:
        if "q0" not in data:
            guess = self.unknowns.join(velocity=self.lift.components(data["q"], data["v"]))
            return self.book.start(data["q"], data["p"]), guess
        if self.rows.count:
            raise ValueError("with constraints this scheme starts from q= with v= or p=, not from two points.")
        q0, u = data["q0"], self.lift.change(data["q0"], data["q1"]) / h
        at, rate, momentum = self._at_base(u, q0, data.get("t", 0.0), h, params)
        return self.book.start(q0, self.lift.first_momentum(at, rate, momentum, h)), u

    def residual(self, u, state, t, h, params):
        q0, p0, _ = self.state.split(state)
        at, rate, momentum = self._at_base(u, q0, t, h, params)
        balance = self.lift.balance(p0, at, rate, momentum, h)
        if not self.rows.count:
            return balance
        return jnp.concatenate([balance, self.rows.velocity_defect(at.t, at.q, at.v, params)])

    def advance(self, u, state, t, h, params):
        q0, p0, _ = self.state.split(state)
        at, rate, momentum = self._at_base(u, q0, t, h, params)
        p1 = self.lift.last_momentum(p0, at, rate, momentum, h)
        return self.book.after(state, [at.q1, p1], at.t, at.q, at.v, h, params)

    def unpack(self, state, u, t, h, params):
        row = self.row(state)
        return row | ({"multipliers": self.rows.all(self.unknowns.split(u).multipliers)} if "multipliers" in self.fields else {})

    def _at_base(self, u: Array, q0: Array, t: Any, h: Any, params: Any) -> tuple[Base, Array, Array]:
        """The base point, and (ṗ, p) there."""
        velocity, multipliers = self.unknowns.split(u)
        return self._rates_at(self.lift.step(q0, velocity, t, h), multipliers, params)

    def _rates_at(self, at: Base, multipliers: Array, params: Any) -> tuple[Base, Array, Array]:
        rate, momentum = self.rates(at.t, at.q, at.v, params)
        if self.rows.count:
            rate = rate + self.rows.force(at.t, at.q, multipliers, params)
        return at, rate, momentum


@dataclass(frozen=True, eq=False)
class MethodOnePart(PartOfStep):
    """The step of `inner` as a part of a composed step, from a momentum on the constraints to one on them, by a symmetric
    projection (Hairer 2000): it leaves p_k + [W; G](q_k)ᵀσ, and from where it arrives [W; G](q_{k+1})ᵀσ is taken off,

        p_{k+1} = ∂L/∂v(q_{k+1}, v̂),   W v̂ + b = 0,   G v̂ + ∂g/∂t = 0.

    The inner step turns what is off the constraints in p into its opposite, which is no flow: no composition makes it smaller.
    Projected it is a map of the constraints to themselves, self-adjoint where the inner step is, with the multipliers λ.
    """

    inner: MethodOneStep

    @property
    def one_sided(self) -> bool:
        return self.inner.one_sided

    @property
    def unknowns(self) -> Layout:
        return Layout(inner=self.inner.unknowns.size, end_v=self.inner.lift.dimension, sigma=self.rows.count)

    @property
    def labels(self) -> Labels:
        return self.inner.labels + Labels.numbered("projection of the momentum {}", self.inner.lift.dimension + self.rows.count)

    def pushed(self, state: Array, sigma: Array, t: Any, params: Any) -> Float[Array, " s"]:
        """The state with p + [W; G](q)ᵀσ."""
        q, p, _ = self.state.split(state)
        return self.state.replace(state, p=p + self.rows.force(t, q, sigma, params))

    def residual(self, u, state, t, h, params):
        inner, end_v, sigma = self.unknowns.split(u)
        q1, p1, _ = self.state.split(self.advance(u, state, t, h, params))
        missed = self.inner.residual(inner, self.pushed(state, sigma, t, params), t, h, params)
        return jnp.concatenate([missed, self.projected(t + h, self.state.split(state).q, q1, end_v, p1, params)])

    def projected(self, t: Any, q0: Array, q1: Array, end_v: Array, p1: Array, params: Any) -> Array:
        """`projection` at q1, on a manifold in tangent vectors there."""
        lift = self.inner.lift
        if isinstance(lift, ThetaLift) or lift.flat:
            return self.projection(t, q1, end_v, p1, params)
        tangents = lift.tangents(q0, q1)
        covector, defect = jnp.split(self.projection(t, q1, tangents @ end_v, p1, params), [q1.size])
        return jnp.concatenate([tangents.T @ covector, defect])

    def advance(self, u, state, t, h, params):
        inner, _, sigma = self.unknowns.split(u)
        end = self.inner.advance(inner, self.pushed(state, sigma, t, params), t, h, params)
        return self.pushed(end, -sigma, t + h, params)

    def unpack(self, state, u, t, h, params):
        return self.inner.unpack(state, self.unknowns.split(u).inner, t, h, params)

    def start(self, data, h, params):
        state, u = self.inner.start(data, h, params)
        return state, self.unknowns.join(inner=u, end_v=self.inner.lift.components(data["q"], data["v"]))
