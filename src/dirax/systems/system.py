"""What every system offers to schemes and to `simulate`: sizes, initial data made complete, energy, constraint."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.text.representation import module_html, module_text


class AbstractSystem(eqx.Module):
    """A mechanical system as the user states it; no time step in here.

    All methods act on one trajectory (no batch axis) and are traceable.
    """

    def __repr__(self) -> str:
        return module_text(self)

    def _repr_html_(self) -> str:
        return module_html(self)

    @abstractmethod
    def sizes(self, data: dict[str, Array], params: Any) -> tuple[int, ...]:
        """(n, m) or (n, m, c): the number of coordinates, of constraints and of holonomic constraints; raises when
        the user's functions have wrong shapes."""

    @abstractmethod
    def complete(self, data: dict[str, Array], params: Any, project: bool) -> dict[str, Array]:
        """The initial data with everything a scheme may start from, projected to the constraint when `project`."""

    @abstractmethod
    def initial_defect(self, data: dict[str, Array], params: Any) -> Float[Array, " m"]:
        """By how much completed initial data violate the constraint, one number a constraint."""

    @abstractmethod
    def energy_at(self, row: dict[str, Array], params: Any) -> Float[Array, ""]:
        """The energy at one saved row (its node fields)."""

    @abstractmethod
    def constraint_at(self, row: dict[str, Array], params: Any) -> Float[Array, " m"]:
        """The constraint at one saved row (its node fields), zero where it holds."""


def no_constraint() -> Float[Array, "0"]:
    """The value of the constraint of an unconstrained system."""
    return jnp.zeros((0,))
