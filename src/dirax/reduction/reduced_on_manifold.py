"""Systems on the quotient Σ × 𝔤 of a product Σ × G of manifolds, by the left translations of G ([RL] §6)."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dirax.geometry.manifolds import AbstractManifold
from dirax.numerics.arrays import Data
from dirax.program.user_functions import UserFunction, evaluated
from dirax.reduction.bundle import FactorTranslation, TrivialBundle
from dirax.reduction.reduced import NEARBY, SAMPLES, AbstractReducedSystem
from dirax.reduction.symmetry import discrete_invariance, invariance, times
from dirax.systems.manifold_lagrangian import ManifoldLagrangian


class ReducedManifoldLagrangian(AbstractReducedSystem):
    """A Lagrangian system on the quotient (Q × Q)/G of Q = Σ × G, a product of manifolds in R^N, by the translations of G from
    the left, in charts of Σ ([RL] §6; of a group that is not abelian the discrete Lagrange–Poincaré equations). Made by
    `dx.reduce`.

    Rows of a trajectory hold the point x of Σ and the covector w there (N_Σ,), w = p_x + A(x)ᵀμ with the connection's A;
    `mu` (k,), the body momentum of the group's part, which an abelian group conserves; `g` (N_G,), its element, a quadrature;
    and `chart`, the point of Σ at which the chart in use is centred.
    """

    system: ManifoldLagrangian
    connection: TrivialBundle

    @property
    def action(self) -> FactorTranslation:
        return FactorTranslation(self.connection)

    @property
    def own_fields(self) -> tuple[str, ...]:
        return ("x", "w", "mu", "g", "chart")

    @property
    def conserves_momentum(self) -> bool:
        return self.connection.abelian and self.system.forces is None and self.system.one_forms is None

    @property
    def manifolds(self) -> dict[str, AbstractManifold]:
        bundle = self.connection
        return {"x": bundle.shapes, "g": bundle.group, "chart": bundle.shapes, "q": bundle.manifold}

    def sampled(self, data: Data, params: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """In coordinates of the manifold at the first point."""
        manifold, random = self.system.manifold, np.random.default_rng(0)
        q = jnp.asarray(data["q"] if "q" in data else data["q0"])
        v = jnp.asarray(data["v"]) if "v" in data else manifold.frame(q) @ jnp.ones(manifold.dimension)
        away = np.concatenate(
            [np.zeros((1, 2, manifold.dimension)), NEARBY * random.uniform(-1, 1, (SAMPLES, 2, manifold.dimension))]
        )

        def near(q, v, by):
            point = manifold.local_parametrization(q)(by[0])
            return point, manifold.frame(point) @ (manifold.coordinates(q, v) + by[1])

        points, velocities = evaluated(lambda q, v, away: jax.vmap(near, in_axes=(None, None, 0))(q, v, away), q, v, away)
        return np.asarray(data.get("t", 0.0)) + times(1 + SAMPLES), np.asarray(points), np.asarray(velocities)

    def named(self, generator: int) -> str:
        return f"generator {generator} of {self.connection.group}"

    def along(self, q: Array, covectors: Float[Array, "m n"]) -> Float[Array, "m k"]:
        return jax.vmap(lambda row: self.connection.body(q, row)[1])(covectors)

    def at_identity(self, q: Array, covectors: Float[Array, "m n"]) -> Float[Array, "m d"]:
        return covectors @ self.system.manifold.frame(q)

    def origin_of(self, q: Array) -> Array:
        return self.connection.to_identity(q)[0]

    def unreduced_row(self, row: Data) -> dict[str, Array]:
        bundle = self.connection
        q = bundle.join(row["x"], row["g"])
        p = bundle.covector(q, row["w"] - bundle.shift(row["x"], row["mu"]), row["mu"])
        rest = {name: value for name, value in row.items() if name not in self.own_fields}
        return {"q": q, "p": p, "chart": bundle.join(row["chart"], row["g"])} | rest

    def momentum_map(self, row: Data) -> Float[Array, " k"]:
        """⟨p, ξ g⟩: of a group that is not abelian the spatial momentum Ad*_{g⁻¹}μ."""
        if self.connection.abelian:
            return row["mu"]
        whole = self.unreduced_row(row)
        return self.action.momentum_map(whole["q"], whole["p"])

    def sizes(self, data: Data, params: Any) -> tuple[int, ...]:
        return self.system.sizes(data, params)

    def refuse_asymmetry(self, data: Data, params: Any) -> None:
        found = invariance(self.system, self.action, *self.sampled(data, params), params)
        if not found.ok:
            raise ValueError(
                f"the {found.of} is not invariant under left translations by {self.named(found.generator)}: its derivative "
                f"along them is {found.defect:.3g} at q = {found.q}, v = {found.v}, at or near the initial data; reduce by "
                "another group, or step the system itself."
            )

    def refuse_asymmetric(self, functions: dict[str, UserFunction], data: Data, h: float, params: Any) -> None:
        """Raise `ValueError` where functions of ([t, ]q0, q1, h[, params]) are not invariant, at data that must be concrete."""
        t, q, v = self.sampled(data, params)
        ends = lambda q, v: jax.vmap(self.connection.manifold.retraction)(q, h * v)
        found = discrete_invariance(functions, self.action, t, q, np.asarray(evaluated(ends, q, v)), h, params)
        if not found.ok:
            raise ValueError(
                f"the {found.of} is not invariant under left translations by {self.named(found.generator)}: its derivative "
                f"along them is {found.defect:.3g} at q0 = {found.q}, q1 = {found.v}, at or near the initial data."
            )
