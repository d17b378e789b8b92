"""The work of the forces, carried beside (q, p): the energy book of a driven or damped system."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.schemes.step import Field


def work_field(system: Any) -> dict[str, Field]:
    """The field `work` of a system with forces."""
    if getattr(system, "forces", None) is None:
        return {}
    return {"work": Field((), "node", (), "work of the forces since the start")}


class WorkBook:
    """The state (q, p), or (q, p, work) for a system with forces; `size` is the length of what is added."""

    def __init__(self, system: Any, n: int):
        self.system, self.n, self.size = system, n, int(getattr(system, "forces", None) is not None)

    def start(self, q: Float[Array, " n"], p: Float[Array, " n"]) -> Float[Array, " s"]:
        """The first state."""
        return jnp.concatenate([q, p, jnp.zeros(self.size)]) if self.size else jnp.concatenate([q, p])

    def after(self, state: Array, end: list[Array], t: Any, q: Array, v: Array, h: Any, params: Any) -> Float[Array, " s"]:
        """The state (q1, p1) = `end` with the work h⟨f(t, q, v), v⟩ added."""
        if not self.size:
            return jnp.concatenate(end)
        return self.add(state, end, h * self.system.forces(t, q, v, params) @ v)

    def add(self, state: Array, end: list[Array], work: Array) -> Float[Array, " s"]:
        """The state (q1, p1) = `end` with this work added."""
        return jnp.concatenate([*end, state[2 * self.n :] + work])

    def row(self, state: Array) -> dict[str, Array]:
        """What is saved of it."""
        return {"work": state[2 * self.n]} if self.size else {}
