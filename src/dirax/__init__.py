"""Geometric integrators from discrete Dirac mechanics: state a system, get the integrator, have it measured.

Importing dirax turns on 64-bit floats in JAX (`jax_enable_x64`): structure is preserved to roundoff, and roundoff is float64's.
"""

import jax

jax.config.update("jax_enable_x64", True)

from dirax.geometry.linear import LinearDirac
from dirax.geometry.structures import DiracStructure, canonical_two_form, induced_dirac
from dirax.reconstruction import reconstruct
from dirax.reduction.connection import LinearConnection
from dirax.reduction.reduced import ReducedLagrangeDirac, reduce
from dirax.schemes.charted import InCharts
from dirax.schemes.composition import Adjoint, Composition, SymmetricComposition
from dirax.schemes.discrete_dirac import DiscreteDirac
from dirax.schemes.lagrange_dirac import LagrangeDAlembert, MinusLagrangeDirac, PlusLagrangeDirac
from dirax.schemes.step import AbstractScheme, Field, Shape, StepEquation, StepSequence, make_step_equation
from dirax.simulate import simulate
from dirax.solution import Solution
from dirax.systems.dirac_system import DiracSystem
from dirax.systems.lagrange_dirac import LagrangeDirac
from dirax.systems.manifold_lagrangian import ManifoldLagrangian
from dirax.systems.nonholonomic import NonholonomicMechanics
from dirax.systems.phase_space import PhaseSpaceLagrangian
from dirax.systems.port_hamiltonian import PortHamiltonian

__version__ = "0.1.0"

__all__ = [
    "AbstractScheme",
    "Adjoint",
    "Composition",
    "DiracStructure",
    "DiracSystem",
    "DiscreteDirac",
    "Field",
    "InCharts",
    "LagrangeDAlembert",
    "LagrangeDirac",
    "LinearConnection",
    "LinearDirac",
    "ManifoldLagrangian",
    "MinusLagrangeDirac",
    "NonholonomicMechanics",
    "PhaseSpaceLagrangian",
    "PlusLagrangeDirac",
    "PortHamiltonian",
    "ReducedLagrangeDirac",
    "Shape",
    "Solution",
    "StepEquation",
    "StepSequence",
    "SymmetricComposition",
    "canonical_two_form",
    "induced_dirac",
    "make_step_equation",
    "reconstruct",
    "reduce",
    "simulate",
]
