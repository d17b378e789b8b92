"""Every public name of dirax, each from the module that defines it; `dirax.NAME` is what is listed here.

A name is added by its import and its line in the list of its room.
"""

from dirax import bodies
from dirax.diagnostics.action import action_sum, action_variation, discrete_energy
from dirax.diagnostics.compare import compare
from dirax.diagnostics.convergence import convergence
from dirax.diagnostics.linearize import Linearization, linearize
from dirax.diagnostics.report import Report
from dirax.diagnostics.verify import verify
from dirax.engines.configure import configure
from dirax.engines.engine import AbstractEngine
from dirax.engines.linear_solver import AbstractLinearSolver
from dirax.geometry.charts import Atlas, RetractionChart, chart_at, check_chart
from dirax.geometry.complete_lift import complete_lift, symplectic_equations
from dirax.geometry.cotangent_lift import CotangentBundle, cotangent_lift, symplecticity_defect
from dirax.geometry.discrete import (
    DiscretizationMapDirac,
    FiniteDifferenceDirac,
    GeneratingFunctionDirac,
    InducedFiniteDifferenceDirac,
)
from dirax.geometry.lagrangian_submanifolds import LagrangianSubmanifold
from dirax.geometry.lie_groups import SE2, SE3, SO2, SO3
from dirax.geometry.linear import LinearDirac
from dirax.geometry.map_report import check_discretization_map
from dirax.geometry.maps import (
    AbstractDiscretizationMap,
    LieGroupExp,
    Midpoint,
    ProductMap,
    RiemannianExp,
    SphereProjection,
    Theta,
)
from dirax.geometry.pairs import DiscreteLagrangianSystem
from dirax.geometry.products import Product
from dirax.geometry.projected_map import ProjectedMap, Submanifold
from dirax.geometry.semidirect import SemidirectProduct
from dirax.geometry.spaces import Circle, Euclidean, Sphere, Torus
from dirax.geometry.structures import DiracStructure, canonical_two_form, induced_dirac
from dirax.geometry.subspaces import PontryaginSubspace
from dirax.geometry.tulczyjew import (
    DiscreteEvolution,
    FiniteDifferenceTriple,
    GeneratingFunctionTriple,
    TulczyjewTriple,
    minus_legendre,
    plus_legendre,
)
from dirax.numerics.ranks import UndecidableRank
from dirax.program.memo import clear_caches
from dirax.reduction.actions import GroupAction, Translations
from dirax.reduction.bundle import GroupConnection
from dirax.reduction.connection import DiscreteConnection, LinearConnection
from dirax.reduction.coordinates import adapted_basis, in_coordinates
from dirax.reduction.dirac import ReducedGeneratingFunctionDirac
from dirax.reduction.euler_poincare import EulerPoincare
from dirax.reduction.left_translation import LeftTranslation
from dirax.reduction.lie_poisson import LiePoisson
from dirax.reduction.reduce import reduce
from dirax.reduction.reduced import ReducedLagrangeDirac
from dirax.reduction.reduced_on_manifold import ReducedManifoldLagrangian
from dirax.reduction.symmetry import check_invariance, cyclic_coordinates, translation_symmetries
from dirax.reduction.trivializations import CovectorTrivialization, PairTrivialization, PontryaginTrivialization
from dirax.run.event import Event
from dirax.run.export_c import export_c
from dirax.run.impact import Impact
from dirax.run.prepare import PreparedRun, prepare
from dirax.run.simulate import simulate
from dirax.schemes.collocation import Collocation
from dirax.schemes.composition import Adjoint, Composition, SymmetricComposition
from dirax.schemes.discrete_constraints import DiscreteConstraintChain, discrete_constraint_algorithm
from dirax.schemes.discrete_dirac import DiscreteDirac
from dirax.schemes.discrete_gradient import DiscreteGradient
from dirax.schemes.energy_collocation import EnergyCollocation
from dirax.schemes.euler_poincare import DiscreteEulerPoincare
from dirax.schemes.hamilton_dirac import MinusHamiltonDirac, PlusHamiltonDirac
from dirax.schemes.in_charts import InCharts
from dirax.schemes.lagrange_dirac import LagrangeDAlembert, MinusLagrangeDirac, PlusLagrangeDirac
from dirax.schemes.layout import Layout
from dirax.schemes.routh import DiscreteRouth
from dirax.schemes.step import AbstractScheme, Field, Shape, StepEquation, StepSequence, make_step_equation
from dirax.schemes.variable_steps import VariableSteps
from dirax.show import scene
from dirax.show.report import report
from dirax.solution.loading import load
from dirax.solution.reconstruction import reconstruct
from dirax.solution.solution import Solution
from dirax.sweeps.sweep import sweep
from dirax.systems.circuit import Circuit, circuit
from dirax.systems.constraint_algorithm import constraint_algorithm
from dirax.systems.constraint_chain import ConstraintChain
from dirax.systems.dirac_system import DiracSystem
from dirax.systems.forms import FinalManifold, Observed, RelationForm
from dirax.systems.generalized_dirac import GeneralizedDiracSystem
from dirax.systems.hamilton_dirac import HamiltonDirac
from dirax.systems.implicit_system import ImplicitSystem
from dirax.systems.interconnection import interconnect
from dirax.systems.lagrange_dirac import LagrangeDirac
from dirax.systems.manifold_lagrangian import ManifoldLagrangian
from dirax.systems.nonholonomic import NonholonomicMechanics
from dirax.systems.phase_space import PhaseSpaceLagrangian
from dirax.systems.port_hamiltonian import PortHamiltonian
from dirax.systems.system import AbstractSystem

