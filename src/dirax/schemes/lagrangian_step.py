"""What the steps of Methods 1 and 2 of [BLM] on Lagrangian systems have in common."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.numerics.arrays import Data
from dirax.program.tracing import along, gradient
from dirax.schemes.abstract_step import AbstractStep
from dirax.schemes.constraint_rows import ConstraintRows
from dirax.schemes.hermite import hermite
from dirax.schemes.layout import Layout
from dirax.schemes.step import Field, Shape
from dirax.schemes.work_of_forces import WorkOfForces

METHOD_2 = "of Method 2"
"""How the labels of its equations end."""


@dataclass(frozen=True, eq=False)
class LagrangianStep(AbstractStep):
    """A step in (q, p) of a system with constraints W v + b = 0, g = 0, whose multipliers are forces at the base point."""

    system: Any  # a LagrangeDirac, ManifoldLagrangian or NonholonomicMechanics
    shape: Shape

    @cached_property
    def rows(self) -> ConstraintRows:
        """The constraints without the redundant ones."""
        return ConstraintRows(self.system, self.shape)

    @cached_property
    def book(self) -> WorkOfForces:
        """The state with the work of the forces."""
        return WorkOfForces(self.system, self.shape.n)

    @property
    def state(self) -> Layout:
        return self.book.layout

    @property
    def fields(self) -> dict[str, Field]:
        n, k = self.shape.n, self.shape.m + self.shape.c
        fields = {"q": Field((n,)), "p": Field((n,))}
        if k:
            fields["multipliers"] = Field((k,), "step", ("constraint",), "Lagrange multipliers of the constraints")
        return fields | self.book.fields

    @property
    def canonical(self) -> bool:
        return not self.book.size

    @property
    def hermite(self):
        system = self.system.lagrangian_form()
        return None if system is None else hermite(system, self.one_sided)

    @property
    def one_sided(self) -> bool:
        """Whether the velocities of rows belong to another place in the steps."""
        return False

    def row(self, state: Float[Array, " s"]) -> dict[str, Array]:
        """What is saved of a state."""
        parts = self.state.split(state)
        return self.book.row(state) | {"q": parts.q, "p": parts.p}

    def rates(self, t: Any, q: Float[Array, " n"], v: Float[Array, " n"], params: Any, forces: Any = None) -> tuple[Array, Array]:
        """(∂L/∂q + f, ∂L/∂v) at (t, q, v), with these forces or those of the system."""
        lagrangian, forces = self.system.lagrangian, self.system.forces if forces is None else forces
        dq, dv = gradient(lambda q, v: lagrangian.at(t, q, v, params), (0, 1))(q, v)
        return (dq if forces is None else dq + forces(t, q, v, params)), dv

    def along_flow(self, function: Any, t: Any, q: Float[Array, " n"], v: Float[Array, " n"]) -> Array:
        """The derivative of function(t, q) along q̇ = v, ṫ = 1."""
        if self.system.depends_on_time:
            return along(function, (jnp.asarray(t, float), q), (jnp.ones(()), v))
        return along(lambda q: function(t, q), (q,), (v,))


def one_point_only(data: Data) -> None:
    """Refuse a start of Method 2 from two points."""
    if "q0" in data:
        raise ValueError("Method 2 is a one-step method on M_f: start it from q= with v= or p=, not from two points.")


def numbered(count: int) -> tuple[str, ...]:
    """The labels of the equations of Method 2."""
    return tuple(f"equation {i} {METHOD_2}" for i in range(count))
