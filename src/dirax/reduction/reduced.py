"""Systems on the quotient by an abelian symmetry, and the way back."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dirax.functions import is_traced
from dirax.reduction.connection import LinearConnection
from dirax.systems.lagrange_dirac import LagrangeDirac
from dirax.systems.system import AbstractSystem

INVARIANCE_TOLERANCE = 1e-9


class ReducedLagrangeDirac(AbstractSystem):
    """A Lagrangian system on the quotient (Q × Q)/G ≅ Σ × Σ × G by translations in the fibre ([RL] §4). Made by `dx.reduce`.

    Rows of a trajectory hold x (n − k,), w (n − k,) and mu (k,), the trivialized momentum λ̂_d(q, p) = (x, w, μ), and the
    group coordinate g (k,), a quadrature that `dx.reconstruct` uses.
    """

    system: LagrangeDirac
    connection: LinearConnection

    def sizes(self, data: dict[str, Array], params: Any) -> tuple[int, int]:
        n, m = self.system.sizes(data, params)
        self.connection.check(n)
        if m:
            raise ValueError("reduction of systems with constraints is not available: reduce the unconstrained system.")
        if not is_traced(data, params):
            self._check_invariance(data, params)
        return n, 0

    def _check_invariance(self, data, params) -> None:
        q = data["q"] if "q" in data else data["q0"]
        v = data["v"] if "v" in data else jnp.ones_like(q)
        energy, (force, _) = jax.value_and_grad(lambda q, v: self.system.lagrangian(q, v, params), argnums=(0, 1))(q, v)
        defect = np.abs(np.asarray(force)[list(self.connection.fibre)])
        scale = max(1.0, abs(float(energy)), float(np.max(np.abs(force))))
        if np.max(defect) > INVARIANCE_TOLERANCE * scale:
            worst = self.connection.fibre[int(np.argmax(defect))]
            raise ValueError(
                f"the Lagrangian is not invariant under translation of q[{worst}]: ∂L/∂q[{worst}] = {np.max(defect):.3g} at "
                "the initial data; take that coordinate out of fibre."
            )

    def complete(self, data: dict[str, Array], params: Any, project: bool) -> dict[str, Array]:
        return self.system.complete(data, params, project)

    def initial_defect(self, data: dict[str, Array], params: Any) -> Float[Array, " m"]:
        return self.system.initial_defect(data, params)

    def unreduced_row(self, row: dict[str, Array]) -> dict[str, Array]:
        """The row (q, p) on T*Q over a reduced row."""
        q = self.connection.join(row["x"], row["g"])
        return {"q": q, "p": self.connection.untrivialize_covector(row["w"], row["mu"])}

    def energy_at(self, row: dict[str, Array], params: Any) -> Float[Array, ""]:
        """The energy of the unreduced system, which the group coordinate does not change."""
        return self.system.energy_at(self.unreduced_row(row), params)

    def constraint_at(self, row: dict[str, Array], params: Any) -> Float[Array, " m"]:
        return self.system.constraint_at(self.unreduced_row(row), params)


def reduce(system: LagrangeDirac, connection: LinearConnection) -> ReducedLagrangeDirac:
    """The system on the quotient by the translations of `connection.fibre`; run it with the same q=, v= as `system`.

        reduced = dx.reduce(system, dx.LinearConnection(fibre=[0]))
        sol = dx.reconstruct(dx.simulate(reduced, dx.PlusLagrangeDirac("midpoint"), q=q, v=v, step=0.01, steps=100))

    Raises `TypeError` for other systems; invariance is checked at the start of a run.
    """
    if not isinstance(system, LagrangeDirac):
        raise TypeError(f"dx.reduce takes a dx.LagrangeDirac system, but a {type(system).__name__} was given.")
    if not isinstance(connection, LinearConnection):
        raise TypeError(f"connection must be a dx.LinearConnection(fibre=[…]), but {connection!r} was given.")
    return ReducedLagrangeDirac(system, connection)
