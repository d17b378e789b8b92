"""What the steps of a scheme satisfy, however they were solved, as objects that measure saved rows.

A scheme gives two of them: its discrete Dirac structure, which rows that follow each other belong to, and the form on its
states whose change in one step is known.
"""

from abc import abstractmethod
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dirax.numerics.arrays import Data


class Claim(NamedTuple):
    """One thing that a structure says of every step: the `quantity` by its name, the names of its `parts`, the numbers by
    which it is missed, and what it says in words. What is `solved` for together with the other unknowns of a step has a rounding
    of each of their equations."""

    quantity: str
    parts: tuple[str, ...]
    statement: str
    solved: bool = False


class AbstractDiscreteStructure(eqx.Module):
    """A relation between consecutive rows of a trajectory that every step of a scheme satisfies.

    It reads nothing but saved arrays and the system's functions, never how a step was solved.
    """

    @property
    @abstractmethod
    def points(self) -> int:
        """How many consecutive rows it joins."""

    @property
    @abstractmethod
    def reads(self) -> tuple[str, ...]:
        """The names of the saved arrays that it reads."""

    @property
    @abstractmethod
    def claims(self) -> tuple[Claim, ...]:
        """What it says; the first claim has the structure's name."""

    @property
    def without_matrix(self) -> bool:
        """Whether membership is found without a matrix of all coordinates, as large systems need it."""
        return False

    @abstractmethod
    def membership_terms(self, rows: dict[str, Array], params: Any) -> Float[Array, "2 numbers"]:
        """By how much rows miss it, and the sizes of the terms of that: of what cancels, and of what it changes when every
        coordinate is changed by itself. `counts` says how many numbers each part of the claims has.

        `rows`: the arrays that it reads, those of nodes (points, …) and those of the steps between (points − 1, …), and the
        times "t" (points,). A size may vanish at a point: over a trajectory, the largest one is that of the terms.
        """

    @property
    def counts(self) -> tuple[int, ...]:
        """How many numbers each part of the claims has: equations with units of their own are judged apart."""
        return tuple(1 for claim in self.claims for _ in claim.parts)

    def membership_defect(self, rows: dict[str, Array], params: Any) -> Float[Array, " parts"]:
        """By how much rows miss it, one number for each part of the claims, relative to the sizes of the terms at these rows."""
        missed, sizes = self.membership_terms(rows, params)
        relative, ends = missed / nonzero(sizes), np.cumsum(self.counts)[:-1].tolist()
        return jnp.stack([jnp.max(part, initial=0.0) for part in jnp.split(relative, ends)])

    @property
    def given(self) -> tuple[str, ...]:
        """The parts that at the first row judge a pair of points from which a run starts: given, not computed."""
        return ()

    @property
    def step_form(self) -> "AbstractStepForm | str":
        """The form whose change the forces of the constraints are, or why none is known."""
        return f"no relation between the two-forms before and after a step is known for the {self.claims[0].quantity}"

    @property
    def theta(self) -> float | None:
        """The fraction of a step at which a map that the steps are made by has its base point; None where none does."""
        return None

    def curved(self, n: int) -> bool:
        """Whether points x (n,) are those of a curved submanifold."""
        return False

    @property
    def own_states(self) -> bool:
        """Whether `step_form` is that of every state of the scheme, which need not be (q, p)."""
        return False

    @property
    def own_constraints(self) -> bool:
        """Whether a step imposes constraints between its points, whose terms have the sizes `constraint_size`."""
        return False

    def constraint_size(self, row: Data, speed: Array, params: Any) -> Float[Array, " k"]:
        """The sizes of the terms of the constraints that a step imposes between its points, at a saved row with its time "t".
        `speed`: the largest |Δq|/h."""
        raise NotImplementedError


class DifferentiatedStep(NamedTuple):
    """A step with its derivative: the new state (s,), ∂(new state)/∂(state) (s, s), and the condition number of its equations,
    at least 1; or many steps, in arrays with more axes in front."""

    state: Any
    jacobian: Any
    condition: Any


class AbstractStepForm(eqx.Module):
    """A form on the states of a scheme, and how one step changes it."""

    @property
    @abstractmethod
    def name(self) -> str:
        """What holds, by its name."""

    @property
    @abstractmethod
    def points(self) -> int:
        """How many consecutive rows it reads."""

    @property
    @abstractmethod
    def reads(self) -> tuple[str, ...]:
        """The names of the saved arrays that it reads, those of nodes."""

    @abstractmethod
    def begins(self, equation: Any, rows: Data, params: Any) -> tuple[Float[Array, " s"], Float[Array, " k"]]:
        """(state, first guess) of the step that begins at the last of the rows, for the first part of `equation`.

        `rows`: the arrays that it reads (points, …) and the times "t" (points,).
        """

    @abstractmethod
    def terms(self, step: DifferentiatedStep, equation: Any, rows: Data, params: Any) -> Float[Array, "numbers 2 s s"]:
        """(by how much each entry of the form differs from what it is to be after that step, and the size of the terms that
        make it), each of which has units of its own; and pairs like it for the other numbers of `told` and `excuse`."""

    def excuse(self, numbers: Any) -> str:
        """Why the change is not what it is to be, where nothing says that it is in this case; empty where it is."""
        return ""

    def refusal(self, equation: Any, row: Data, params: Any) -> str:
        """Why the step does not start from a saved row; empty if it does."""
        return ""

    @abstractmethod
    def told(self, numbers: Any, place: str) -> str:
        """The numbers at the worst place, in words."""


def nonzero(values: Array) -> Array:
    """The values, with 1 in the place of 0, to divide by."""
    return jnp.where(values > 0, values, 1.0)
