"""Lagrange–Dirac systems: a Lagrangian, possibly degenerate, with constraints and forces."""

import inspect
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dirax.numerics.arrays import Data, Numbers
from dirax.numerics.equilibration import diagonal_units
from dirax.numerics.tolerances import METRIC_RANK
from dirax.program.linear_solves import scaled_pseudo_inverse, solve
from dirax.program.roots import nearest_root
from dirax.program.tracing import gradient, jacobian, once
from dirax.program.user_functions import UserFunction
from dirax.systems.constraints import Constraints, no_constraint
from dirax.systems.forms import ImplicitForm
from dirax.systems.implicit_lagrangian import implicit_lagrangian
from dirax.systems.magnitudes import as_large
from dirax.systems.system import AbstractSystem, refuse_start


def force_function(forces: Callable, constrained: bool) -> UserFunction:
    """The forces of a user, with or without `multipliers` among their arguments. Raises `ValueError` for forces of constraints
    that there are not."""
    try:
        parameters = inspect.signature(forces).parameters
    except (TypeError, ValueError):
        parameters = {}
    names, given = list(parameters), [p for p in parameters.values() if p.default is p.empty]
    if ("multipliers" in names or len(given) == 5) and names[3:4] != ["multipliers"]:
        raise TypeError(
            "forces that see the multipliers are forces(t, q, v, multipliers[, params]), with an argument of that name in that "
            f"place, and others forces(t, q, v[, params]), but a function of ({', '.join(names)}) was given."
        )
    if names[3:4] != ["multipliers"]:
        return UserFunction(forces, "forces", ("t", "q", "v"))
    if not constrained:
        raise ValueError("forces sees the multipliers of constraints, but there are none: give one_forms= or holonomic=.")
    return UserFunction(forces, "forces", ("t", "q", "v", "multipliers"))


