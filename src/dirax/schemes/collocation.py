"""Collocation: steps of high order whose unknowns are the rates at s nodes, coupled by constant matrices."""

from typing import Any

from dirax.numerics.arrays import is_whole
from dirax.schemes.collocation_step import LagrangianCollocation, RelationCollocation
from dirax.schemes.collocation_tables import MOST_STAGES, Tableau, gauss, lobatto
from dirax.schemes.constrained_collocation_step import ConstrainedCollocation
from dirax.schemes.hidden_constraint_premise import nothing_hidden_in_relation
from dirax.schemes.manifold_collocation_step import ManifoldCollocation
from dirax.schemes.step import AbstractScheme, Shape, StepEquation
from dirax.systems.manifold_lagrangian import ManifoldLagrangian
from dirax.systems.system import AbstractSystem

NODES = ("gauss", "lobatto")


class Collocation(AbstractScheme):
    """Collocation with s stages: the polynomials through the state that satisfy the equations at the nodes c_1, …, c_s.

        X_i = x_k + h Σ_j a_ij Ẋ_j,   x_{k+1} = x_k + h Σ_i b_i Ẋ_i,   (X_i, Ẋ_i) satisfying the system at t_k + c_i h.

    `nodes="gauss"`: order 2s, symplectic, self-adjoint (Hairer, Lubich, Wanner, Geometric Numerical Integration, II.1.3). On a
    regular Lagrangian, with x = (q, p), these are the discrete Euler–Lagrange equations of the Galerkin discrete Lagrangian
    L_d(q_0, q_1) = ext h Σ b_i L(Q_i, Q̇_i) over polynomials of degree s (VI.6.3); forces and explicit time enter at the
    nodes. Quadratic invariants are kept: Casimirs of linear Poisson structures that are quadratic, angular momenta.

    `nodes="lobatto"`, for regular Lagrangians: order 2s − 2, with the first node at t_k and the last at t_{k+1}; positions by the
    matrix of Lobatto IIIA, momenta by that of IIIB, P_i = p_k + h Σ_j â_ij Ṗ_j, a symplectic and self-adjoint pair (IV.2.2;
    two stages are the Störmer–Verlet scheme where the mass matrix is constant).

    With constraints of a regular Lagrangian, at Lobatto nodes: holonomic ones, g = 0 at every node and G q̇ = 0 at the rows, a
    symplectic map of the constraint manifold (two stages are RATTLE); one-forms, W q̇ + b = 0 at every node, with the λ_1 of a
    step that of λ_s before; or both. Order 2s − 2 in q and p; the `reactions` λ at the nodes have less, as measured: s − 1 those
    of holonomic constraints, s or s − 1, whichever is even, those of one-forms.

    On a manifold in R^N, for a `dx.ManifoldLagrangian` at Gauss nodes: the same in the chart at q_k whose points are those of the
    manifold that are nearest to q_k + F r, F a basis of the tangent space; symplectic on T*Q, order 2s, every q on the manifold.

    Takes systems without constraints at Gauss nodes: regular `dx.LagrangeDirac`, `dx.DiracSystem` with a Hamiltonian vector
    field, `dx.PortHamiltonian` without closed ports, `dx.LiePoisson`, and `dx.PhaseSpaceLagrangian` on its final manifold.
    Raises `ValueError` for stages that are not 1 to 16 and nodes that do not exist, and `TypeError` for other systems.

        sol = dx.simulate(system, dx.Collocation(stages=4), q=…, v=…, step=0.1, steps=1000)
    """

    stages: int
    nodes: str

    def __init__(self, stages: int = 3, nodes: str = "gauss"):
        if nodes not in NODES:
            raise ValueError(f"nodes must be {' or '.join(map(repr, NODES))}, but {nodes!r} was given.")
        fewest = 1 if nodes == "gauss" else 2
        if not is_whole(stages) or not fewest <= stages <= MOST_STAGES:
            raise ValueError(
                f"stages must be a whole number from {fewest} to {MOST_STAGES} for {nodes} nodes, but {stages!r} was given."
            )
        self.stages, self.nodes = int(stages), nodes

    @property
    def order(self) -> int:
        """The order of convergence on smooth systems: 2s, or 2s − 2 with Lobatto nodes."""
        return 2 * self.stages - 2 * (self.nodes == "lobatto")

    def composed_order(self, system: AbstractSystem, shape: Shape) -> int | None:
        """With one-forms 4, as measured, or its own: λ of the step before is in the state, and parts are of other lengths."""
        return max(4, self.order) if self.nodes == "lobatto" and shape.m else None

    def adjoint(self, system: AbstractSystem) -> "Collocation":
        """The scheme itself, for nodes that lie symmetrically."""
        return self

    def discrete_structure(self, system: Any, shape: Shape, step: Any) -> str:
        return "the equations of collocation join its stages, which are not saved; what the step preserves is measured instead"

    def step_equation(self, system: AbstractSystem, shape: Shape) -> StepEquation:
        if shape.m + shape.c:
            return self._constrained(system, shape)
        tableau = gauss(self.stages) if self.nodes == "gauss" else lobatto(self.stages)
        relation = system.relation_form(shape) or system.final_relation(shape)
        if relation is not None and not relation.multipliers:
            if self.nodes == "lobatto":
                raise TypeError(
                    f"Lobatto nodes are for Lagrangians, whose positions and momenta they treat apart, but a "
                    f'{type(system).__name__} was given: take nodes="gauss".'
                )
            equation = RelationCollocation(tableau, shape.n, relation).equation()
            known = relation.explicit or system.final_relation(shape) is not None
            return equation if known else nothing_hidden_in_relation(system, relation, equation, "dx.Collocation")
        lagrangian = system.lagrangian_form()
        if lagrangian is not None:
            return LagrangianCollocation(tableau, shape.n, lagrangian).equation()
        on_manifold = system.manifold_form()
        if on_manifold is not None:
            return self._on_manifold(tableau, on_manifold, shape)
        raise TypeError(
            "dx.Collocation steps systems with a relation between x and ẋ or with a Lagrangian, but a "
            f"{type(system).__name__} was given."
        )

    def _on_manifold(self, tableau: Tableau, system: ManifoldLagrangian, shape: Shape) -> StepEquation:
        if self.nodes == "lobatto" or system.forces is not None:
            what = "Lobatto nodes are for coordinates" if self.nodes == "lobatto" else "forces are not taken there"
            raise TypeError(
                f'dx.Collocation on a manifold takes nodes="gauss" and L alone, and {what}: take dx.DiscreteDirac(map).'
            )
        return ManifoldCollocation(tableau, system, shape.n).equation()

    def _constrained(self, system: AbstractSystem, shape: Shape) -> StepEquation:
        lagrangian = system.lagrangian_form()
        if lagrangian is None:
            raise TypeError(
                f"dx.Collocation does not keep the constraints of a {type(system).__name__}, which here are {shape.m + shape.c}: "
                f"take dx.DiscreteDirac({'' if system.manifold_form() is None else 'map'})."
            )
        if self.nodes == "gauss":
            raise TypeError(
                f"dx.Collocation at Gauss nodes does not keep constraints, of which the system has {shape.m + shape.c}: take "
                'nodes="lobatto" for Lagrangians, dx.EnergyCollocation() for nonholonomic ones, or '
                'dx.DiscreteDirac(constraints="resolve").'
            )
        return ConstrainedCollocation(lobatto(self.stages), shape, lagrangian).equation()
