"""A single short trajectory: its record, its parameters and all that it saves in one array, which the next run takes over."""

import math
from functools import cached_property
from typing import Any

import numpy as np

from dirax.engines.contract import OK, UNSOLVED, Problem
from dirax.engines.native.at_once import Orders
from dirax.engines.native.collocation_kernels import CollocationKernels
from dirax.engines.native.kernels import Kernels
from dirax.engines.native.lanes import Closed, arrays_saved
from dirax.engines.native.loops.record import DOUBTFUL

SHORT = 2**13
"""Numbers to save up to which a run is short, whose memory is kept for the next one."""


class Rows(dict):
    """Arrays by name that are made of a part of the memory of a run where they are asked for."""

    def __init__(self, memory: np.ndarray, places: dict[str, tuple[int, int, tuple[int, ...]]]):
        self._memory, self._places = memory, places

    def __missing__(self, name: str) -> np.ndarray:
        first, stop, shape = self._places[name]
        found = self[name] = self._memory[first:stop].reshape(shape)
        return found


class OneLane:
    """What `Lanes` is for many trajectories, for runs of so many rows.

    In its memory stand, in numbers: record · its copy · parameters · addresses of the rows · addresses of the closing row of a
    trajectory that ends early · of one that does not, whose closing row is the last of the rows · closing row · rows.
    """

    threads = width = 1
    problem: Problem

    def __init__(self, p: Problem, made: Kernels | CollocationKernels, rows: int):
        self.record, self.rows, saved = made.record, rows, arrays_saved(p, made)
        self.flatten = made.step.parameters.flatten
        record = made.record.size
        params = 2 * record
        outs = params + made.step.parameters.size
        at = outs + 3 * len(saved)
        fields, early, last = {}, {}, {}  # (first number, the one after the last, shape)
        for name, shape, size, _ in saved:
            early[name] = at, at + size, (1, *shape)
            at += size
        for name, shape, size, ends_before in saved:
            stop = at + (rows - ends_before) * size
            fields[name] = at, stop, (1, rows - ends_before, *shape)
            last[name] = early[name] if ends_before else (stop - size, stop, (1, *shape))
            at = stop
        self._fields, self._early, self._last = fields, early, last
        memory = self.memory = np.zeros(at)
        first = self._at = memory.ctypes.data
        pointers = [first + 8 * begin for part in (fields, early, last) for begin, _, _ in part.values()]
        memory[outs : outs + len(pointers)].view(np.int64)[:] = pointers
        self._params_at, self._outs_at = first + 8 * params, first + 8 * outs
        self._size, self._early_at, self._last_at = record, self._outs_at + 8 * len(saved), self._outs_at + 16 * len(saved)
        self._own, self._copy, self._status = memory[:record], memory[record:params], made.record.status
        self._completed = made.record.completed
        self._state, self._params = self._own[made.record.state], memory[params:outs] if outs > params else None
        self._guesses = [self._own[made.record.unknowns(i, stage.unknowns)] for i, (stage, _) in enumerate(p.equation.stages)]

    def begin(self, p: Problem) -> None:
        """Take a trajectory."""
        self.problem = p
        if p.record is None:
            self._own[:] = 0.0
            self._state[:] = p.state
            for place, guess in zip(self._guesses, p.guess, strict=True):
                place[:] = guess
        else:
            self._own[:] = p.record[0][0]
        if self._params is not None:
            self._params[:] = self.flatten(p.params, None)
        self._numbers = p.t0, p.h, p.first_step

    def advance(self, kernel, first: int, stop: int, threads: int = 1) -> None:
        """Steps `first` to `stop` − 1."""
        p = self.problem
        kernel(self._at, self._params_at, self._outs_at, 1, *self._numbers, first, stop, p.save_every, p.max_iterations)

    @property
    def going(self) -> bool:
        """Whether the trajectory has neither failed nor ended before its time."""
        return self._own[self._status] == OK

    @property
    def doubtful(self) -> bool:
        """Whether the sizes are in doubt."""
        return bool(self._own[self._status] == DOUBTFUL)

    @property
    def stuck(self) -> bool:
        """Whether its step has not been solved."""
        return self._own[self._status] in UNSOLVED

    def attempt(self, numbers: np.ndarray, made: Kernels | CollocationKernels, table: np.ndarray) -> np.ndarray:
        """The record after going on from one, which is not kept."""
        kept, self._own[:] = self._own.copy(), table[0]
        steps = self.problem.steps
        self.advance(made.runs.kernel(1, steps)[0], int(table[0, self.record.completed]), steps)
        after, self._own[:] = self._own.copy(), kept
        return after[None]

    def put(self, numbers: np.ndarray, table: np.ndarray) -> None:
        """Have it go on from a record."""
        self._own[:] = table[0]

    @cached_property
    def orders(self) -> Orders:
        """What a call for the whole run is told of this memory."""
        at, size = self._at, 8 * self._size
        return Orders(
            record=at, params=self._params_at, outs=self._outs_at, early=self._early_at, last=self._last_at, copy=at + size,
            status=at + 8 * self._status, completed=at + 8 * self._completed, bytes=size,
        )  # fmt: skip

    def at_once(self, sizes: Any, kernel: Any) -> Closed | None:
        """What a run from its first step has found in one call; None, and where it was, for one that is in doubt or stuck."""
        self.orders.carry_out(sizes, kernel, self.problem)
        if self.going and self._own[self._completed] == self.problem.steps:
            return self._found(self._last)
        self.begin(self.problem)
        return None

    def close(self, kernel: Any) -> Closed:
        """What was found, with the row of the last state, which is the last one saved where the trajectory did not end early."""
        done, limit = self._own[self._completed] == self.problem.steps, self.problem.max_iterations
        outs, closing = (self._last_at, self._last) if done else (self._early_at, self._early)
        self._copy[:] = self._own
        kernel(self._at + 8 * self._size, self._params_at, outs, 1, *self._numbers, 0, 1, 1, limit)
        return self._found(closing)

    def _found(self, closing: dict[str, tuple[int, int, tuple[int, ...]]]) -> Closed:
        size, found = self._size, self.memory.copy()
        fields = {name: found[a:b].reshape(shape) for name, (a, b, shape) in self._fields.items()}
        return Closed(found[None, :size], fields, Rows(found, closing), found[None, size + self._status])

    def table(self) -> np.ndarray:
        """The record, (1, quantities)."""
        return self._own[None].copy()


def one_lane(p: Problem, made: Kernels | CollocationKernels) -> OneLane | None:
    """The memory of a run, of one before it where that was as long; None for one that is not short or begins with a later row,
    and for a batch."""
    if p.batch is not None or p.first_row:
        return None
    lane = _idle(made.idle)
    if lane is None or lane.rows != p.rows:
        if p.rows * sum(math.prod(saved.shape) for saved in arrays_saved(p, made)) > SHORT:
            return None
        lane = OneLane(p, made, p.rows)
    lane.begin(p)
    return lane


def _idle(kept: list[Any]) -> Any:
    """What is kept, taken from there; None where another thread has it."""
    try:
        return kept.pop()
    except IndexError:
        return None
