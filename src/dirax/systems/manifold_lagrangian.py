"""Lagrangians on a manifold, in ambient coordinates: no angles, no poles."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.geometry.manifolds import AbstractManifold
from dirax.program.roots import nearest_root
from dirax.program.tracing import gradient
from dirax.program.user_functions import UserFunction
from dirax.systems.constraints import no_constraint
from dirax.systems.system import AbstractSystem, refuse_start


class ManifoldLagrangian(AbstractSystem):
    """A Lagrangian on TQ for a manifold Q ⊂ R^N: q is a point of Q, v a tangent vector, both (N,).

    `lagrangian(q, v[, params])` returns a scalar and is used for points and tangent vectors only; `manifold` is a dirax
    manifold such as `dx.Product(dx.Sphere(3), dx.Sphere(3))`. Momenta are covectors, given as the tangent vectors that
    represent them in R^N. It must be regular on Q. Stepped by `dx.InCharts`.
    """

    lagrangian: UserFunction
    manifold: AbstractManifold

    def __init__(self, lagrangian: Callable, manifold: AbstractManifold):
        if not isinstance(manifold, AbstractManifold):
            raise TypeError(f"manifold must be a dirax manifold such as dx.Sphere(3), but {manifold!r} was given.")
        self.lagrangian = UserFunction(lagrangian, "lagrangian", ("q", "v"))
        self.manifold = manifold

    def manifold_form(self) -> "ManifoldLagrangian":
        """The system itself."""
        return self

    def lagrangian_value(self, t: Any, q: Float[Array, " N"], v: Float[Array, " N"], params: Any) -> Float[Array, ""]:
        return self.lagrangian(q, v, params)

    def legendre(self, q: Float[Array, " N"], v: Float[Array, " N"], params: Any = None) -> Float[Array, " N"]:
        """The covector ∂L/∂v restricted to the tangent space at q."""
        return self.manifold.projection(q, gradient(lambda v: self.lagrangian(q, v, params))(v))

    def inverse_legendre(self, q: Float[Array, " N"], p: Float[Array, " N"], params: Any = None) -> Float[Array, " N"]:
        """The tangent vector v at q with legendre(q, v) = p."""
        frame = self.manifold.frame(q)

        def defect(s):
            return frame.T @ (gradient(lambda v: self.lagrangian(q, v, params))(frame @ s) - p)

        return frame @ nearest_root(defect, jnp.zeros(self.manifold.dimension))

    def energy(self, q: Float[Array, " N"], v: Float[Array, " N"], params: Any = None) -> Float[Array, ""]:
        """⟨∂L/∂v, v⟩ − L."""
        value, derivative = jax.value_and_grad(lambda v: self.lagrangian(q, v, params))(v)
        return derivative @ v - value

    def sizes(self, data: dict[str, Array], params: Any) -> tuple[int, int]:
        if set(data) - {"t"} == {"q"}:
            refuse_start(self, data, "q, v", "q, p")
        if "q" not in data:
            raise ValueError(f"a system on a manifold starts from q= with v= or p=, but {', '.join(data)} were given.")
        q = data["q"]
        vectors = [name for name in ("v", "p") if name in data]
        for name in vectors:
            self.manifold.check_tangent(q, data[name], name, point="q")
        if not vectors:
            self.manifold.check_point(q, "q")
        if self.lagrangian.shape(q, q, params).shape != ():
            raise ValueError(f"lagrangian must return a scalar, not shape {self.lagrangian.shape(q, q, params).shape}.")
        return q.shape[0], 0

    def complete(self, data: dict[str, Array], params: Any, project: bool) -> dict[str, Array]:
        q = data["q"]
        if "p" in data:
            return {"q": q, "p": data["p"], "v": self.inverse_legendre(q, data["p"], params)}
        return {"q": q, "v": data["v"], "p": self.legendre(q, data["v"], params)}

    def initial_defect(self, data: dict[str, Array], params: Any) -> Float[Array, "0"]:
        return no_constraint()

    def energy_at(self, row: dict[str, Array], params: Any) -> Float[Array, ""]:
        """The energy at the saved point and momentum."""
        return self.energy(row["q"], self.inverse_legendre(row["q"], row["p"], params), params)

    def constraint_at(self, row: dict[str, Array], params: Any) -> Float[Array, ""]:
        """How far the point is from the manifold."""
        return self.manifold.defect(row["q"])[None]
