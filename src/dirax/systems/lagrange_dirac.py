"""Lagrange–Dirac systems: a Lagrangian, possibly degenerate, with linear nonholonomic constraints."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.functions import UserFunction
from dirax.roots import nearest_root, scaled_pseudo_inverse
from dirax.systems.system import AbstractSystem, no_constraint


class LagrangeDirac(AbstractSystem):
    """A Lagrangian with constraints ⟨ω^r(q), q̇⟩ = 0: the system (29) of [PY], X ⊕ d_D L ∈ D on T*Q.

    `lagrangian(q, v[, params])` returns a scalar; q and v have shape (n,); it may be degenerate.
    `one_forms(q[, params])` returns the matrix W(q) of shape (m, n) whose rows are the constraint one-forms; without
    it there are no constraints. Equations: ṗ − ∂L/∂q ∈ im W(q)ᵀ, p = ∂L/∂v, q̇ = v, W(q) v = 0.
    Units are the user's: the energy has those of L, p those of L·time/q.

        system = dx.LagrangeDirac(lambda q, v: v @ v / 2, lambda q: jnp.array([[q[1], -q[0], 1.0]]))

    Raises `TypeError` for something that is not a function of these arguments.
    """

    lagrangian: UserFunction
    one_forms: UserFunction | None

    def __init__(self, lagrangian: Callable, one_forms: Callable | None = None):
        self.lagrangian = UserFunction(lagrangian, "lagrangian", ("q", "v"))
        self.one_forms = None if one_forms is None else UserFunction(one_forms, "one_forms", ("q",))

    # ------------------------------------------------------------------ geometry of L and W, one point at a time

    def constraint_matrix(self, q: Float[Array, " n"], params: Any = None) -> Float[Array, "m n"]:
        """W(q), whose rows are the constraint one-forms; (0, n) without constraints."""
        if self.one_forms is None:
            return jnp.zeros((0, q.shape[0]))
        return self.one_forms(q, params)

    def legendre(self, q: Float[Array, " n"], v: Float[Array, " n"], params: Any = None) -> Float[Array, " n"]:
        """The Legendre transform: p = ∂L/∂v (q, v)."""
        return jax.grad(lambda v: self.lagrangian(q, v, params))(v)

    def inverse_legendre(
        self, q: Float[Array, " n"], p: Float[Array, " n"], params: Any = None, guess: Float[Array, " n"] | None = None
    ) -> Float[Array, " n"]:
        """A velocity v with ∂L/∂v (q, v) = p; where L is degenerate the one nearest to `guess` (zero by default)."""
        v0 = jnp.zeros_like(q) if guess is None else guess
        return nearest_root(lambda v: self.legendre(q, v, params) - p, v0)

    def energy(self, q: Float[Array, " n"], v: Float[Array, " n"], params: Any = None) -> Float[Array, ""]:
        """The energy E(q, v) = ⟨∂L/∂v, v⟩ − L(q, v); it is `generalized_energy` on the image of the Legendre transform."""
        return self.generalized_energy(q, v, self.legendre(q, v, params), params)

    def generalized_energy(
        self, q: Float[Array, " n"], v: Float[Array, " n"], p: Float[Array, " n"], params: Any = None
    ) -> Float[Array, ""]:
        """E(q, v, p) = ⟨p, v⟩ − L(q, v) on the Pontryagin bundle ([PY] (56))."""
        return p @ v - self.lagrangian(q, v, params)

    # ------------------------------------------------------------------ AbstractSystem

    def sizes(self, data: dict[str, Array], params: Any) -> tuple[int, int]:
        if "x" in data:
            raise ValueError("a LagrangeDirac system starts from q=, v= · q=, p= · q0=, q1=, but x= was given.")
        q = data["q"] if "q" in data else data["q0"]
        n = q.shape[0]
        out = self.lagrangian.shape(q, q, params)
        if out.shape != ():
            raise ValueError(
                f"lagrangian(q, v) must return a scalar, but for q and v of shape ({n},) it returned shape {out.shape}: "
                "sum or index its result."
            )
        if self.one_forms is None:
            return n, 0
        out = self.one_forms.shape(q, params)
        if len(out.shape) != 2 or out.shape[1] != n or out.shape[0] > n:
            raise ValueError(
                f"one_forms(q) must return an array of shape (m, n) = (m, {n}) with m ≤ {n}, one row a one-form, but it "
                f"returned shape {out.shape}{': put it in another pair of brackets' if len(out.shape) == 1 else ''}."
            )
        return n, out.shape[0]

    def complete(self, data: dict[str, Array], params: Any, project: bool) -> dict[str, Array]:
        if "q0" in data:
            return dict(data)
        q = data["q"]
        if "p" in data:
            p = data["p"]
            v = self.inverse_legendre(q, p, params)
            if self.one_forms is not None:
                v = v - jax.lax.stop_gradient(self._undetermined_part(q, v, params))
            if project and self.one_forms is not None:
                v = self.project_velocity(q, v, params)
                p = self.legendre(q, v, params)
        else:
            v = self.project_velocity(q, data["v"], params) if project and self.one_forms is not None else data["v"]
            p = self.legendre(q, v, params)
        return {"q": q, "v": v, "p": p}

    def _undetermined_part(self, q, v, params):
        """What to take from v to satisfy W v = 0 without changing ∂L/∂v: nothing where L is regular."""
        hessian = jax.hessian(lambda v: self.lagrangian(q, v, params))(v)
        kernel = jnp.eye(q.shape[0]) - scaled_pseudo_inverse(hessian)[0] @ hessian
        kernel = jnp.where(jnp.trace(kernel) > 0.5, kernel, 0.0)  # its trace is the number of undetermined directions
        w = self.constraint_matrix(q, params)
        return kernel @ (scaled_pseudo_inverse(w @ kernel)[0] @ (w @ v))

    def project_velocity(self, q: Float[Array, " n"], v: Float[Array, " n"], params: Any = None) -> Float[Array, " n"]:
        """The velocity in Δ_Q(q) = ker W(q) nearest to v, in the metric ∂²L/∂v² where it is positive definite and the
        Euclidean one elsewhere."""
        w = self.constraint_matrix(q, params)
        hessian = jax.hessian(lambda v: self.lagrangian(q, v, params))(v)
        values = jnp.linalg.eigvalsh(hessian)
        regular = values[0] > 1e-12 * jnp.abs(values[-1])
        metric = jnp.where(regular, hessian, jnp.eye(q.shape[0]))
        lifted = jnp.linalg.solve(metric, w.T)
        return v - lifted @ jnp.linalg.solve(w @ lifted, w @ v)

    def initial_defect(self, data: dict[str, Array], params: Any) -> Float[Array, " m"]:
        if self.one_forms is None or "q0" in data:
            return no_constraint()
        return self.constraint_matrix(data["q"], params) @ data["v"]

    def energy_at(self, row: dict[str, Array], params: Any) -> Float[Array, ""]:
        """E at the node, with the velocity that belongs to the saved momentum."""
        return self.energy(row["q"], self.inverse_legendre(row["q"], row["p"], params), params)

    def constraint_at(self, row: dict[str, Array], params: Any) -> Float[Array, " m"]:
        """W(q) v at the node, with the velocity that belongs to the saved momentum."""
        return self.constraint_matrix(row["q"], params) @ self.inverse_legendre(row["q"], row["p"], params)
