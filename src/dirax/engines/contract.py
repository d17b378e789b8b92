"""What an engine is asked, what it gives back, and what holds where a trajectory fails, whichever engine it is.

**Trajectories that fail.** A trajectory ends with its last good step: the next one has no solution that Newton's method finds
(`NOT_CONVERGED`), or one that is not finite (`NOT_FINITE`). Then

1. nothing is raised: `completed` counts the good steps of each trajectory and `status` says why there is no other, `OK` where
   the run ended; Ctrl-C ends a run too, with `interrupted` and the status `OK`;
2. `last_state` is the state after the last good step, `last_unknowns` the unknowns of the first stage in it, and `closing` the
   row of that state, of every trajectory, failed or not; for one that fails in its first step they are the start;
3. `fields` hold what was computed for every saved row before the end, the closing row at the end if that is a saved row, and
   NaN after it. An engine ends with `return finished(problem, outcome)`, which writes both over whatever stood there;
4. the others of a batch do not change in a bit;
5. under JAX's transformations all of this holds of values, and derivatives: no derivative passes through a step that failed,
   those of the good rows of the one that fails and of the others are those that they have without it, and finite.

`tests/engines/test_contract.py` asks this of every engine.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import jax.numpy as jnp
import numpy as np

from dirax.schemes.step import Field

OK, NOT_CONVERGED, NOT_FINITE = 0, 1, 2
"""Outcome of a trajectory's last attempted step."""

UNSOLVED = NOT_CONVERGED, NOT_FINITE
"""Those of a step without a solution."""

TOO_LARGE = "Newton's method is too large for this engine"
"""In the note on an iteration that did not converge, and is the only one that the engine has for the step."""

FIXED_POINT, ALL_UNKNOWNS = "fixed point of the", "Newton of all unknowns"
"""In the note on an iteration that begins as one of rates, and that goes on with the equations of all nodes."""

Progress = Callable[[int, int], None]
"""Called with (steps done, steps in all)."""


def size_of(equation: Any) -> int:
    """The most unknowns of a stage of a step, or entries of its state."""
    return max(max(stage.unknowns, stage.state_size) for stage, _ in equation.stages)


@dataclass(frozen=True)
class Problem:
    """A run: an equation (or a sequence of them), where it starts, and what is to be saved.

    `state` (s,) or (B, s) and `guess` (k,) or (B, k), one guess per stage; `params` a pytree, with a leading batch axis
    when `batch_params`. Rows are saved every `save_every` steps, and the last one always. Steps are numbered from
    `first_step` (1 after a two-point start), so the first state is at time t0 + first_step·h.

    A run that goes on has the `record` that the engine gave after its first `after` steps: rows of these need not be computed
    again, and whatever stands in them is written over. An engine may run all of it instead, since the bits are the same, unless
    rows before `first_row` are not wanted: then the saved arrays begin with that one, at step `after` or before it.

    What is to be run `often`, with other numbers, is worth any time that an engine takes to get ready.
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
    after: int = 0
    record: Any = None
    first_row: int = 0
    often: bool = False

    @property
    def size(self) -> int:
        """`size_of` its equation."""
        return size_of(self.equation)

    @property
    def rows(self) -> int:
        """Number of saved rows, the first and the last included."""
        return -(-self.steps // self.save_every) + 1 - self.first_row

    def with_numbers(self, **numbers: Any) -> "Problem":
        """The same problem with other numbers, steps or rows; what was found of its equation is kept."""
        problem = object.__new__(Problem)
        object.__setattr__(problem, "__dict__", {**self.__dict__, **numbers})
        return problem

    @cached_property
    def fields(self) -> dict[str, Field]:
        """The named arrays of a row: those of the first stage, at which every row is."""
        return self.equation.stages[0][0].fields

    @cached_property
    def row_size(self) -> int:
        """Numbers in a row of one trajectory, the time among them."""
        return 1 + sum(math.prod(field.shape) for field in self.fields.values())

    @cached_property
    def review(self) -> Callable[[dict[str, Any]], dict[str, Any]]:
        """What the first stage finds to say of saved arrays."""
        return self.equation.stages[0][0].review

    def is_node(self, name: str) -> bool:
        """Whether a field has a row for the first and the last state, and not for the steps between them alone."""
        return self.fields[name].place == "node"


@dataclass
class Outcome:
    """The saved arrays, and how each trajectory ended; the module says what holds where one fails.

    Everything has the axis of the batch in front, of length 1 for one trajectory. `fields[name]` is (B, rows, …) for node
    fields, with one row less for step fields. `completed` (B,) counts good steps; `status` is one of the outcomes above;
    `closing` is the row at each trajectory's last good step; `last_state` and `last_unknowns` are the state there and the
    unknowns before it, for the message. `iterations` (B,) are updates of Newton's method, `max_residual` (B,) the largest
    entry of the residual that any good step left, or of the last change of the rates where a fixed point of these was
    iterated. `notes` go to `Solution.stats`. `record` is what the engine needs to go on after the last step, a tuple of NumPy
    arrays; None where it would begin anew. `unsaid` (B,) says of trajectories whether nodes are made of the step that leaves
    them, and none was found at the last; None where that is not known.
    """

    fields: dict[str, Any]
    closing: dict[str, Any]
    completed: Any
    status: Any
    iterations: Any
    max_residual: Any
    last_state: Any
    last_unknowns: Any
    engine: str
    interrupted: bool = False
    compile_seconds: float = 0.0
    run_seconds: float = 0.0
    record: Any = None
    unsaid: Any = None
    notes: dict[str, Any] = field(default_factory=dict)


def saved_steps(problem: Problem) -> np.ndarray:
    """The step number of each saved row, counted from the problem's first state: 0, s, 2s, …, steps, as exact floats."""
    first = problem.first_row
    numbers = np.arange(first, first + problem.rows, dtype=float)  # in place from here on: a long run has no memory to waste
    if problem.save_every != 1:
        numbers *= problem.save_every
    numbers[-1] = problem.steps
    return numbers