# What a user states
__all__ = [
    "AbstractSystem",
    "Circuit",
    "ConstraintChain",
    "DiracSystem",
    "FinalManifold",
    "GeneralizedDiracSystem",
    "HamiltonDirac",
    "ImplicitSystem",
    "LagrangeDirac",
    "ManifoldLagrangian",
    "NonholonomicMechanics",
    "Observed",
    "PhaseSpaceLagrangian",
    "PortHamiltonian",
    "RelationForm",
    "bodies",
    "circuit",
    "constraint_algorithm",
    "interconnect",
]
# Symmetries, and systems reduced by them
__all__ += [
    "CovectorTrivialization",
    "DiscreteConnection",
    "EulerPoincare",
    "GroupAction",
    "GroupConnection",
    "LeftTranslation",
    "LiePoisson",
    "LinearConnection",
    "PairTrivialization",
    "PontryaginTrivialization",
    "ReducedGeneratingFunctionDirac",
    "ReducedLagrangeDirac",
    "ReducedManifoldLagrangian",
    "Translations",
    "adapted_basis",
    "check_invariance",
    "cyclic_coordinates",
    "in_coordinates",
    "reduce",
    "translation_symmetries",
]
# Dirac structures, manifolds, groups, maps
__all__ += [
    "SE2",
    "SE3",
    "SO2",
    "SO3",
    "AbstractDiscretizationMap",
    "Atlas",
    "Circle",
    "CotangentBundle",
    "DiracStructure",
    "DiscreteEvolution",
    "DiscreteLagrangianSystem",
    "DiscretizationMapDirac",
    "Euclidean",
    "FiniteDifferenceDirac",
    "FiniteDifferenceTriple",
    "GeneratingFunctionDirac",
    "GeneratingFunctionTriple",
    "InducedFiniteDifferenceDirac",
    "LagrangianSubmanifold",
    "LieGroupExp",
    "LinearDirac",
    "Midpoint",
    "PontryaginSubspace",
    "Product",
    "ProductMap",
    "ProjectedMap",
    "RetractionChart",
    "RiemannianExp",
    "SemidirectProduct",
    "Sphere",
    "SphereProjection",
    "Submanifold",
    "Theta",
    "Torus",
    "TulczyjewTriple",
    "UndecidableRank",
    "canonical_two_form",
    "chart_at",
    "check_chart",
    "check_discretization_map",
    "complete_lift",
    "cotangent_lift",
    "induced_dirac",
    "minus_legendre",
    "plus_legendre",
    "symplectic_equations",
    "symplecticity_defect",
]
# How time is cut
__all__ += [
    "AbstractScheme",
    "Adjoint",
    "Collocation",
    "Composition",
    "DiscreteConstraintChain",
    "DiscreteDirac",
    "DiscreteEulerPoincare",
    "DiscreteGradient",
    "DiscreteRouth",
    "EnergyCollocation",
    "Field",
    "InCharts",
    "LagrangeDAlembert",
    "Layout",
    "MinusHamiltonDirac",
    "MinusLagrangeDirac",
    "PlusHamiltonDirac",
    "PlusLagrangeDirac",
    "Shape",
    "StepEquation",
    "StepSequence",
    "SymmetricComposition",
    "VariableSteps",
    "discrete_constraint_algorithm",
    "make_step_equation",
]
# Running, and what comes out
__all__ += [
    "AbstractEngine",
    "AbstractLinearSolver",
    "Event",
    "Impact",
    "PreparedRun",
    "Solution",
    "clear_caches",
    "configure",
    "export_c",
    "load",
    "prepare",
    "reconstruct",
    "simulate",
    "sweep",
]
# Measuring
__all__ += [
    "Linearization",
    "Report",
    "action_sum",
    "action_variation",
    "compare",
    "convergence",
    "discrete_energy",
    "linearize",
    "verify",
]
# Looked at
__all__ += [
    "report",
    "scene",
]
