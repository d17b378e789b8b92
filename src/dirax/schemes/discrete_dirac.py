"""Discrete Dirac systems by discretization maps ([BLM] §5): one scheme for Hamiltonian, Lagrangian and port systems."""

from typing import Any

from dirax.geometry.cotangent_lift import CotangentLift, cotangent_lift
from dirax.geometry.maps import AbstractDiscretizationMap, Midpoint, Theta
from dirax.geometry.projected_map import ProjectedMap
from dirax.geometry.spaces import Euclidean
from dirax.schemes.blm_method_1_forward_step import MethodOneForwardStep
from dirax.schemes.blm_method_1_step import MethodOnePart, MethodOneStep
from dirax.schemes.blm_method_2_step import NonholonomicStep, ProjectedThetaStep
from dirax.schemes.constraint_manifold_premise import where_the_constraints_hold
from dirax.schemes.discrete_structure import AbstractDiscreteStructure
from dirax.schemes.discrete_structure_maps import PROJECTED, RelationPairs, structure_on_cotangent_bundle
from dirax.schemes.discretized_relation import discretized_relation
from dirax.schemes.growth_premise import nothing_grows
from dirax.schemes.hidden_constraint_premise import nothing_hidden_in_lagrangian, nothing_hidden_in_relation
from dirax.schemes.index_premise import warned_of_index_three
from dirax.schemes.look_ahead_step import LookAheadStep
from dirax.schemes.map_lift import ThetaLift, lift_of
from dirax.schemes.map_premise import by_a_discretization_map
from dirax.schemes.projected_field import projected_field
from dirax.schemes.projected_lift_step import ProjectedLiftStep
from dirax.schemes.step import AbstractScheme, Shape, StepEquation
from dirax.systems.system import AbstractSystem

CONSTRAINTS = ("discretize", "resolve")