class LagrangeDirac(AbstractSystem):
    """A Lagrangian with constraints ⟨ω^r(q), q̇⟩ = 0: the system (29) of [PY], X ⊕ d_D L ∈ D on T*Q, and with holonomic and
    affine constraints, forces and explicit time.

    `lagrangian(q, v[, params])` returns a scalar; q and v have shape (n,); it may be degenerate.
    `one_forms(q[, params])` returns the matrix W(q) of shape (m, n) whose rows are the constraint one-forms; without
    it there are no nonholonomic constraints. `affine(q[, params])` (m,) makes them W(q) q̇ + b(q) = 0: surfaces that move.
    `holonomic(q[, params])` returns the constraints g(q) = 0, shape (c,). `forces(t, q, v[, params])` is the covector (n,)
    of external, control and dissipative forces; `forces(t, q, v, multipliers[, params])` sees those of the constraints,
    (μ, λ) of shape (m + c,), as friction does: of the equations below, so that their forces are −Wᵀμ − Gᵀλ. They are those of
    the step that the forces act in, found with it. Every other function may take the time too, as its first argument `t`:
    `lagrangian(t, q, v[, params])`.

    Equations, with G = ∂g/∂q: ṗ = ∂L/∂q + f − Wᵀμ − Gᵀλ, p = ∂L/∂v, q̇ = v, W v + b = 0, g = 0.
    Units are the user's: the energy has those of L, p those of L·time/q. The saved multipliers are those of the scheme. Of a
    discrete Lagrange–d'Alembert scheme they are impulses at the row that the step leaves, in L·time over the unit of W q or g:
    over h they are (μ, λ) at that row, up to h² with a scheme of second order; at the first row μ is a part of it, unless the
    saved momentum is the mean (see `momentum` there), and both are 0 after a start from two points. In compositions, and where
    forces see them, they are the impulses of the whole step, over h its means. Of `dx.DiscreteDirac` they are forces of the
    opposite sign, ṗ = … + Wᵀλ, at the base point of the step: its middle, for the midpoint map.

        system = dx.LagrangeDirac(lambda q, v: v @ v / 2, lambda q: jnp.array([[q[1], -q[0], 1.0]]))
        pendulum = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[1], holonomic=lambda q: jnp.array([q @ q - 1.0]))

    Raises `TypeError` for something that is not a function of these arguments, `ValueError` for `affine` without
    `one_forms`.
    """

    lagrangian: UserFunction
    one_forms: UserFunction | None
    holonomic: UserFunction | None = None
    forces: UserFunction | None = None
    affine: UserFunction | None = None

    def __init__(
        self,
        lagrangian: Callable,
        one_forms: Callable | None = None,
        *,
        holonomic: Callable | None = None,
        forces: Callable | None = None,
        affine: Callable | None = None,
    ):
        self.lagrangian = UserFunction(lagrangian, "lagrangian", ("q", "v"), timed=True)
        given = Constraints.of(one_forms, affine, holonomic)
        self.one_forms, self.affine, self.holonomic = given.one_forms, given.affine, given.holonomic
        self.forces = None if forces is None else force_function(forces, given.any)

    @property
    def constraints(self) -> Constraints:
        """All constraints, as functions of (t, q, params)."""
        return Constraints(self.one_forms, self.affine, self.holonomic)

    @property
    def forces_see_multipliers(self) -> bool:
        """Whether the forces depend on those of the constraints."""
        return self.forces is not None and "multipliers" in self.forces.arguments

    def forces_at(self, multipliers: Float[Numbers, " k"] | None) -> Callable | None:
        """The forces (t, q, v, params) ↦ (n,) where the multipliers of the constraints are these; None without forces."""
        forces = self.forces
        if forces is None or not self.forces_see_multipliers or multipliers is None:
            return forces
        return lambda t, q, v, params: forces(t, q, v, multipliers, params)

    @property
    def depends_on_time(self) -> bool:
        """Whether the Lagrangian or a constraint takes the time."""
        functions = (self.lagrangian, self.one_forms, self.holonomic, self.affine)
        return any(f is not None and f.takes_time for f in functions)

    # ------------------------------------------------------------------ geometry of L and W, one point at a time

    def constraint_matrix(self, q: Float[Numbers, " n"], params: Any = None, t: Any = 0.0) -> Float[Numbers, "m n"]:
        """W(q), whose rows are the constraint one-forms; (0, n) without them."""
        return self.constraints.one_forms_at(t, q, params)

    def legendre(
        self, q: Float[Numbers, " n"], v: Float[Numbers, " n"], params: Any = None, t: Any = 0.0
    ) -> Float[Numbers, " n"]:
        """The Legendre transform: p = ∂L/∂v (q, v)."""
        return gradient(lambda v: self.lagrangian.at(t, q, v, params))(v)

    def inverse_legendre(
        self,
        q: Float[Numbers, " n"],
        p: Float[Numbers, " n"],
        params: Any = None,
        guess: Float[Numbers, " n"] | None = None,
        t: Any = 0.0,
    ) -> Float[Numbers, " n"]:
        """A velocity v with ∂L/∂v (q, v) = p; where L is degenerate the one nearest to `guess` (zero by default)."""
        return self._velocity_of_momentum(t, q, p, params, jnp.zeros_like(q) if guess is None else guess)

    @once
    def _velocity_of_momentum(self, t, q, p, params, guess):
        return nearest_root(lambda v: self.legendre(q, v, params, t) - p, guess)

    def energy(self, q: Float[Numbers, " n"], v: Float[Numbers, " n"], params: Any = None, t: Any = 0.0) -> Float[Numbers, ""]:
        """The energy E(q, v) = ⟨∂L/∂v, v⟩ − L(q, v); it is `generalized_energy` on the image of the Legendre transform."""
        return self.generalized_energy(q, v, self.legendre(q, v, params, t), params, t)

    def generalized_energy(
        self, q: Float[Numbers, " n"], v: Float[Numbers, " n"], p: Float[Numbers, " n"], params: Any = None, t: Any = 0.0
    ) -> Float[Numbers, ""]:
        """E(q, v, p) = ⟨p, v⟩ − L(q, v) on the Pontryagin bundle ([PY] (56))."""
        return p @ v - self.lagrangian.at(t, q, v, params)

    # ------------------------------------------------------------------ AbstractSystem

    def lagrangian_form(self) -> "LagrangeDirac":
        """The system itself."""
        return self

    def implicit_form(self, near: Any, params: Any) -> ImplicitForm:
        return implicit_lagrangian(self, self, near, params)

    def sizes(self, data: Data, params: Any) -> tuple[int, ...]:
        """(n, m), or (n, m, c) with holonomic constraints."""
        refuse_start(self, data, "q, v", "q, p", "q0, q1")
        q = data["q"] if "q" in data else data["q0"]
        n, t = q.shape[0], np.zeros(())
        out = self.lagrangian.shape(*self.lagrangian.given(t, q, q, params))
        if out.shape != ():
            raise ValueError(
                f"lagrangian(q, v) must return a scalar, but for q and v of shape ({n},) it returned shape {out.shape}: "
                "sum or index its result."
            )
        if self.forces is not None:
            seen = (np.zeros(sum(self.constraints.sizes(q, params))),) * self.forces_see_multipliers
            out = self.forces.shape(t, q, q, *seen, params)
            if out.shape != (n,):
                call = f"forces({', '.join(self.forces.arguments)})"
                raise ValueError(f"{call} must return shape ({n},), one number a coordinate, but it returned shape {out.shape}.")
        m, c = self.constraints.sizes(q, params)
        return (n, m) if self.holonomic is None else (n, m, c)

    def complete(self, data: Data, params: Any, project: bool) -> Data:
        if "q0" in data:
            return dict(data)
        q, t, constraints = data["q"], data.get("t", 0.0), self.constraints
        project = project and constraints.any
        if "v" in data:
            v = data["v"]
        else:
            v = self.inverse_legendre(q, data["p"], params, data.get("about"), t)
            if constraints.any:
                v = v - jax.lax.stop_gradient(self._undetermined_part(q, v, params, t))
        if project:
            q = self.project_position(q, v, params, t)
            v = self.project_velocity(q, v, params, t)
        keep = "p" in data and not project
        return {"q": q, "v": v, "p": data["p"] if keep else self.legendre(q, v, params, t)}

    def _undetermined_part(self, q, v, params, t):
        """What to take from v to satisfy the constraints without changing ∂L/∂v: nothing where L is regular."""
        hessian = jacobian(gradient(lambda v: self.lagrangian.at(t, q, v, params)))(v)
        kernel = jnp.eye(q.shape[0]) - scaled_pseudo_inverse(hessian) @ hessian
        kernel = jnp.where(jnp.trace(kernel) > 0.5, kernel, 0.0)  # its trace is the number of undetermined directions
        rows, defect = self.constraints.matrix(t, q, params), self.constraints.velocity_defect(t, q, v, params)
        return kernel @ (scaled_pseudo_inverse(rows @ kernel) @ defect)

    def _lifted(self, q, v, rows, params, t):
        """metric⁻¹ rowsᵀ in the metric ∂²L/∂v² where it is positive definite and the Euclidean one elsewhere."""
        hessian = jacobian(gradient(lambda v: self.lagrangian.at(t, q, v, params)))(v)
        units = diagonal_units(hessian, jnp)
        values = jnp.linalg.eigvalsh(hessian / units[:, None] / units[None])
        regular = values[0] > METRIC_RANK * jnp.abs(values[-1])
        return solve(jnp.where(regular, hessian, jnp.eye(q.shape[0])), rows.T)

    def project_velocity(
        self, q: Float[Numbers, " n"], v: Float[Numbers, " n"], params: Any = None, t: Any = 0.0
    ) -> Float[Numbers, " n"]:
        """The velocity with W v + b = 0 and G v + ∂g/∂t = 0 nearest to v, in the metric ∂²L/∂v² where it is positive
        definite and the Euclidean one elsewhere."""
        rows = self.constraints.matrix(t, q, params)
        return self.constraints.nearest_velocity(t, q, v, self._lifted(q, v, rows, params, t), params)

    def project_position(
        self, q: Float[Numbers, " n"], v: Float[Numbers, " n"], params: Any = None, t: Any = 0.0
    ) -> Float[Numbers, " n"]:
        """A point with g = 0 near q, moved along metric⁻¹ Gᵀ, in the metric of `project_velocity`."""
        if self.holonomic is None:
            return q
        lifted = self._lifted(q, v, self.constraints.holonomic_matrix(t, q, params), params, t)
        return self.constraints.nearest_position(t, q, lifted, params)

    def initial_defect(self, data: Data, params: Any) -> Float[Numbers, " k"]:
        """(W v + b, g, G v + ∂g/∂t); g(q0) for two points, whose step has the other constraints."""
        t = data.get("t", 0.0)
        if "q0" in data:
            return no_constraint() if self.holonomic is None else self.constraints.position_defect(t, data["q0"], params)
        return self.constraints.defect(t, data["q"], data["v"], params)

    def initial_terms(self, data: Data, params: Any) -> Float[Numbers, " k"]:
        """The sizes of the terms of `initial_defect`; for two points, of it and of the constraints of their step."""
        return self.constraints.initial_terms(data, params, self.constraint_terms)

    def speeds(self, t: Any, q: Float[Numbers, " n"], v: Float[Numbers, " n"], params: Any) -> Float[Numbers, " n"]:
        """How fast each coordinate would be that had the kinetic energy alone; 0 where L is degenerate in it."""
        return self._as_large(t, q, v, v, params)

    def _as_large(self, t, q, v, x, params):
        """How large each coordinate would be that alone had the length of x in the kinetic metric; 0 where that is degenerate."""
        metric = jacobian(gradient(lambda v: self.lagrangian.at(t, q, v, params)))(v)
        return as_large(metric, x)

    def constraint_terms(self, t: Any, q: Float[Numbers, " n"], v: Float[Numbers, " n"], params: Any) -> Float[Numbers, " k"]:
        """The sizes of the terms of (W v + b, g, G v + ∂g/∂t), for each coordinate as fast as the kinetic energy makes it, and
        where it is zero as large as the others make it."""
        return self.constraints.terms(t, q, v, self.speeds(t, q, v, params), params, self._as_large(t, q, v, q, params))

    @property
    def searches_near(self) -> tuple[str, ...]:
        return ("q",)

    def _velocity(self, row: Data, params: Any) -> Float[Numbers, " n"]:
        """The velocity that belongs to the saved momentum, or the saved one, of schemes that save no momentum."""
        if "v" in row and "p" not in row:
            return row["v"]
        return self.inverse_legendre(row["q"], row["p"], params, row.get("about"), row.get("t", 0.0))

    def energy_at(self, row: Data, params: Any) -> Float[Numbers, ""]:
        """E at the node, with the velocity that belongs to the saved momentum."""
        return self.energy(row["q"], self._velocity(row, params), params, row.get("t", 0.0))

    def constraint_at(self, row: Data, params: Any) -> Float[Numbers, " k"]:
        """(W v + b, g, G v + ∂g/∂t) at the node, with the velocity that belongs to the saved momentum."""
        if not self.constraints.any:
            return no_constraint()
        return self.constraints.defect(row.get("t", 0.0), row["q"], self._velocity(row, params), params)

    @property
    def projected(self) -> str:
        return "q across the constraint by its forces"

    @property
    def energy_changes(self) -> str:
        if self.depends_on_time:
            return "depends on time and does not conserve it"
        return "" if self.affine is None else "has constraints that do work (affine) and does not conserve it"
