"""Hamilton–Dirac systems: a Hamiltonian on T*Q, possibly degenerate, with constraints on velocities."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Float

from dirax.numerics.arrays import Data, Numbers
from dirax.program.roots import nearest_root
from dirax.program.tracing import gradient
from dirax.program.user_functions import UserFunction
from dirax.systems.constraints import Constraints
from dirax.systems.forms import RelationForm
from dirax.systems.magnitudes import as_large_as_kinetic
from dirax.systems.shape import Shape
from dirax.systems.system import AbstractSystem, refuse_start


class HamiltonDirac(AbstractSystem):
    """q̇ = ∂H/∂p, ṗ = −∂H/∂q + W(q)ᵀλ, W(q) q̇ = 0: (X, dH) ∈ D_Δ for the Dirac structure that Δ = ker W induces on T*Q
    ([PY] (25), and the Hamiltonian side that its conclusions announce).

    `hamiltonian([t, ]q, p[, params])` returns a scalar, and may be degenerate in p; `one_forms([t, ]q[, params])` is W of
    shape (m, n). Data are q= and p= of shape (n,); W ∂H/∂p = 0 must hold, or `project=True` moves p along im Wᵀ.

        sleigh = dx.HamiltonDirac(lambda q, p: p @ p / 2, lambda q: jnp.stack([jnp.sin(q[2]), -jnp.cos(q[2]), 0.0])[None])

    `dx.PlusHamiltonDirac` and `dx.MinusHamiltonDirac` step it, and `dx.DiscreteDirac` where its step is regular. For regular L it
    is the `dx.LagrangeDirac` of the Legendre transform. Raises as `dx.LagrangeDirac` for functions of wrong shapes.
    """

    hamiltonian: UserFunction
    one_forms: UserFunction | None

    def __init__(self, hamiltonian: Callable, one_forms: Callable | None = None):
        self.hamiltonian = UserFunction(hamiltonian, "hamiltonian", ("q", "p"), timed=True)
        self.one_forms = Constraints.of(one_forms, None, None).one_forms

    @property
    def constraints(self) -> Constraints:
        return Constraints(self.one_forms, None, None)

    def slopes(
        self, t: Any, q: Float[Numbers, " n"], p: Float[Numbers, " n"], params: Any
    ) -> tuple[Float[Numbers, " n"], Float[Numbers, " n"]]:
        """(∂H/∂q, ∂H/∂p)."""
        return gradient(lambda q, p: self.hamiltonian.at(t, q, p, params), (0, 1))(q, p)

    def hamiltonian_form(self) -> "HamiltonDirac":
        return self

    def relation_form(self, shape: Shape) -> RelationForm:
        """(q̇ − ∂H/∂p, ṗ + ∂H/∂q − Wᵀλ, W q̇) on x = (q, p)."""
        n = shape.n // 2

        def relation(x, velocity, multipliers, t, params):
            of_q, of_p = self.slopes(t, x[:n], x[n:], params)
            force = velocity[n:] + of_q
            if not shape.m:
                return jnp.concatenate([velocity[:n] - of_p, force])
            rows = shape.pick(self.constraints.one_forms_at(t, x[:n], params))
            return jnp.concatenate([velocity[:n] - of_p, force - rows.T @ multipliers, rows @ velocity[:n]])

        labels = tuple(f"constraint {a} at the base point" for a in shape.kept)
        return RelationForm(
            relation, len(shape.kept), labels, shape.m, shape.spread, canonical=not shape.m, dirac="(ẋ, dH) ∈ D_Δ", explicit=True
        )

    def sizes(self, data: Data, params: Any) -> tuple[int, int]:
        """(2n, m)."""
        refuse_start(self, data, "q, p", "x")
        q, p = self.halves(data)
        if q.shape != p.shape:
            raise ValueError(f"q and p must have the same length, but q has shape {q.shape} and p {p.shape}.")
        found = self.hamiltonian.shape(*self.hamiltonian.given(data.get("t", jnp.zeros(())), q, p, params))
        if found.shape != ():
            raise ValueError(f"hamiltonian must return a scalar, but it returned shape {found.shape}.")
        return 2 * q.shape[0], self.constraints.sizes(q, params)[0]

    def complete(self, data: Data, params: Any, project: bool) -> Data:
        (q, p), t = self.halves(data), data.get("t", 0.0)
        if project and self.one_forms is not None:
            along = self.constraints.one_forms_at(t, q, params).T
            p = p + along @ nearest_root(
                lambda sigma: self.momentum_defect(t, q, p + along @ sigma, params), jnp.zeros(along.shape[1])
            )
        of_q, of_p = self.slopes(t, q, p, params)
        x, velocity = jnp.concatenate([q, p]), jnp.concatenate([of_p, -of_q])
        return {"q": q, "p": p, "v": of_p, "x": x, "velocity": velocity}

    def initial_defect(self, data: Data, params: Any) -> Float[Numbers, " m"]:
        """W ∂H/∂p."""
        return self.momentum_defect(data.get("t", 0.0), data["q"], data["p"], params)

    def sizes_of_data(self, data: Data, params: Any) -> Data:
        """Each momentum as large as the kinetic energy makes it."""
        t, q, p = data.get("t", 0.0), data["q"], data["p"]
        velocity = lambda p: self.slopes(t, q, p, params)[1]
        return {name: jnp.abs(a) for name, a in data.items()} | {"p": jnp.abs(p) + as_large_as_kinetic(velocity, p)}

    def momentum_defect(
        self, t: Any, q: Float[Numbers, " n"], p: Float[Numbers, " n"], params: Any = None
    ) -> Float[Numbers, " m"]:
        """W(q) ∂H/∂p(q, p), zero where the velocity lies in Δ."""
        if self.one_forms is None:
            return jnp.zeros(0)
        return self.constraints.one_forms_at(t, q, params) @ self.slopes(t, q, p, params)[1]

    @property
    def projected(self) -> str:
        return "p by the forces of the constraint"

    def energy_at(self, row: Data, params: Any) -> Float[Numbers, ""]:
        """H(q, p)."""
        return self.hamiltonian.at(row["t"], *self.halves(row), params)

    def constraint_at(self, row: Data, params: Any) -> Float[Numbers, " m"]:
        """W ∂H/∂p."""
        return self.momentum_defect(row["t"], *self.halves(row), params)

    def halves(self, data: Data) -> tuple[Float[Numbers, " n"], Float[Numbers, " n"]]:
        """(q, p) of initial data or of a saved row, which may hold x = (q, p) instead."""
        if "q" in data:
            return data["q"], data["p"]
        n = data["x"].shape[0] // 2
        if data["x"].shape != (2 * n,):
            raise ValueError(f"x = (q, p) must have an even length, but it has shape {data['x'].shape}.")
        return data["x"][:n], data["x"][n:]

    def point(self, data: Data) -> Numbers:
        return self.halves(data)[0]