class DiscreteDirac(AbstractScheme):
    """The discrete Dirac system S_d^h of a discretization map ([BLM] §5.1):

        (R_d⁻¹(x_k, x_{k+1})/h, α_x) ∈ D_x,   x the base point of R_d⁻¹(x_k, x_{k+1}).

    `map`: any discretization map; for a Lagrangian system one on Q, in its coordinates or on the manifold of a
    `dx.ManifoldLagrangian`, which is lifted to T*Q. Explicit time is that of the base point, t + `map.base_fraction` h.
    `constraints`:
    "discretize" ([BLM] Method 1) discretizes the implicit system S_0 as it stands; "resolve" ([BLM] Method 2) runs the
    constraint algorithm first and discretizes on M_f, so that its constraints hold at the nodes to roundoff. Of holonomic
    constraints g = 0, Method 1 imposes the distribution G q̇ + ∂g/∂t = 0 at the base point, which keeps quadratic g for the
    midpoint map and others to O(h²); Method 2 keeps g and G q̇ + ∂g/∂t at the nodes, to roundoff. With either kind of
    constraint the multipliers of Method 1 alternate around those of the system by O(h), and means of neighbours are of the
    order of q. With a base point off the middle of the step (θ ≠ ½) what is off a constraint is multiplied by −θ/(1 − θ) or
    −(1 − θ)/θ in a step, whatever its size, and in the adjoint by the inverse: where that grows the run is refused. Method 2 of
    a DiracSystem with `holonomic` is stated here for graphs of two-forms and bivectors with {g_i, g_j} = 0, and by its resolved
    chain for others. On T*Q the lift of dx.Theta(1.0) has the constraint W(q_1)Δq = 0 at the base point (q_1, p_0), which
    restricts the state alone: its force leads to a state with a step ahead (`LookAheadStep`). Multipliers are forces at the
    base point, ṗ = … + Wᵀλ; those of `dx.LagrangeDAlembert` are impulses of the opposite sign.

    Method 2 of a relation with multipliers, closed ports say, also takes a `dx.ProjectedMap` whose projector has the constraint
    manifold M_0 as its image ([BLM] §7.2): (ẋ, u) with ẋ tangent to M_0 satisfy the relation at its base point on M_0.

    Takes systems with a relation form or a Lagrangian form: DiracSystem, PortHamiltonian, ImplicitSystem, LiePoisson,
    LagrangeDirac, NonholonomicMechanics, PhaseSpaceLagrangian, ManifoldLagrangian and systems of one's own; and what
    `ConstraintChain.resolved` returns, on which it is Method 2 for any system. Raises `TypeError` for others, and `ValueError`
    for maps that do not fit the system's space, for one of your own that is no discretization map at the initial data, and for
    Method 2 of a system with constraints that are not stated as such, those of a singular Lagrangian say.
    """

    map: AbstractDiscretizationMap
    constraints: str

    def __init__(self, map: AbstractDiscretizationMap | None = None, constraints: str = "discretize"):
        if map is not None and not isinstance(map, AbstractDiscretizationMap):
            raise TypeError(f"map must be a discretization map such as dx.Midpoint(), but {map!r} was given.")
        if constraints not in CONSTRAINTS:
            raise ValueError(f'constraints must be "discretize" or "resolve", but {constraints!r} was given.')
        self.map = Midpoint() if map is None else map
        self.constraints = constraints

    def step_equation(self, system: AbstractSystem, shape: Shape) -> StepEquation:
        resolve = self.constraints == "resolve"
        equation = self._resolved(system, shape) if resolve else self._discretized(system, shape)
        flat = _is_flat(self.map, shape)
        if equation is not None and not resolve and flat and self.map.base_fraction != 0.5 and not self._looks_ahead(system):
            lagrangian = system.relation_form(shape) is None
            equation = nothing_grows(system, equation, lagrangian and _theta_of(self.map) == 1.0 and shape.m + shape.c > 0)
        if equation is None and not resolve:
            equation = self._resolved(system, shape)  # all that is known of the system is its final manifold
        if equation is None:
            raise TypeError(
                "dx.DiscreteDirac discretizes systems with a relation form or a Lagrangian form, such as DiracSystem, "
                "PortHamiltonian, ImplicitSystem, LagrangeDirac, NonholonomicMechanics and PhaseSpaceLagrangian systems, but a "
                f"{type(system).__name__} was given."
            )
        return by_a_discretization_map(self.map, equation, system.relation_form(shape) is not None, shape.n)

    def _discretized(self, system: AbstractSystem, shape: Shape) -> StepEquation | None:
        """Method 1."""
        if (relation := system.relation_form(shape)) is not None:
            if self._looks_ahead(system):
                return LookAheadStep(system.phase_space_form(), shape, relation).equation()
            return warned_of_index_three(system, relation, shape.n, discretized_relation(relation, shape.n, self.map))
        if system.lagrangian_form() is None and system.manifold_form() is None:
            return None
        return _method_one(self.map, system, shape).equation()

    def _looks_ahead(self, system: AbstractSystem) -> bool:
        """Whether the constraint at the base point (q_1, p_0) restricts the state alone: its force is one of the step ahead."""
        form = system.phase_space_form() if isinstance(self.map, CotangentLift) and _theta_of(self.map) == 1.0 else None
        return form is not None and form.constraints.any

    def adjoint(self, system: AbstractSystem) -> "DiscreteDirac | None":
        """With constraints, that of the lift of dx.Theta(1.0) is the lift of dx.Theta(0.0), whose states are all of M_0; and of
        Method 2, whose states are those of M_f alone, that of θ is that of 1 − θ."""
        if self.constraints == "discretize":
            return DiscreteDirac(cotangent_lift(Theta(0.0))) if self._looks_ahead(system) else None
        theta = _theta_of(self.map)
        if theta is None or system.manifold_form() is not None:
            return None
        back = Theta(1.0 - theta)
        return DiscreteDirac(cotangent_lift(back) if isinstance(self.map, CotangentLift) else back, self.constraints)

    def part(self, system: AbstractSystem, shape: Shape) -> AbstractScheme:
        if self._looks_ahead(system):
            raise ValueError(
                "with constraints the states of the lift of dx.Theta(1.0) are other ones for every step size, so that steps of "
                "different sizes do not compose: compose dx.DiscreteDirac() with the midpoint map."
            )
        lagrangian = system.lagrangian_form() or system.manifold_form()
        if self.constraints == "resolve" or lagrangian is None or system.relation_form(shape) is not None:
            return self
        return _Part(self.map) if shape.m + shape.c else self

    def _resolved(self, system: AbstractSystem, shape: Shape) -> StepEquation | None:
        """Method 2."""
        relation = system.relation_form(shape)
        if isinstance(self.map, ProjectedMap) and relation is not None and relation.multipliers:
            make = lambda: discretized_relation(relation, shape.n, self.map, on_constraints=True)
            return where_the_constraints_hold(system, relation.multipliers, self.map.manifold(shape.n), make)
        if (manifold := system.final_manifold(shape)) is not None:
            return projected_field(manifold, shape.n, _theta_of_points(self.map))
        if (relation := system.final_relation(shape)) is not None:
            return discretized_relation(relation, shape.n, self.map)
        if (relation := system.relation_form(shape)) is not None:
            if shape.m + shape.c:
                raise ValueError(
                    f"Method 2 of this {type(system).__name__} with multipliers needs its final manifold: simulate "
                    "dx.constraint_algorithm(system, near=x).resolved() instead of the system."
                )
            return nothing_hidden_in_relation(system, relation, discretized_relation(relation, shape.n, self.map))
        return self._resolved_lagrangian(system, shape)

    def _resolved_lagrangian(self, system: AbstractSystem, shape: Shape) -> StepEquation | None:
        theta, metric, lagrangian = _theta_of(self.map), system.metric_form(), system.lagrangian_form()
        if metric is not None and theta is not None and not shape.redundant:
            return NonholonomicStep(metric, shape, theta).equation()
        lagrangian = system.manifold_form() if lagrangian is None else lagrangian
        if lagrangian is None:
            return None
        if not shape.m + shape.c:
            equation = self._discretized(system, shape)
            assert equation is not None
            return nothing_hidden_in_lagrangian(lagrangian, equation)
        if theta is not None and system.manifold_form() is None:
            return ProjectedThetaStep(lagrangian, shape, theta).equation()
        return ProjectedLiftStep(lagrangian, shape, lift_of(_map_on_q(self.map), lagrangian, shape.n)).equation()

    def discrete_structure(self, system: AbstractSystem, shape: Shape, step: Any) -> AbstractDiscreteStructure | str:
        if self.constraints == "discretize":
            relation = system.relation_form(shape)
        elif system.final_manifold(shape) is None or isinstance(self.map, ProjectedMap):
            relation = system.final_relation(shape) or system.relation_form(shape)
        else:
            return PROJECTED
        if relation is not None:
            return RelationPairs(relation, self.map, step)
        lagrangian = system.manifold_form() or system.lagrangian_form()
        if lagrangian is None or (self.constraints == "resolve" and shape.m + shape.c):
            return PROJECTED
        return structure_on_cotangent_bundle(lagrangian, shape, self.map, step)

    @property
    def constraints_at_rows(self) -> bool:
        return self.constraints == "resolve"


