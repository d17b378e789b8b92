"""Method 1 of [BLM] for Lagrangians by the lift of a map whose inverse is no formula: its base point is among the unknowns."""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.numerics.arrays import Data
from dirax.program.linear_solves import solve
from dirax.program.tracing import gradient, value_along
from dirax.schemes.blm_method_1_step import MethodOneStep
from dirax.schemes.labels import Labels
from dirax.schemes.layout import Layout
from dirax.schemes.map_lift import Base, Lift


@dataclass(frozen=True, eq=False)
class MethodOneForwardStep(MethodOneStep):
    """The equations of Method 1 by R_d in place of its inverse, with w = h v:

        R_d(q, w) = (q0, q1),   DR_d(q, w)ᵀ (−p0, p1) = (h ṗ, p),   W(q) v + b = 0.

    Unknowns are q = φ(h r) and v = Dφ(h r) s in a local parametrization φ at q0, s and r, the components of p1, and λ.
    """

    lift: Lift

    @property
    def unknowns(self) -> Layout:
        d = self.lift.dimension
        return Layout(velocity=d, base=d, end_p=d, multipliers=self.rows.count)

    @property
    def labels(self) -> Labels:
        d = self.lift.dimension
        named = ("where the step begins {}", "momentum balance {}", "momentum at the base point {}")
        equations = sum((Labels.numbered(name, d) for name in named), Labels())
        return equations + tuple(f"constraint {r} at the base point" for r in self.rows.kept)

    def start(self, data: Data, h: Any, params: Any) -> tuple[Float[Array, " s"], Float[Array, " k"]]:
        if "q0" in data:
            raise ValueError("with a map whose inverse is searched for this scheme starts from q= with v= or p=.")
        velocity, frame = self.lift.components(data["q"], data["v"]), self.lift.tangents(data["q"], data["q"])
        momentum = solve(frame.T @ frame, frame.T @ data["p"])
        guess = self.unknowns.join(velocity=velocity, base=self.lift.map.base_fraction * velocity, end_p=momentum)
        return self.book.start(data["q"], data["p"]), guess

    def residual(self, u, state, t, h, params):
        (q0, p0, _), parts, lift = self.state.split(state), self.unknowns.split(u), self.lift
        at, rate, momentum = self._at_base(u, q0, t, h, params)
        p1, point = self._end_p(u, q0, at), lift.manifold.local_parametrization(q0)

        def paired(r, s):
            """⟨(−p0, p1), R_d(q, w)⟩ − ⟨(h ṗ, p), (q, w)⟩ at (q, w) = (φ(r), Dφ(r) s)."""
            q, w = value_along(point, (r,), (s,))
            first, last = lift.map.forward(q, w)
            return p1 @ last - p0 @ first - h * rate @ q - momentum @ w

        by_base, by_velocity = gradient(paired, (0, 1))(h * parts.base, h * parts.velocity)
        begins = lift.components(q0, at.q0 - q0)
        return jnp.concatenate([begins, by_base, by_velocity, self.rows.velocity_defect(at.t, at.q, at.v, params)])

    def advance(self, u, state, t, h, params):
        q0 = self.state.split(state).q
        at, _, _ = self._at_base(u, q0, t, h, params)
        return self.book.after(state, [at.q1, self._end_p(u, q0, at)], at.t, at.q, at.v, h, params)

    def _end_p(self, u: Array, q0: Array, at: Base) -> Float[Array, " N"]:
        """p1."""
        return self.lift.tangents(q0, at.q1) @ self.unknowns.split(u).end_p

    def _at_base(self, u: Array, q0: Array, t: Any, h: Any, params: Any) -> tuple[Base, Array, Array]:
        parts, map = self.unknowns.split(u), self.lift.map
        q, v = value_along(self.lift.manifold.local_parametrization(q0), (h * parts.base,), (parts.velocity,))
        return self._rates_at(Base(t + map.base_fraction * h, q, v, *map.forward(q, h * v)), parts.multipliers, params)
