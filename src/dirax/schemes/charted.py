"""Discrete Lagrangian mechanics on a manifold, computed in retraction-compatible charts that change on the way ([RL] §6)."""

from typing import Any

import jax.numpy as jnp

from dirax.geometry.charts import Atlas, RetractionChart
from dirax.geometry.manifolds import AbstractGeodesicManifold
from dirax.geometry.maps import AbstractDiscretizationMap
from dirax.program.user_functions import UserFunction
from dirax.schemes.discrete_lagrangian import LD_ARGUMENTS
from dirax.schemes.lagrange_dirac import discrete_lagrange_dalembert
from dirax.schemes.step import AbstractScheme, Field, Shape, StepEquation
from dirax.schemes.step_forms import ChartedForm
from dirax.systems.lagrange_dirac import LagrangeDirac
from dirax.systems.manifold_lagrangian import ManifoldLagrangian


class InCharts(AbstractScheme):
    """The discrete Euler–Lagrange equations of L_d(q0, q1) = h L(R_d⁻¹(q0, q1)/h), solved in a chart at hand.

    `map`: a discretization map R_d on the manifold; L_d is defined on Q × Q by it, without coordinates, so that the chart
    changes nothing but roundoff. `atlas`: which charts and when to leave them; by default the charts compatible with the
    manifold's retraction ([RL] Definition 6.2), left where half of the domain is used. The state is (m, r, p): the
    centre of the chart and the coordinates in it. Symplectic on T*Q; second order for a symmetric map.
    """

    map: AbstractDiscretizationMap
    atlas: Atlas | None = None

    def discrete_structure(self, system: Any, shape: Shape, step: Any) -> str:
        return "no structure on a Q × Q that is not flat is stated; whether a step is symplectic is measured instead"

    def step_equation(self, system: Any, shape: Shape) -> StepEquation:
        if not isinstance(system, ManifoldLagrangian):
            raise TypeError(f"dx.InCharts steps a dx.ManifoldLagrangian, but a {type(system).__name__} was given.")
        if system.constraints.any or system.forces is not None:
            raise ValueError("dx.InCharts steps a Lagrangian without one_forms and forces: use dx.DiscreteDirac(map).")
        manifold = system.manifold
        if not isinstance(manifold, AbstractGeodesicManifold):
            raise TypeError(f"dx.InCharts needs a manifold with a retraction, and {manifold!r} has none.")
        return _charted(system, manifold, self.map, self.atlas or Atlas(manifold), shape.n)

    def step_form(self, system: Any, shape: Shape, step: Any) -> ChartedForm:
        return ChartedForm(system, step)


def _charted(system, manifold, map, atlas: Atlas, size: int) -> StepEquation:
    d = manifold.dimension

    def chart(m) -> RetractionChart:
        return RetractionChart(manifold, m, manifold.frame(m), atlas.exponential)

    def discrete_lagrangian(r0, r1, h, where):
        params, m = where
        here = chart(m)
        x, w = map.backward(here.to_manifold(r0), here.to_manifold(r1))
        return h * system.lagrangian(x, w / h, params)

    local = LagrangeDirac(lambda r, v: jnp.zeros(()))  # only its discrete Lagrangian is used
    rule = UserFunction(discrete_lagrangian, "discrete_lagrangian", LD_ARGUMENTS)
    inner = discrete_lagrange_dalembert(local, Shape(d), rule, "right", "incoming")

    def residual(u, state, t, h, params):
        return inner.residual(u, state[size:], t, h, (params, state[:size]))

    def advance(u, state, t, h, params):
        m = state[:size]
        r, p = jnp.split(inner.advance(u, state[size:], t, h, (params, m)), 2)
        there, r, p = atlas.follow(chart(m), r, p)
        return jnp.concatenate([there.base, r, p])

    def unpack(state, u, t, h, params):
        r, p = jnp.split(state[size:], 2)
        q, momentum = chart(state[:size]).momentum_to_manifold(r, p)
        return {"q": q, "p": momentum, "chart": state[:size]}

    def start(data, h, params):
        here, r, p = atlas.enter(data["q"], data["p"])
        return jnp.concatenate([here.base, r, p]), here.components(data["v"])  # a first guess of the velocity

    fields = {
        "q": Field((size,)),
        "p": Field((size,)),
        "chart": Field((size,), description="the point at which the chart in use is centred"),
    }
    return StepEquation(
        start=start,
        residual=residual,
        advance=advance,
        unpack=unpack,
        state_size=size + 2 * d,
        unknowns=d,
        fields=fields,
        labels=tuple(f"discrete Euler–Lagrange equation {i} in the chart" for i in range(d)),
    )
