"""Nonholonomic mechanics: a metric, a potential and constraint one-forms, as a closed port-Hamiltonian system."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dirax.functions import UserFunction, compiled, is_traced
from dirax.systems.constraints import Constraints
from dirax.systems.lagrange_dirac import LagrangeDirac
from dirax.systems.system import AbstractSystem

SYMMETRIC = 1e-10
"""Smallest eigenvalue and largest asymmetry of a metric, relative to its largest entry."""


class NonholonomicMechanics(AbstractSystem):
    """H = ½ pᵀ g(q)⁻¹ p + V(q) with μ(q) q̇ = 0, the closed port-Hamiltonian system with B = (0; μᵀ) ([BLM] §8).

    `metric(q[, params])` (n, n), symmetric positive definite; `potential(q[, params])` a scalar; `one_forms(q[, params])`
    (m, n). q̇ = g⁻¹p, ṗ = −∂H/∂q + μᵀ λ, μ g⁻¹ p = 0. `forces` is added as in `LagrangeDirac`; holonomic constraints and
    explicit time are those of the `LagrangeDirac` system that `lagrange_dirac` returns.
    """

    metric: UserFunction
    potential: UserFunction
    one_forms: UserFunction
    forces: UserFunction | None = None

    def __init__(self, metric: Callable, potential: Callable, one_forms: Callable, *, forces: Callable | None = None):
        self.forces = None if forces is None else UserFunction(forces, "forces", ("t", "q", "v"))
        self.metric = UserFunction(metric, "metric", ("q",))
        self.potential = UserFunction(potential, "potential", ("q",))
        self.one_forms = UserFunction(one_forms, "one_forms", ("q",))

    def lagrangian(self, q: Float[Array, " n"], v: Float[Array, " n"], params: Any = None) -> Float[Array, ""]:
        """½ vᵀ g(q) v − V(q)."""
        return v @ self.metric(q, params) @ v / 2 - self.potential(q, params)

    def lagrange_dirac(self) -> LagrangeDirac:
        """The same system as a Lagrangian with constraints."""
        function = self.forces
        forces = None if function is None else lambda t, q, v, params: function(t, q, v, params)
        return LagrangeDirac(self.lagrangian, lambda q, params: self.one_forms(q, params), forces=forces)

    @property
    def closed_form(self) -> bool:
        """Whether λ and the projector of Method 2 have their closed form ([BLM] §8): no forces."""
        return self.forces is None

    @property
    def constraints(self) -> Constraints:
        """The constraints, as functions of (t, q, params)."""
        return Constraints(self.one_forms, None, None)

    def sizes(self, data: dict[str, Array], params: Any) -> tuple[int, ...]:
        q = data["q"] if "q" in data else data["q0"]
        n = q.shape[0]
        metric = self.metric.shape(q, params)
        if metric.shape != (n, n):
            raise ValueError(f"metric must return shape ({n}, {n}), but it returned shape {metric.shape}.")
        if not is_traced(q, params):
            _check_metric(np.asarray(compiled(self.metric, q, params)))
        if self.potential.shape(q, params).shape != ():
            raise ValueError(f"potential must return a scalar, but it returned shape {self.potential.shape(q, params).shape}.")
        return self.lagrange_dirac().sizes(data, params)

    def complete(self, data: dict[str, Array], params: Any, project: bool) -> dict[str, Array]:
        return self.lagrange_dirac().complete(data, params, project)

    def initial_defect(self, data: dict[str, Array], params: Any) -> Float[Array, " m"]:
        return self.lagrange_dirac().initial_defect(data, params)

    def hamiltonian(self, q: Float[Array, " n"], p: Float[Array, " n"], params: Any = None) -> Float[Array, ""]:
        """½ pᵀ g(q)⁻¹ p + V(q)."""
        return p @ jnp.linalg.solve(self.metric(q, params), p) / 2 + self.potential(q, params)

    def projector(self, q: Float[Array, " n"], p: Float[Array, " n"], params: Any = None) -> Float[Array, " n"]:
        """P_q(p) = p − C_ab (g^{ij} p_j μ^a_i) μ^b: onto the momenta with μ g⁻¹ p = 0 ([BLM] §8)."""
        forms = self.one_forms(q, params)
        lifted = jnp.linalg.solve(self.metric(q, params), forms.T)
        return p - forms.T @ jnp.linalg.solve(forms @ lifted, lifted.T @ p)

    def multipliers(self, q: Float[Array, " n"], p: Float[Array, " n"], params: Any = None) -> Float[Array, " m"]:
        """λ(q, p) that keeps μ g⁻¹ p = 0 along the flow ([BLM] (39)): derivatives of the constraint along q̇ and ṗ."""
        dq, dp = jax.grad(self.hamiltonian, argnums=(0, 1))(q, p, params)
        forms = self.one_forms(q, params)
        lifted = jnp.linalg.solve(self.metric(q, params), forms.T)

        def constraint(q, p):
            return self.one_forms(q, params) @ jnp.linalg.solve(self.metric(q, params), p)

        _, rate = jax.jvp(constraint, (q, p), (dp, -dq))
        return -jnp.linalg.solve(forms @ lifted, rate)

    def energy_at(self, row: dict[str, Array], params: Any) -> Float[Array, ""]:
        """H(q, p)."""
        return self.hamiltonian(row["q"], row["p"], params)

    def constraint_at(self, row: dict[str, Array], params: Any) -> Float[Array, " m"]:
        """μ(q) g⁻¹(q) p."""
        q = row["q"]
        return self.one_forms(q, params) @ jnp.linalg.solve(self.metric(q, params), row["p"])


def _check_metric(metric: np.ndarray) -> None:
    """Raise `ValueError` for a metric that is not symmetric and positive definite; not finite ones are refused later."""
    scale = np.abs(metric).max()
    if not np.isfinite(scale):
        return
    if (defect := np.abs(metric - metric.T).max()) > SYMMETRIC * scale:
        raise ValueError(f"metric is not symmetric at the initial point: max |g − gᵀ| = {defect:.3g}; return (g + gᵀ)/2.")
    lowest = float(np.linalg.eigvalsh(metric)[0])
    if lowest <= SYMMETRIC * scale:
        raise ValueError(
            f"metric is not positive definite at the initial point: its lowest eigenvalue is {lowest:.3g}. A degenerate kinetic "
            "energy belongs in dx.LagrangeDirac, whose Lagrangian may be singular."
        )
