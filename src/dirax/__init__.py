"""Geometric integrators from discrete Dirac mechanics: state a system, get the integrator, have it measured.

Importing dirax turns on 64-bit floats in JAX (`jax_enable_x64`): structure is preserved to roundoff, and roundoff is float64's.
"""

import jax

jax.config.update("jax_enable_x64", True)

from dirax.schemes.lagrange_dirac import LagrangeDAlembert, MinusLagrangeDirac, PlusLagrangeDirac
from dirax.schemes.step import AbstractScheme, Field, Shape, StepEquation, StepSequence, make_step_equation
from dirax.simulate import simulate
from dirax.solution import Solution
from dirax.systems.lagrange_dirac import LagrangeDirac

__version__ = "0.1.0"

__all__ = [
    "AbstractScheme",
    "Field",
    "LagrangeDAlembert",
    "LagrangeDirac",
    "MinusLagrangeDirac",
    "PlusLagrangeDirac",
    "Shape",
    "Solution",
    "StepEquation",
    "StepSequence",
    "make_step_equation",
    "simulate",
]
