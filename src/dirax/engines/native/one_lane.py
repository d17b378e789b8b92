"""A single short trajectory in memory: its record, its parameters and all that it saves in one array, with few calls of NumPy."""

import math

import numpy as np

from dirax.engines.contract import OK, UNSOLVED, Problem
from dirax.engines.native.collocation_kernels import CollocationKernels
from dirax.engines.native.kernels import Kernels
from dirax.engines.native.lanes import TOGETHER, arrays_saved
from dirax.engines.native.loops.record import DOUBTFUL


class Places:
    """Where things stand in the array of a run of so many rows, in numbers: record · its copy · parameters · addresses of the
    rows · addresses of the closing row of a trajectory that ends early · of one that does not, whose closing row is the last of
    the rows · closing row · rows."""

    def __init__(self, p: Problem, made: Kernels | CollocationKernels, rows: int):
        self.rows, saved = rows, arrays_saved(p, made)
        self.record = made.record.size
        self.params = 2 * self.record
        self.outs = self.params + made.step.parameters.size
        self.early_outs = self.outs + len(saved)
        self.last_outs = self.early_outs + len(saved)
        self.guesses = [made.record.unknowns(i, stage.unknowns) for i, (stage, _) in enumerate(p.equation.stages)]
        at = self.last_outs + len(saved)
        self.fields, self.early, self.last = [], [], []
        """(name, first number, the one after the last, shape) of the saved arrays and of either closing row."""
        for name, shape, size, _ in saved:
            self.early.append((name, at, at + size, (1, *shape)))
            at += size
        for (name, shape, size, ends_before), early in zip(saved, self.early, strict=True):
            stop = at + (rows - ends_before) * size
            self.fields.append((name, at, stop, (1, rows - ends_before, *shape)))
            self.last.append(early if ends_before else (name, stop - size, stop, (1, *shape)))
            at = stop
        self.size = at
        self.addresses = 8 * np.array([first for _, first, _, _ in (*self.fields, *self.early, *self.last)])


class OneLane:
    """What `Lanes` is for many trajectories."""

    threads = width = 1

    def __init__(self, p: Problem, made: Kernels | CollocationKernels, places: Places):
        self.problem, self.record, self.places = p, made.record, places
        memory = self.memory = np.empty(places.size)
        if p.record is None:
            memory[: places.record] = 0.0
            memory[self.record.state] = p.state
            for place, guess in zip(places.guesses, p.guess, strict=True):
                memory[place] = guess
        else:
            memory[: places.record] = p.record[0][0]
        if places.outs > places.params:
            memory[places.params : places.outs] = made.step.parameters.flatten(p.params, None)
        self.address = memory.__array_interface__["data"][0]
        pointers = memory[places.outs : places.outs + len(places.addresses)].view(np.int64)
        np.add(places.addresses, self.address, out=pointers)
        self.numbers = p.t0, p.h, p.first_step
        self.fields = {name: memory[a:b].reshape(shape) for name, a, b, shape in places.fields}
        """The saved arrays."""

    def advance(self, kernel, first: int, stop: int, threads: int = 1) -> None:
        """Steps `first` to `stop` − 1."""
        p, places, at = self.problem, self.places, self.address
        numbers = (*self.numbers, first, stop, p.save_every, p.max_iterations)
        kernel(at, at + 8 * places.params, at + 8 * places.outs, 1, *numbers)

    @property
    def going(self) -> bool:
        """Whether the trajectory has neither failed nor ended before its time."""
        return self.memory[self.record.status] == OK

    @property
    def doubtful(self) -> bool:
        """Whether the sizes are in doubt."""
        return bool(self.memory[self.record.status] == DOUBTFUL)

    @property
    def stuck(self) -> bool:
        """Whether its step has not been solved."""
        return self.memory[self.record.status] in UNSOLVED

    def attempt(self, numbers: np.ndarray, made: Kernels | CollocationKernels, table: np.ndarray) -> np.ndarray:
        """The record after going on from one, which is not kept."""
        kept, self.memory[: self.places.record] = self.memory[: self.places.record].copy(), table[0]
        steps = self.problem.steps
        self.advance(made.runs.kernel(1, steps)[0], int(table[0, self.record.completed]), steps)
        after = self.memory[: self.places.record].copy()
        self.memory[: self.places.record] = kept
        return after[None]

    def put(self, numbers: np.ndarray, table: np.ndarray) -> None:
        """Have it go on from a record."""
        self.memory[: self.places.record] = table[0]

    def close(self, kernel) -> dict[str, np.ndarray]:
        """The row of the last state, which is the last one saved where the trajectory did not end early."""
        memory, places, at = self.memory, self.places, self.address
        done = memory[self.record.completed] == self.problem.steps
        outs, closing = (places.last_outs, places.last) if done else (places.early_outs, places.early)
        memory[places.record : places.params] = memory[: places.record]
        kernel(at + 8 * places.record, at + 8 * places.params, at + 8 * outs, 1, *self.numbers, 0, 1, 1,
               self.problem.max_iterations)  # fmt: skip
        return {name: memory[a:b].reshape(shape) for name, a, b, shape in closing}

    @property
    def closing_status(self) -> np.ndarray:
        """How the step ended that leaves the last state."""
        return self.memory[self.places.record + self.record.status][None]

    def table(self) -> np.ndarray:
        """The record, (1, quantities)."""
        return self.memory[: self.places.record][None]


def places_of(p: Problem, made: Kernels | CollocationKernels) -> Places | None:
    """Where things stand in a run; None for one that is not short or begins with a later
    row, and for a batch."""
    if p.batch is not None or p.first_row:
        return None
    rows = p.rows
    if made.places is None or made.places.rows != rows:
        if rows * sum(math.prod(saved.shape) for saved in arrays_saved(p, made)) > TOGETHER:
            return None
        made.places = Places(p, made, rows)
    return made.places
