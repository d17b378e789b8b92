"""A step as a part of a composed step: it ends at the momentum projected onto the constraints."""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.program.tracing import gradient
from dirax.schemes.abstract_step import AbstractStep
from dirax.schemes.constraint_rows import ConstraintRows
from dirax.schemes.layout import Layout
from dirax.schemes.step import Field, Shape


@dataclass(frozen=True, eq=False)
class PartOfStep(AbstractStep):
    """The step of `inner`, on a system with a Lagrangian and constraints, with the same state and saved arrays."""

    inner: Any  # a LagrangeDAlembertStep or a MethodOneStep

    @property
    def shape(self) -> Shape:
        """The sizes of the system."""
        return self.inner.shape

    @property
    def rows(self) -> ConstraintRows:
        """The constraints that enter the equations."""
        return self.inner.rows

    @property
    def state(self) -> Layout:
        return self.inner.state

    @property
    def fields(self) -> dict[str, Field]:
        return self.inner.fields

    @property
    def canonical(self) -> bool:
        return self.inner.canonical

    def projection(self, t: Any, q: Float[Array, " n"], v: Float[Array, " n"], p: Array, params: Any) -> Float[Array, " n+k"]:
        """Zero where p = ∂L/∂v(t, q, v) and v satisfies the constraints of velocities."""
        momentum = gradient(lambda v: self.inner.system.lagrangian.at(t, q, v, params))(v)
        return jnp.concatenate([momentum - p, self.rows.velocity_defect(t, q, v, params)])
