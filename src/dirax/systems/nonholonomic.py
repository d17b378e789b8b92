"""Mechanics with a metric, a potential and constraints: nonholonomic mechanics as a closed port-Hamiltonian system."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dirax.numerics.arrays import Data, Numbers
from dirax.numerics.equilibration import diagonal_units
from dirax.numerics.tolerances import STRUCTURE_DEFECT
from dirax.program.linear_solves import solve
from dirax.program.user_functions import UserFunction
from dirax.systems.constraints import Constraints
from dirax.systems.forms import ImplicitForm
from dirax.systems.implicit_lagrangian import implicit_lagrangian
from dirax.systems.lagrange_dirac import LagrangeDirac
from dirax.systems.premise import Premise
from dirax.systems.system import AbstractSystem, refuse_start


class NonholonomicMechanics(AbstractSystem):
    """H = ½ pᵀ g(q)⁻¹ p + V(q) with μ(q) q̇ = 0, the closed port-Hamiltonian system with B = (0; μᵀ) ([BLM] §8).

    `metric(q[, params])` (n, n), symmetric positive definite; `potential(q[, params])` a scalar; `one_forms(q[, params])`
    (m, n). q̇ = g⁻¹p, ṗ = −∂H/∂q + μᵀ λ, μ g⁻¹ p = 0. `holonomic`, `forces` and `affine` are those of `LagrangeDirac`, of
    which this is the case L = ½ q̇ᵀ g q̇ − V; every function but the forces may take the time first, as `t`.

        disk = dx.NonholonomicMechanics(metric, potential, one_forms)
        pendulum = dx.NonholonomicMechanics(metric, potential, holonomic=lambda q: jnp.array([q @ q - 1.0]))

    Raises as `LagrangeDirac`, and `ValueError` at the start of a run for a metric that is not symmetric positive definite.
    """

    metric: UserFunction
    potential: UserFunction
    one_forms: UserFunction | None = None
    holonomic: UserFunction | None = None
    forces: UserFunction | None = None
    affine: UserFunction | None = None

    def __init__(
        self,
        metric: Callable,
        potential: Callable,
        one_forms: Callable | None = None,
        *,
        holonomic: Callable | None = None,
        forces: Callable | None = None,
        affine: Callable | None = None,
    ):
        self.metric = UserFunction(metric, "metric", ("q",), timed=True)
        self.potential = UserFunction(potential, "potential", ("q",), timed=True)
        given = Constraints.of(one_forms, affine, holonomic)
        self.one_forms, self.affine, self.holonomic = given.one_forms, given.affine, given.holonomic
        self.forces = None if forces is None else UserFunction(forces, "forces", ("t", "q", "v"))

    def lagrangian(
        self, q: Float[Numbers, " n"], v: Float[Numbers, " n"], params: Any = None, t: Any = 0.0
    ) -> Float[Numbers, ""]:
        """½ vᵀ g(q) v − V(q)."""
        return v @ self.metric.at(t, q, params) @ v / 2 - self.potential.at(t, q, params)

    def _lagrangian_at(self, t, q, v, params=None):
        return self.lagrangian(q, v, params, t)

    def lagrange_dirac(self) -> LagrangeDirac:
        """The same system as a Lagrangian with constraints."""
        timed = self.metric.takes_time or self.potential.takes_time
        return LagrangeDirac(
            self._lagrangian_at if timed else self.lagrangian,
            self.one_forms,
            holonomic=self.holonomic,
            forces=self.forces,
            affine=self.affine,
        )

    def lagrangian_form(self) -> LagrangeDirac:
        return self.lagrange_dirac()

    def metric_form(self) -> "NonholonomicMechanics | None":
        """The system itself, where λ and the projector of Method 2 have their closed form."""
        return self if self.closed_form else None

    def implicit_form(self, near: Any, params: Any) -> ImplicitForm:
        return implicit_lagrangian(self.lagrange_dirac(), self, near, params)

    def project_position(
        self, q: Float[Numbers, " n"], v: Float[Numbers, " n"], params: Any = None, t: Any = 0.0
    ) -> Float[Numbers, " n"]:
        return self.lagrange_dirac().project_position(q, v, params, t)

    def project_velocity(
        self, q: Float[Numbers, " n"], v: Float[Numbers, " n"], params: Any = None, t: Any = 0.0
    ) -> Float[Numbers, " n"]:
        return self.lagrange_dirac().project_velocity(q, v, params, t)

    @property
    def closed_form(self) -> bool:
        """Whether λ and the projector of Method 2 have their closed form ([BLM] §8): one-forms alone, without time."""
        functions = (self.metric, self.potential, self.one_forms)
        alone = self.forces is None and self.holonomic is None and self.affine is None and self.one_forms is not None
        return alone and not any(function is not None and function.takes_time for function in functions)

    @property
    def constraints(self) -> Constraints:
        """The constraints, as functions of (t, q, params)."""
        return Constraints(self.one_forms, self.affine, self.holonomic)

    def sizes(self, data: Data, params: Any) -> tuple[int, ...]:
        refuse_start(self, data, "q, v", "q, p", "q0, q1")
        q = data["q"] if "q" in data else data["q0"]
        n, t = q.shape[0], np.zeros(())
        metric = self.metric.shape(*self.metric.given(t, q, params))
        if metric.shape != (n, n):
            raise ValueError(f"metric must return shape ({n}, {n}), but it returned shape {metric.shape}.")
        potential = self.potential.shape(*self.potential.given(t, q, params))
        if potential.shape != ():
            raise ValueError(f"potential must return a scalar, but it returned shape {potential.shape}.")
        return self.lagrange_dirac().sizes(data, params)

    @property
    def premise_everywhere(self) -> bool:
        return True

    def premise(self, data: Data, params: Any) -> Premise:
        """The metric is symmetric and positive definite."""
        return Premise(self._metric_at, _check_metric)

    def _metric_at(self, data, params):
        return self.metric.at(data.get("t", 0.0), self.point(data), params)

    def complete(self, data: Data, params: Any, project: bool) -> Data:
        return self.lagrange_dirac().complete(data, params, project)

    def initial_defect(self, data: Data, params: Any) -> Float[Numbers, " m"]:
        return self.lagrange_dirac().initial_defect(data, params)

    def initial_terms(self, data: Data, params: Any) -> Float[Numbers, " k"]:
        return self.lagrange_dirac().initial_terms(data, params)

    def hamiltonian(
        self, q: Float[Numbers, " n"], p: Float[Numbers, " n"], params: Any = None, t: Any = 0.0
    ) -> Float[Numbers, ""]:
        """½ pᵀ g(q)⁻¹ p + V(q)."""
        return p @ self.velocity(q, p, params, t) / 2 + self.potential.at(t, q, params)

    def velocity(
        self, q: Float[Numbers, " n"], p: Float[Numbers, " n"], params: Any = None, t: Any = 0.0
    ) -> Float[Numbers, " n"]:
        """g(q)⁻¹ p."""
        return solve(self.metric.at(t, q, params), p)

    def _lifted(self, q, params, t):
        """(μ, g⁻¹μᵀ) with the rows of all constraints, one-forms and derivatives of holonomic ones."""
        rows = self.constraints.matrix(t, q, params)
        return rows, solve(self.metric.at(t, q, params), rows.T)

    def projector(
        self, q: Float[Numbers, " n"], p: Float[Numbers, " n"], params: Any = None, t: Any = 0.0
    ) -> Float[Numbers, " n"]:
        """P_q(p) = p − C_ab (g^{ij} p_j μ^a_i) μ^b: onto the momenta with μ g⁻¹ p = 0 ([BLM] §8), for independent constraints.

        The rows μ are those of W and of ∂g/∂q; with affine or moving constraints the momenta are those with W q̇ + b = 0 and
        G q̇ + ∂g/∂t = 0.
        """
        rows, lifted = self._lifted(q, params, t)
        defect = self.constraints.velocity_defect(t, q, self.velocity(q, p, params, t), params)
        return p - rows.T @ solve(rows @ lifted, defect)

    def multipliers(
        self, q: Float[Numbers, " n"], p: Float[Numbers, " n"], params: Any = None, t: Any = 0.0
    ) -> Float[Numbers, " k"]:
        """λ(q, p) (m + c,) that keeps μ g⁻¹ p = 0 along the flow ([BLM] (39)): derivatives of the constraints along (ṫ, q̇, ṗ)."""
        dq, v = jax.grad(self.hamiltonian, argnums=(0, 1))(q, p, params, t)
        rate = -dq if self.forces is None else self.forces(t, q, v, params) - dq
        rows, lifted = self._lifted(q, params, t)

        def constraint(t, q, p):
            return self.constraints.velocity_defect(t, q, self.velocity(q, p, params, t), params)

        if self.lagrange_dirac().depends_on_time:
            _, rate = jax.jvp(constraint, (jnp.asarray(t, float), q, p), (jnp.ones(()), v, rate))
        else:
            _, rate = jax.jvp(lambda q, p: constraint(t, q, p), (q, p), (v, rate))
        return -solve(rows @ lifted, rate)

    def energy_at(self, row: Data, params: Any) -> Float[Numbers, ""]:
        """H(q, p)."""
        return self.hamiltonian(row["q"], row["p"], params, row.get("t", 0.0))

    def constraint_at(self, row: Data, params: Any) -> Float[Numbers, " k"]:
        """(μ g⁻¹p + b, g, G g⁻¹p + ∂g/∂t) at the node."""
        q, t = row["q"], row.get("t", 0.0)
        return self.constraints.defect(t, q, self.velocity(q, row["p"], params, t), params)

    @property
    def projected(self) -> str:
        return "q across the constraint by its forces"

    @property
    def energy_changes(self) -> str:
        return self.lagrange_dirac().energy_changes


def _check_metric(metric: np.ndarray) -> None:
    """Raise `ValueError` for a metric that is not symmetric and positive definite; not finite ones are refused later."""
    if not np.all(np.isfinite(metric)):
        return
    units = diagonal_units(metric)
    scaled, defect = metric / units / units[:, None], np.abs(metric - metric.T).max()
    if np.abs(scaled - scaled.T).max() > STRUCTURE_DEFECT * np.abs(scaled).max():
        raise ValueError(f"metric is not symmetric at the initial point: max |g − gᵀ| = {defect:.3g}; return (g + gᵀ)/2.")
    lowest = float(np.linalg.eigvalsh(scaled)[0])
    if lowest <= STRUCTURE_DEFECT:
        raise ValueError(
            f"metric is not positive definite at the initial point: its lowest eigenvalue is {lowest:.3g} in units with "
            "±1 on its diagonal. A degenerate kinetic energy belongs in dx.LagrangeDirac, whose Lagrangian may be singular."
        )