def finished(problem: Problem, outcome: Outcome, held: bool = False) -> Outcome:
    """The outcome with the closing row at the end of each trajectory and NaN after it, written into its fields.

    With `held` the closing row stands in the rows after the end, too: functions of those have finite derivatives.
    """
    fields, completed = outcome.fields, outcome.completed
    if isinstance(completed, np.ndarray) and np.all(completed == problem.steps):
        for name in filter(problem.is_node, fields):
            fields[name][:, -1] = outcome.closing[name]
        return outcome
    numbers = saved_steps(problem)
    if not isinstance(completed, np.ndarray):
        good = completed.astype(float)
        for name, values in fields.items():
            node = problem.is_node(name)
            fields[name] = _ended(values, outcome.closing[name], numbers, good, node, held, jnp.where)
        return outcome
    ended = np.flatnonzero(completed < problem.steps)
    for name, values in fields.items():
        node, closing = problem.is_node(name), outcome.closing[name]
        if node:
            values[completed == problem.steps, -1] = closing[completed == problem.steps]
        if len(ended):
            good = completed[ended].astype(float)
            values[ended] = _ended(values[ended], closing[ended], numbers, good, node, held, np.where)
    return outcome


def _ended(values, closing, numbers, completed, node: bool, held: bool, where: Callable):
    """Rows (B, rows, …) whose trajectories end at step number `completed` (B,)."""
    at = numbers if node else numbers[:-1]
    column = (slice(None), slice(None), *(None,) * (values.ndim - 2))
    if not node and not held:
        return where((at[None, :] < completed[:, None])[column], values, np.nan)
    kept = where((at[None, :] < completed[:, None])[column], values, closing[:, None])
    return kept if held else where((at[None, :] <= completed[:, None])[column], kept, np.nan)


def cut(problem: Problem, outcome: Outcome) -> tuple[np.ndarray, dict[str, Any]]:
    """The step numbers of the rows and the fields of one trajectory, (1, rows, …), without those after its last good step,
    which is added as a row if it was not to be saved."""
    numbers, completed = saved_steps(problem), int(outcome.completed[0])
    if completed == problem.steps:
        return numbers, outcome.fields
    rows = int(np.searchsorted(numbers, completed, side="left"))  # rows before the last good step
    kept = {name: values[:, :rows] for name, values in outcome.fields.items()}
    for name in filter(problem.is_node, kept):
        kept[name] = np.concatenate([kept[name], outcome.closing[name][:, None]], axis=1)
    return np.append(numbers[:rows], completed), kept
