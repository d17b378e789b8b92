"""A walk: steps of one trajectory, a few at a time from states that are given, where it is not known beforehand how many."""

from abc import ABC, abstractmethod
from collections.abc import Callable

import numpy as np

from dirax.engines.contract import Outcome, Problem, Progress


class AbstractWalk(ABC):
    """Steps of a problem of one trajectory and one part, of which every one is saved.

    `rows` are the saved arrays, (steps, …) of every field, without the closing row; `state` and `unknowns` those after the last
    `go`; `iterations` and `max_residual` those of all steps.
    """

    def __init__(self, problem: Problem):
        self.problem = problem
        self.rows = {name: np.full((problem.steps, *field.shape), np.nan) for name, field in problem.fields.items()}
        self.state, self.unknowns = np.asarray(problem.state), np.asarray(problem.guess[0])
        self.iterations, self.max_residual = 0, 0.0

    @abstractmethod
    def go(self, state: np.ndarray, unknowns: np.ndarray, first: int, stop: int, t: float, h: float) -> int:
        """Steps `first` to `stop` − 1, of length h and from this state at the time t on; how many of them have a solution."""


class WalkByRuns(AbstractWalk):
    """Every `go` is a run of an engine."""

    def __init__(self, problem: Problem, run: Callable[[Problem, Progress | None], Outcome]):
        super().__init__(problem)
        self.run = run

    def go(self, state: np.ndarray, unknowns: np.ndarray, first: int, stop: int, t: float, h: float) -> int:
        count = stop - first
        problem = self.problem.with_numbers(state=state, guess=(unknowns,), t0=t, h=h, steps=count, save_every=1)
        out = self.run(problem, None)
        for name, values in self.rows.items():
            values[first:stop] = out.fields[name][0][:count]
        self.state, self.unknowns = np.asarray(out.last_state[0]), np.asarray(out.last_unknowns[0])
        self.iterations += int(out.iterations[0])
        self.max_residual = max(self.max_residual, float(out.max_residual[0]))
        if out.interrupted:
            raise KeyboardInterrupt
        return int(out.completed[0])