class _Part(AbstractScheme):
    """Method 1 whose steps end at the momentum projected onto the constraints."""

    map: AbstractDiscretizationMap

    def step_equation(self, system: AbstractSystem, shape: Shape) -> StepEquation:
        equation = MethodOnePart(_method_one(self.map, system, shape)).equation()
        if self.map.base_fraction == 0.5 or not _is_flat(self.map, shape):
            return equation
        return nothing_grows(system, equation, _theta_of(self.map) == 1.0)


def _method_one(map: AbstractDiscretizationMap, system: AbstractSystem, shape: Shape) -> MethodOneStep:
    """The step of a system with a Lagrangian form, or one on a manifold."""
    lagrangian, theta = system.lagrangian_form(), _theta_of(map)
    if lagrangian is not None and theta is not None:
        return MethodOneStep(lagrangian, shape, ThetaLift(theta, shape.n))
    lagrangian = system.manifold_form() if lagrangian is None else lagrangian
    of_lift = MethodOneStep if _map_on_q(map).has_explicit_inverse else MethodOneForwardStep
    return of_lift(lagrangian, shape, lift_of(_map_on_q(map), lagrangian, shape.n))


def _is_flat(map: AbstractDiscretizationMap, shape: Shape) -> bool:
    """Whether a map is one of coordinates."""
    return isinstance(_map_on_q(map).manifold(shape.n), Euclidean)


def _map_on_q(map: AbstractDiscretizationMap) -> AbstractDiscretizationMap:
    """The map on Q of a Lagrangian system: the map itself, or the one that was lifted."""
    return map.map if isinstance(map, CotangentLift) else map


def _theta_of(map: AbstractDiscretizationMap) -> float | None:
    """θ of a θ map on Q, or of its lift, for which the Lagrangian methods have a form without differences of points."""
    base = _map_on_q(map)
    return base.theta if isinstance(base, Theta) else None


def _theta_of_points(map: AbstractDiscretizationMap) -> float:
    """θ of a θ map of all coordinates x alike; the lift of the midpoint map is one."""
    theta = map.theta if isinstance(map, Theta) else None
    if isinstance(map, CotangentLift) and isinstance(map.map, Theta) and map.map.theta == 0.5:
        theta = 0.5
    if theta is None:
        raise ValueError(
            "Method 2 on a final manifold in coordinates x takes dx.Theta maps and dx.Midpoint(), which treat all coordinates "
            f"alike, but {type(map).__name__} was given."
        )
    return theta
