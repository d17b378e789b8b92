"""The state (q, p) with the work of the forces carried beside it, for systems with forces."""

from typing import Any

from jaxtyping import Array, Float

from dirax.schemes.layout import Layout
from dirax.schemes.step import Field

BEYOND = "beyond"
"""The part of a first state that holds what the impulse at the first row is more than the half that belongs to the first step."""


class WorkOfForces:
    """The state (q, p, work) of a Lagrangian system with n coordinates; without forces `work` is empty.

    The work is that since the start, so that E_N − E_0 − work is what the method itself changes. `of_start` are the names and
    lengths of further parts, which belong to the first state: they are zero after a step.
    """

    def __init__(self, system: Any, n: int, **of_start: int):
        self.forces = getattr(system, "forces", None)
        self.size = int(self.forces is not None)
        self.layout = Layout(q=n, p=n, work=self.size, **of_start)

    @property
    def fields(self) -> dict[str, Field]:
        """What is saved of it."""
        return {"work": Field((), "node", (), "work of the forces since the start")} if self.size else {}

    def start(self, q: Float[Array, " n"], p: Float[Array, " n"], **of_start: Array) -> Float[Array, " s"]:
        """The first state."""
        return self.layout.join(q=q, p=p, **of_start)

    def after(
        self, state: Array, end: list[Array], t: Any, q: Array, v: Array, h: Any, params: Any, forces: Any = None
    ) -> Float[Array, " s"]:
        """The state (q1, p1) = `end` with the work h⟨f(t, q, v), v⟩ added, of these forces or those of the system."""
        forces = self.forces if forces is None else forces
        return self.add(state, end, None if forces is None else h * forces(t, q, v, params) @ v)

    def add(self, state: Array, end: list[Array], work: Array | None) -> Float[Array, " s"]:
        """The state (q1, p1) = `end` with this work added, None without forces."""
        before = self.layout.split(state).work
        return self.layout.join(q=end[0], p=end[1], work=before if work is None else before + work)

    def row(self, state: Array) -> dict[str, Array]:
        """What is saved of a state."""
        return {"work": self.layout.split(state).work[0]} if self.size else {}
