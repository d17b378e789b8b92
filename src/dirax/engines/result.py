"""What an engine is asked and what it gives back, whichever engine it is."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

OK, NOT_CONVERGED, NOT_FINITE = 0, 1, 2
"""Outcome of a trajectory's last attempted step."""


@dataclass(frozen=True)
class Problem:
    """A run: an equation (or a sequence of them), where it starts, and what is to be saved.

    `state` (s,) or (B, s) and `guess` (k,) or (B, k), one guess per stage; `params` a pytree, with a leading batch axis
    when `batch_params`. Rows are saved every `save_every` steps, and the last one always. Steps are numbered from
    `first_step` (1 after a two-point start), so the first state is at time t0 + first_step·h.
    """

    equation: Any
    state: Any
    guess: Any
    h: float
    t0: float
    steps: int
    save_every: int = 1
    first_step: int = 0
    params: Any = None
    batch: int | None = None
    batch_params: bool = False
    max_iterations: int = 50
    compensated: bool = False

    @property
    def size(self) -> int:
        """The most unknowns of a stage, or entries of the state."""
        return max(max(stage.unknowns, stage.state_size) for stage, _ in self.equation.stages)

    @property
    def rows(self) -> int:
        """Number of saved rows, the first and the last included."""
        return -(-self.steps // self.save_every) + 1


@dataclass
class Outcome:
    """The saved arrays, and how each trajectory ended.

    `fields[name]` is (rows, …) or (B, rows, …) for node fields, with one row less for step fields. `completed` counts
    good steps per trajectory; `status` is one of the outcomes above; `closing` is the row at each trajectory's last good
    step; `last_state` and `last_unknowns` are the state there and the unknowns before it, for the message.
    """

    fields: dict[str, Any]
    closing: dict[str, Any]
    completed: Any
    status: Any
    iterations: Any
    max_residual: Any
    last_state: Any
    last_unknowns: Any
    interrupted: bool = False
    compile_seconds: float = 0.0
    run_seconds: float = 0.0
    engine: str = "xla"
    notes: dict[str, Any] = field(default_factory=dict)


Progress = Callable[[int, int], None]
"""Called with (steps done, steps in all)."""


def saved_steps(problem: Problem) -> np.ndarray:
    """The step number of each saved row, counted from the problem's first state: 0, s, 2s, …, steps, as exact floats."""
    numbers = np.arange(problem.rows, dtype=float)  # in place from here on: a long run has no memory to waste
    numbers *= problem.save_every
    numbers[-1] = problem.steps
    return numbers
