"""A discrete Lagrangian, constraint and force on Q × Q for a manifold Q, in the coordinates of a retraction-compatible chart."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.geometry.charts import RetractionChart
from dirax.geometry.manifolds import AbstractGeodesicManifold, Vector
from dirax.geometry.maps import AbstractDiscretizationMap
from dirax.program.tracing import gradient, jacobian
from dirax.program.user_functions import UserFunction
from dirax.schemes.discrete_lagrangian import LD_ARGUMENTS
from dirax.systems.lagrange_dirac import LagrangeDirac
from dirax.systems.manifold_lagrangian import ManifoldLagrangian

Local = Float[Array, " d"]


class LagrangianInCharts(eqx.Module):
    """L_d, w_d and f_d^± of two points of a manifold, as functions of their coordinates in the chart at a point m ([RL] §6).

    They are stated without coordinates, so that the chart changes nothing but roundoff. A rule is an inverse discretization
    map (q0, q1) ↦ (x, w): that of a dirax map, or by its name, with R the retraction of the manifold,

        "left" (q0, R⁻¹_{q0}(q1)), "right" (q1, −R⁻¹_{q1}(q0)), "midpoint" the middle of the geodesic and its velocity there,

    and L_d = h L(x, w/h), w_d = W(x) w/h + b(x), f_d^± = h (∂x/∂q_i)ᵀ f(x, w/h); "trapezoidal" is the mean of left and right.
    User's functions of (q0, q1, h[, params]) take points of R^N. The functions of this class take `where` = (params, m) in the
    place of params.
    """

    system: ManifoldLagrangian
    manifold: AbstractGeodesicManifold
    rule: str | UserFunction | AbstractDiscretizationMap = eqx.field(static=True)
    constraint_rule: str | UserFunction | AbstractDiscretizationMap = eqx.field(static=True)
    exponential: bool = eqx.field(static=True, default=False)

    def chart(self, m: Vector) -> RetractionChart:
        """The chart centred at m."""
        return RetractionChart(self.manifold, m, self.manifold.frame(m), self.exponential)

    def points(self, where: Any, *coordinates: Local) -> list[Vector]:
        """The points with these coordinates."""
        here = self.chart(where[1])
        return [here.to_manifold(r) for r in coordinates]

    # ------------------------------------------------------------------ the system, and what a step makes of it

    @property
    def local_system(self) -> LagrangeDirac:
        """L, W, b and f on the coordinates."""
        constraints, forces = self.system.constraints, self.system.forces

        def lagrangian(r, v, where):
            return self.system.lagrangian(*self.chart(where[1]).velocity_to_manifold(r, v), where[0])

        def one_forms(t, r, where):
            to_manifold = self.chart(where[1]).to_manifold
            return constraints.one_forms_at(t, to_manifold(r), where[0]) @ jacobian(to_manifold)(r)

        def affine(t, r, where):
            assert constraints.affine is not None
            return constraints.affine.at(t, *self.points(where, r), where[0])

        def force(t, r, v, where):
            q, velocity = self.chart(where[1]).velocity_to_manifold(r, v)
            assert forces is not None
            covector = forces(t, q, velocity, where[0])
            return gradient(lambda r: self.points(where, r)[0] @ covector)(r)

        return LagrangeDirac(
            lagrangian,
            None if constraints.one_forms is None else one_forms,
            affine=None if constraints.affine is None else affine,
            forces=None if forces is None else force,
        )

    @property
    def local_rule(self) -> UserFunction:
        """L_d."""

        def discrete_lagrangian(t, r0, r1, h, where):
            q0, q1 = self.points(where, r0, r1)
            if isinstance(self.rule, UserFunction):
                return self.rule.returning(())(*self.rule.given(t, q0, q1, h, where[0]))
            inverses = self._inverses(self.rule)
            values = [self.system.lagrangian(x, w / h, where[0]) for x, w in (inverse(q0, q1) for _, inverse in inverses)]
            return h * sum(values[1:], values[0]) / len(values)

        return UserFunction(discrete_lagrangian, "discrete_lagrangian", LD_ARGUMENTS, timed=True)

    @property
    def local_constraint(self) -> UserFunction | str:
        """w_d; a name, which is not asked for, without one-forms."""
        rule = self.constraint_rule
        if self.system.one_forms is None and not isinstance(rule, UserFunction):
            return "midpoint"

        def constraint(t, r0, r1, h, where):
            q0, q1 = self.points(where, r0, r1)
            if isinstance(rule, UserFunction):
                return rule(*rule.given(t, q0, q1, h, where[0]))
            ((fraction, inverse),) = self._inverses(rule)
            x, w = inverse(q0, q1)
            return self.system.constraints.nonholonomic_defect(t + fraction * h, x, w / h, where[0])

        return UserFunction(constraint, "constraint", LD_ARGUMENTS, timed=True)

    def impulses(self, t: Any, r: Local, v: Local, h: Any, where: Any) -> tuple[Local, Local]:
        """(f_d^−, f_d^+) at (r, r + h v)."""
        forces, rule = self.system.forces, "midpoint" if isinstance(self.rule, UserFunction) else self.rule
        assert forces is not None
        inverses, found = self._inverses(rule), []
        for fraction, inverse in inverses:
            x, w = inverse(*self.points(where, r, r + h * v))
            covector = h / len(inverses) * forces(t + fraction * h, x, w / h, where[0])
            base = lambda r0, r1, inverse=inverse: inverse(*self.points(where, r0, r1))[0]
            found.append(gradient(lambda r0, r1, base=base, f=covector: base(r0, r1) @ f, (0, 1))(r, r + h * v))
        first, last = (jnp.sum(jnp.stack(ends), axis=0) for ends in zip(*found, strict=True))
        return first, last

    def _inverses(self, rule: Any) -> list[tuple[float, Callable]]:
        """(fraction of the step at which x lies, (q0, q1) ↦ (x, w)) of each point of a rule."""
        inverse = self.manifold.inverse_retraction

        def geodesic(q0, q1):
            return self.manifold.geodesic(q0, self.manifold.log(q0, q1), jnp.asarray(0.5))

        if isinstance(rule, AbstractDiscretizationMap):
            return [(rule.base_fraction, rule.backward)]
        named = {
            "left": [(0.0, lambda q0, q1: (q0, inverse(q0, q1)))],
            "right": [(1.0, lambda q0, q1: (q1, -inverse(q1, q0)))],
            "midpoint": [(0.5, geodesic)],
        }
        return named["left"] + named["right"] if rule == "trapezoidal" else named[rule]
