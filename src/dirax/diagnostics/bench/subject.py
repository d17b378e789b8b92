"""What is timed: a run of a system with a scheme, as problems for the engines, one trajectory or a batch."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.engines.contract import Outcome, Problem
from dirax.engines.lifted import lifted
from dirax.run.start import begun, completed
from dirax.run.validate import Case, initial_data
from dirax.schemes.step import AbstractScheme, Shape, make_step_equation
from dirax.systems.system import AbstractSystem


class Skipped(Exception):
    """Why a program is left out of the comparison; the message is shown."""


def library(name: str) -> Any:
    """A library that need not be there; raises `Skipped` without it."""
    try:
        return import_module(name)
    except ImportError:
        raise Skipped(f"{name.split('.')[0]} is not installed") from None


@dataclass(frozen=True)
class Program:
    """Something that computes the trajectory: `run()` returns the seconds that it took, of one trajectory and `steps` steps.

    `end()` gives q (or x) at the end of the latest run, None where it is not one trajectory; `settings` says how it ran.
    """

    run: Callable[[], float]
    end: Callable[[], np.ndarray | None]
    settings: Mapping[str, Any]


@dataclass(frozen=True)
class Subject:
    """A run: `initial` holds one of the pairs of initial data of `dx.simulate`, of one trajectory; with `project` they are
    moved onto the constraint."""

    name: str
    system: AbstractSystem
    scheme: AbstractScheme
    initial: Mapping[str, Any]
    step: float
    steps: int
    params: Any = None
    project: bool = False

    @property
    def span(self) -> float:
        """The time that the trajectory covers."""
        return self.step * self.steps

    @cached_property
    def arrays(self) -> dict[str, jax.Array]:
        return self._projected(initial_data(dict(self.initial))[0])

    def _projected(self, data: dict[str, jax.Array]) -> dict[str, jax.Array]:
        if not self.project:
            return data
        complete = self.system.complete(data, self.leaves, True)
        return {name: complete[name] for name in data}

    @cached_property
    def leaves(self) -> Any:
        """The parameters, their leaves as arrays."""
        return jax.tree.map(jnp.asarray, self.params)

    @cached_property
    def equation(self) -> Any:
        """The equation of a step; raises `Skipped` for a composition, for which the other programs are not written."""
        equation = make_step_equation(self.scheme, self.system, Shape(*self.system.sizes(self.arrays, self.leaves)))
        if len(equation.stages) > 1:
            raise Skipped("the scheme is a composition")
        return lifted(equation, self.leaves, False)

    @cached_property
    def one(self) -> Problem:
        """The whole run of one trajectory, of which only the end is saved."""
        return self._problem(self.arrays, None, self.steps)

    def batch(self, outcome: Outcome, size: int, steps: int) -> Problem:
        """`size` trajectories of `steps` steps, from points spread along the rows of `outcome`, which is a run of this."""
        pair = ("x",) if "x" in outcome.fields else ("q", "p")
        rows = {name: np.asarray(outcome.fields[name][0]) for name in pair}
        chosen = np.linspace(0, len(rows[pair[0]]) - 1, size).astype(int)
        return self._problem({name: jnp.asarray(values[chosen]) for name, values in rows.items()}, size, steps)

    def _problem(self, data: dict[str, jax.Array], batch: int | None, steps: int) -> Problem:
        case = Case(data, self.leaves, self.step, 0.0, batch)
        start = begun(self.equation, case, completed(self.system, case, project=False))
        return Problem(
            equation=self.equation,
            state=np.asarray(start.state),
            guess=tuple(np.asarray(u) for u in start.guess),
            h=self.step,
            t0=0.0,
            steps=steps - int(case.two_points),
            save_every=steps,
            first_step=int(case.two_points),
            params=self.leaves,
            batch=batch,
        )

    @cached_property
    def shown(self) -> str:
        """The name of the field whose end is compared: x, or else q."""
        return "x" if "x" in self.equation.stages[0][0].fields else "q"

    def position(self, state: Any, unknowns: Any) -> np.ndarray:
        """q or x of a state that is reached by `steps` steps; `unknowns` belong to a step near it."""
        row = self.equation.unpack(jnp.asarray(state), jnp.asarray(unknowns), self.span, self.step, self.leaves)
        return np.asarray(row[self.shown])
