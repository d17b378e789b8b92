"""Discrete Lagrangian mechanics on a manifold by any discretization map and in any atlas ([RL] §6)."""

from typing import Any

from dirax.geometry.charts import Atlas
from dirax.geometry.maps import AbstractDiscretizationMap
from dirax.schemes.discrete_structure import AbstractDiscreteStructure
from dirax.schemes.discrete_structure_charts import PairsInCharts
from dirax.schemes.lagrange_dalembert_step import MOMENTA
from dirax.schemes.step import AbstractScheme, Shape, StepEquation
from dirax.schemes.step_in_charts import StepInCharts, lagrangian_in_charts


class InCharts(AbstractScheme):
    """The discrete Lagrange–d'Alembert equations of L_d(q0, q1) = h L(x, w/h), (x, w) = R_d⁻¹(q0, q1), solved in a chart at hand.

    `map`: a discretization map R_d on the manifold; L_d is defined on Q × Q by it, without coordinates, so that the chart
    changes nothing but roundoff. One-forms are imposed at the base point, W(x) w/h + b(x) = 0, and forces act there, their
    impulses pulled back to both ends by the derivatives of x. `atlas`: which charts and when to leave them; by default the
    charts compatible with the manifold's retraction ([RL] Definition 6.2), left where half of the domain is used. The state is
    (m, r, p): the centre of the chart and the coordinates in it. Without one-forms and forces symplectic on T*Q; second order
    for a symmetric map. The saved p is the mean of the momenta before and after the impulse of the one-forms.
    Raises `TypeError` for a map or an atlas that is none.

    `dx.PlusLagrangeDirac`, `dx.MinusLagrangeDirac` and `dx.LagrangeDAlembert` are the schemes of L_d and constraints of other
    kinds, a user's own among them, with the same charts.
    """

    map: AbstractDiscretizationMap
    atlas: Atlas | None = None

    def __check_init__(self):
        if not isinstance(self.map, AbstractDiscretizationMap):
            raise TypeError(
                f"map must be a discretization map such as dx.SphereProjection(), but {self.map!r} was given: the schemes of a "
                "discrete Lagrangian, dx.LagrangeDAlembert() among them, step a dx.ManifoldLagrangian themselves."
            )
        if not isinstance(self.atlas, Atlas | None):
            raise TypeError(f"atlas must be a dx.Atlas, but {self.atlas!r} was given.")

    def discrete_structure(self, system: Any, shape: Shape, step: Any) -> AbstractDiscreteStructure | str:
        return PairsInCharts(lagrangian_in_charts(system, self.map, self.map), step, shape, share=MOMENTA["mean"])

    def step_equation(self, system: Any, shape: Shape) -> StepEquation:
        if system.manifold_form() is None:
            raise TypeError(f"dx.InCharts steps a dx.ManifoldLagrangian, but a {type(system).__name__} was given.")
        atlas = self.atlas or Atlas(system.manifold_form().manifold)
        local = lagrangian_in_charts(system, self.map, self.map, atlas.exponential)
        return StepInCharts(local, atlas, shape, "mean").equation()
