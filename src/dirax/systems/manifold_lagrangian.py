"""Lagrangians on a manifold, in ambient coordinates, with constraints and forces: no angles, no poles."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dirax.geometry.manifolds import AbstractGeodesicManifold, AbstractManifold
from dirax.geometry.products import Product
from dirax.geometry.spaces import AbstractFlat
from dirax.numerics.arrays import Data, Numbers
from dirax.numerics.tolerances import POINT_DEFECT
from dirax.program.legendre import constrained_velocity, moves
from dirax.program.linear_solves import solve
from dirax.program.roots import nearest_root
from dirax.program.tracing import gradient, jacobian
from dirax.program.user_functions import UserFunction, evaluated, is_traced
from dirax.systems.constraints import Constraints, no_constraint
from dirax.systems.lagrange_dirac import LagrangeDirac
from dirax.systems.magnitudes import as_large
from dirax.systems.system import AbstractSystem, refuse_start


class ManifoldLagrangian(AbstractSystem):
    """A Lagrangian on TQ for a manifold Q ⊂ R^N: q is a point of Q, v a tangent vector, both (N,).

    `lagrangian(q, v[, params])` returns a scalar and is used for points and tangent vectors only; `manifold` is a dirax
    manifold such as `dx.Product(dx.Sphere(3), dx.Sphere(3))`. Momenta are covectors, given as the tangent vectors that
    represent them in R^N. It must be regular on Q. `one_forms(q[, params])` (m, N) are the rows of constraints W(q) v = 0 on
    tangent vectors, with `affine(q[, params])` (m,) W(q) v + b(q) = 0; `holonomic(q[, params])` (c,) are constraints g(q) = 0
    of points of Q; `forces(t, q, v[, params])` (N,) is the covector of other forces. Of one-forms and forces only what acts
    on tangent vectors matters, of g its values on Q; one-forms, b and g may take `t` first.

    Stepped by `dx.DiscreteDirac` with a discretization map on Q, and where Q has a retraction by `dx.PlusLagrangeDirac`,
    `dx.MinusLagrangeDirac` and `dx.LagrangeDAlembert`, in charts, with a discrete Lagrangian of one's own too; by `dx.InCharts`
    with that of a map. Reduced by `dx.reduce`: by translations of flat factors or a Lie group that is a factor, in charts of the
    others, on a group alone by it, and where a symmetry is a translation of other coordinates after `dx.in_coordinates`.
    Holonomic constraints are kept at the nodes by `dx.DiscreteDirac` with constraints="resolve".

        ball = dx.ManifoldLagrangian(lambda q, v: v @ v / 2 - q[2], dx.Sphere(3), one_forms=lambda q: a(q)[None])
        dx.simulate(ball, dx.DiscreteDirac(dx.SphereProjection()), q=q, v=v, step=0.01, steps=1000)

    Raises `TypeError` for something that is no manifold, `ValueError` for `affine` without `one_forms`.
    """

    lagrangian: UserFunction
    manifold: AbstractManifold
    one_forms: UserFunction | None
    forces: UserFunction | None
    affine: UserFunction | None
    holonomic: UserFunction | None
    _constraints: Constraints

    def __init__(
        self,
        lagrangian: Callable,
        manifold: AbstractManifold,
        one_forms: Callable | None = None,
        *,
        forces: Callable | None = None,
        affine: Callable | None = None,
        holonomic: Callable | None = None,
    ):
        if not isinstance(manifold, AbstractManifold):
            raise TypeError(f"manifold must be a dirax manifold such as dx.Sphere(3), but {manifold!r} was given.")
        self.lagrangian = UserFunction(lagrangian, "lagrangian", ("q", "v"))
        self.manifold = manifold
        given = Constraints.of(one_forms, affine, holonomic)
        self.one_forms, self.affine, self.holonomic = given.one_forms, given.affine, given.holonomic
        self.forces = None if forces is None else UserFunction(forces, "forces", ("t", "q", "v"))
        tangential = None if given.one_forms is None else _tangential(given.one_forms, manifold)
        self._constraints = Constraints(
            tangential, given.affine, None if given.holonomic is None else _of_points(given.holonomic, manifold)
        )

    @property
    def constraints(self) -> Constraints:
        """The constraints, with the rows of W projected to the tangent space, and g of the nearest point of the manifold: the
        rows of ∂g/∂q are then tangent too."""
        return self._constraints

    @property
    def depends_on_time(self) -> bool:
        """Whether a constraint takes the time."""
        return any(f is not None and f.takes_time for f in (self.one_forms, self.affine, self.holonomic))

    @property
    def manifolds(self) -> dict[str, AbstractManifold]:
        return {"q": self.manifold, "chart": self.manifold}

    def flat_form(self) -> LagrangeDirac | None:
        """The same system in the coordinates of R^N or of a torus, which are those of its points; None on other manifolds."""
        factors = self.manifold.factors if isinstance(self.manifold, Product) else (self.manifold,)
        if not all(isinstance(factor, AbstractFlat) for factor in factors):
            return None
        functions = {"one_forms": self.one_forms, "forces": self.forces, "affine": self.affine, "holonomic": self.holonomic}
        given = {name: function for name, function in functions.items() if function is not None}
        return LagrangeDirac(self.lagrangian, **given)

    def manifold_form(self) -> "ManifoldLagrangian":
        """The system itself."""
        return self

    def lagrangian_value(self, t: Any, q: Float[Numbers, " N"], v: Float[Numbers, " N"], params: Any) -> Float[Numbers, ""]:
        return self.lagrangian(q, v, params)

    # ------------------------------------------------------------------ geometry of L, one point at a time

    def legendre(self, q: Float[Numbers, " N"], v: Float[Numbers, " N"], params: Any = None) -> Float[Numbers, " N"]:
        """The covector ∂L/∂v restricted to the tangent space at q."""
        return self.manifold.projection(q, gradient(lambda v: self.lagrangian(q, v, params))(v))

    def inverse_legendre(
        self, q: Float[Numbers, " N"], p: Float[Numbers, " N"], params: Any = None, guess: Float[Numbers, " N"] | None = None
    ) -> Float[Numbers, " N"]:
        """The tangent vector v at q with legendre(q, v) = p; where there are several, one near `guess` (zero by default)."""
        frame = self.manifold.frame(q)

        def defect(s):
            return frame.T @ (gradient(lambda v: self.lagrangian(q, v, params))(frame @ s) - p)

        return frame @ nearest_root(defect, jnp.zeros(self.manifold.dimension) if guess is None else frame.T @ guess)

    def energy(self, q: Float[Numbers, " N"], v: Float[Numbers, " N"], params: Any = None) -> Float[Numbers, ""]:
        """⟨∂L/∂v, v⟩ − L."""
        value, derivative = jax.value_and_grad(lambda v: self.lagrangian(q, v, params))(v)
        return derivative @ v - value

    def project_position(self, q: Float[Numbers, " N"], v: Float[Numbers, " N"], params: Any = None, t: Any = 0.0) -> Numbers:
        """The point of the manifold with g = 0 near q, moved along the metric's inverse of Gᵀ."""
        q = self.manifold.nearest(q)
        if self.holonomic is None:
            return q
        frame, point = self.manifold.frame(q), self.manifold.local_parametrization(q)
        lifted = self._lifted(q, v, frame, self.constraints.holonomic_matrix(t, q, params), params)
        g = lambda s: self.constraints.position_defect(t, point(lifted @ s), params)
        return point(lifted @ nearest_root(g, jnp.zeros(lifted.shape[1])))

    def _lifted(self, q, v, frame, rows, params):
        """metric⁻¹ rowsᵀ in components of the frame."""
        hessian = jacobian(gradient(lambda v: self.lagrangian(q, v, params)))(v)
        return solve(frame.T @ hessian @ frame, (rows @ frame).T)

    def project_velocity(self, q: Float[Numbers, " N"], v: Float[Numbers, " N"], params: Any = None, t: Any = 0.0) -> Numbers:
        """The tangent vector at q with W v + b = 0 and G v + ∂g/∂t = 0 nearest to v, in the metric ∂²L/∂v² of the tangent
        space."""
        v, frame = self.manifold.projection(q, v), self.manifold.frame(q)
        lifted = frame @ self._lifted(q, v, frame, self.constraints.matrix(t, q, params), params)
        return self.constraints.nearest_velocity(t, q, v, lifted, params)

    # ------------------------------------------------------------------ AbstractSystem

    def sizes(self, data: Data, params: Any) -> tuple[int, ...]:
        """(N, m), or (N, m, c) with holonomic constraints."""
        refuse_start(self, data, "q, v", "q, p", "q0, q1")
        q = self.point(data)
        for name in ("v", "p"):
            if name in data:
                self.manifold.check_tangent(q, data[name], name, point="q")
        if "q0" in data:
            self._check_pair(q, data["q1"])
        if self.lagrangian.shape(q, q, params).shape != ():
            raise ValueError(f"lagrangian must return a scalar, not shape {self.lagrangian.shape(q, q, params).shape}.")
        if self.forces is not None:
            out = self.forces.shape(jnp.zeros(()), q, q, params)
            if out.shape != q.shape:
                raise ValueError(f"forces(t, q, v) must return shape {q.shape} like q, but it returned shape {out.shape}.")
        m, c = Constraints(self.one_forms, self.affine, self.holonomic).sizes(q, params)
        return (q.shape[0], m) if self.holonomic is None else (q.shape[0], m, c)

    def _check_pair(self, q0: Float[Numbers, " N"], q1: Float[Numbers, " N"]) -> None:
        """Raise `ValueError` for points off the manifold, and for a q1 outside the domain of the retraction at q0."""
        manifold = self.manifold
        for name, point in (("q0", q0), ("q1", q1)):
            manifold.check_point(point, name)
        if not isinstance(manifold, AbstractGeodesicManifold) or is_traced(q0, q1):
            return

        def missed(q0, q1):
            back = manifold.retraction(q0, manifold.inverse_retraction(q0, q1))
            return jnp.max(jnp.abs(manifold.representative(back, q1) - q1))

        if not (defect := float(evaluated(missed, q0, q1))) <= POINT_DEFECT * (1.0 + float(np.max(np.abs(q1)))):
            raise ValueError(
                f"q1 must be near q0, in the domain of the inverse retraction of {manifold} at q0, but it is outside: back and "
                f"forth q1 is missed by {defect:.3g}."
            )

    def complete(self, data: Data, params: Any, project: bool) -> Data:
        if "q0" in data:
            return dict(data)
        q, t = data["q"], data.get("t", 0.0)
        v = data["v"] if "v" in data else self.inverse_legendre(q, data["p"], params, data.get("about"))
        if project and self.constraints.any:
            q = self.project_position(q, v, params, t)
            v = self.project_velocity(q, v, params, t)
        keep = "p" in data and not (project and self.constraints.any)
        return {"q": q, "v": v, "p": data["p"] if keep else self.legendre(q, v, params)}

    def initial_defect(self, data: Data, params: Any) -> Float[Numbers, " m"]:
        """(W v + b, g, G v + ∂g/∂t); g(q0) for two points, whose step has the other constraints."""
        t = data.get("t", 0.0)
        if "q0" in data:
            return no_constraint() if self.holonomic is None else self.constraints.position_defect(t, data["q0"], params)
        return self.constraints.defect(t, data["q"], data["v"], params)

    def initial_terms(self, data: Data, params: Any) -> Float[Numbers, " k"]:
        return self.constraints.initial_terms(data, params, self._constraint_terms)

    def _constraint_terms(self, t, q, v, params):
        """Those of (W v + b, g, G v + ∂g/∂t) for components of v, and of q, as large as the kinetic energy makes them."""
        metric = jacobian(gradient(lambda v: self.lagrangian(q, v, params)))(v)
        speed, size = (as_large(metric, a) for a in (v, q))
        return self.constraints.terms(t, q, v, speed, params, size)

    @property
    def searches_near(self) -> tuple[str, ...]:
        return ("q",)

    def energy_at(self, row: Data, params: Any) -> Float[Numbers, ""]:
        """The energy at the saved point and momentum."""
        return self.energy(row["q"], self.inverse_legendre(row["q"], row["p"], params, row.get("about")), params)

    def velocity_at(self, row: Data, params: Any) -> Float[Numbers, " N"]:
        """The tangent vector v that belongs to the momentum at a row, on the constraints on it where L is quadratic in v."""
        q, t, frame = row["q"], row["t"], self.manifold.frame(row["q"])
        along_frame, rest = lambda s: self.lagrangian(q, frame @ s, params), jnp.zeros(self.manifold.dimension)
        if moves(jax.hessian(along_frame), rest):
            return self.inverse_legendre(q, row["p"], params)
        rows, offset = self.constraints.matrix(t, q, params), self.constraints.velocity_defect(t, q, jnp.zeros_like(q), params)
        return frame @ constrained_velocity(along_frame, frame.T @ row["p"], rows @ frame, offset, rest)[0]

    def constraint_at(self, row: Data, params: Any) -> Float[Numbers, " k"]:
        """How far the point is from the manifold, and (W v + b, g, G v + ∂g/∂t) with the velocity of the saved momentum."""
        q, off = row["q"], self.manifold.defect(row["q"])[None]
        if not self.constraints.any:
            return off
        v = self.inverse_legendre(q, row["p"], params, row.get("about"))
        return jnp.concatenate([off, self.constraints.defect(row.get("t", 0.0), q, v, params)])

    @property
    def linearized_as(self) -> str:
        return "state it in coordinates as a dx.LagrangeDirac, or on a group linearize dx.reduce(system, group).lie_poisson()"

    @property
    def projected(self) -> str:
        return "q across the constraint by its forces"

    @property
    def energy_changes(self) -> str:
        if self.depends_on_time:
            return "depends on time and does not conserve it"
        return "" if self.affine is None else "has constraints that do work (affine) and does not conserve it"


def _tangential(one_forms: UserFunction, manifold: AbstractManifold) -> UserFunction:
    """The one-forms as the tangent vectors that represent them on the manifold."""
    rows = lambda q, rows: jax.vmap(lambda row: manifold.projection(q, row))(rows)
    if one_forms.takes_time:
        return UserFunction(lambda t, q, params: rows(q, one_forms(t, q, params)), "one_forms", ("q",), timed=True)
    return UserFunction(lambda q, params: rows(q, one_forms(q, params)), "one_forms", ("q",), timed=True)


def _of_points(holonomic: UserFunction, manifold: AbstractManifold) -> UserFunction:
    """g of the nearest point of the manifold."""
    if holonomic.takes_time:
        return UserFunction(lambda t, q, params: holonomic(t, manifold.nearest(q), params), "holonomic", ("q",), timed=True)
    return UserFunction(lambda q, params: holonomic(manifold.nearest(q), params), "holonomic", ("q",), timed=True)
