"""The trajectories of a run in memory: records in blocks of lanes, saved arrays, and calls of a kernel on several threads."""

import itertools
import math
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from typing import Any, NamedTuple

import jax
import numpy as np

from dirax.engines.contract import OK, UNSOLVED, Problem
from dirax.engines.native.collocation_kernels import CollocationKernels
from dirax.engines.native.kernels import Kernels
from dirax.engines.native.loops.record import DOUBTFUL
from dirax.engines.threads import thread_count
from dirax.program import machine_code as llvm

SHARES = 4
"""Parts of a batch per thread, so that a thread that is held up holds up little."""

TOGETHER = 2**17
"""Numbers to save up to which all arrays are parts of one, since it takes a microsecond to find where an array begins."""


def width_for(batch: int) -> int:
    """Lanes side by side for a batch."""
    widest = llvm.vector_width()
    return 1 if batch == 1 else next((w for w in (2, 4) if batch <= w <= widest), widest)


class Saved(NamedTuple):
    """An array that a kernel saves: its name and shape in a row, and whether the last row has none."""

    name: str
    shape: tuple[int, ...]
    size: int
    ends_before: bool


class Closed(NamedTuple):
    """What was found of trajectories: their records (B, quantities), the saved arrays, the rows of their last states, and how
    the steps ended that leave these."""

    table: np.ndarray
    fields: dict[str, np.ndarray]
    closing: dict[str, np.ndarray]
    closing_status: np.ndarray


def arrays_saved(p: Problem, made: Kernels | CollocationKernels) -> list[Saved]:
    """The arrays of a kernel, in its order."""
    if made.saved is None:
        rows = made.step.equations[made.step.stages[0][0]].rows
        stages = len(p.equation.stages)
        front = lambda name: (stages,) if stages > 1 and p.fields[name].rule == "each" else ()
        shapes = {name: (*front(name), *rows[name].shape) for name in sorted(rows)}
        made.saved = [Saved(name, shape, math.prod(shape), not p.is_node(name)) for name, shape in shapes.items()]
    return made.saved


def _address(array: np.ndarray) -> int:
    return array.ctypes.data


class Lanes:
    """The records of all trajectories in blocks of `width` lanes: (blocks, quantities, width) doubles.

    The last block is filled up with copies of its first lane, which write where that one writes.
    """

    def __init__(self, problem: Problem, made: Kernels | CollocationKernels, width: int):
        p = self.problem = problem
        self.width, self.record = width, made.record
        self.lanes = p.batch or 1
        self.blocks = -(-self.lanes // width)
        self.threads = min(thread_count(), self.blocks) if self.blocks > 1 else 1
        if p.record is None:
            table = np.zeros((self.lanes, self.record.size))
            table[:, self.record.state] = p.state
            for stage, guess in enumerate(p.guess):
                table[:, self.record.unknowns(stage, np.shape(guess)[-1])] = guess
        else:
            table = np.array(p.record[0])
        self.records = self._blocked(table)
        leaves = made.step.parameters.flatten(p.params, p.batch if p.batch_params else None)
        self.params = self._blocked(np.broadcast_to(leaves, (self.lanes, leaves.shape[-1])))
        self.saved = arrays_saved(p, made)
        self.outs: Any = None
        self._at = _address(self.params), self.params.strides[0]

    @cached_property
    def source(self) -> np.ndarray:
        """The trajectory of every lane."""
        source = np.arange(self.blocks * self.width)
        source[self.lanes :] = (self.blocks - 1) * self.width
        return source

    @cached_property
    def fields(self) -> dict[str, np.ndarray]:
        """The saved arrays of the run."""
        made, outs = self.arrays(self.problem.rows)
        before = [8 * self.problem.first_row * saved.size for saved in self.saved]  # where row 0 would be
        self.outs = outs - np.array(before)[:, None]
        return made

    def advance(self, kernel, first: int, stop: int, threads: int = 1) -> None:
        """Steps `first` to `stop` − 1 of all trajectories."""
        _ = self.fields  # makes them
        self.call(kernel, self.records, self.outs, first, stop, self.problem.save_every, threads)

    @property
    def doubtful(self) -> bool:
        """Whether there is a trajectory with sizes in doubt."""
        return bool((self.records[:, self.record.status] == DOUBTFUL).any())

    @property
    def stuck(self) -> bool:
        """Whether there is a trajectory whose step has not been solved."""
        return bool(np.isin(self.records[:, self.record.status], UNSOLVED).any())

    def close(self, kernel) -> Closed:
        """What was found, with the rows of the last states."""
        closing, outs = self.arrays(2)
        closed = self.records.copy()
        self.call(kernel, closed, outs, 0, 1, 1, self.threads)
        status = closed[:, self.record.status].reshape(-1)[: self.lanes]
        return Closed(self.table(), self.fields, {name: rows[:, 0] for name, rows in closing.items()}, status)

    def attempt(self, numbers: np.ndarray, made: Kernels | CollocationKernels, table: np.ndarray) -> np.ndarray:
        """The records (n, quantities) after some of the trajectories went on from others, which are not kept: one by one, since
        each is at another step, and with the bits that it has alone."""
        p, kernel = self.problem, made.runs.kernel(1, self.problem.steps)[0]
        params = jax.tree.map(lambda a: np.asarray(a)[numbers], p.params) if p.batch_params else p.params
        alone = Lanes(p.with_numbers(params=params, batch=len(numbers), record=(table,)), made, 1)
        blocks, places = np.divmod(numbers, self.width)
        outs = np.ascontiguousarray(self.outs[blocks, :, places][:, :, None])
        for i, done in enumerate(table[:, self.record.completed].astype(int).tolist()):
            one = slice(i, i + 1)
            alone.call(kernel, alone.records[one], outs[one], done, p.steps, p.save_every, 1, i)
        return alone.table()

    def put(self, numbers: np.ndarray, table: np.ndarray) -> None:
        """Have some of the trajectories go on from these records."""
        slots = np.flatnonzero(np.isin(self.source, numbers))  # a lane that fills up a block is a copy of another one
        blocks, places = np.divmod(slots, self.width)
        self.records[blocks, :, places] = table[np.searchsorted(numbers, self.source[slots])]

    def _blocked(self, table: np.ndarray) -> np.ndarray:
        if self.lanes == self.width == 1:
            return table.reshape(1, -1, 1)
        return np.ascontiguousarray(table[self.source].reshape(self.blocks, self.width, -1).swapaxes(1, 2))

    def table(self) -> np.ndarray:
        """The records of all trajectories, (B, quantities)."""
        return self.records.swapaxes(1, 2).reshape(self.blocks * self.width, -1)[: self.lanes]

    @property
    def going(self) -> bool:
        """Whether a trajectory has neither failed nor ended before its time."""
        return bool((self.records[:, self.record.status] == OK).any())

    def arrays(self, rows: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Room for the saved arrays of so many rows, and the (blocks, fields, width) addresses of their rows 0."""
        lanes = self.lanes
        counts = [rows - saved.ends_before for saved in self.saved]
        sizes = [lanes * count * saved.size for count, saved in zip(counts, self.saved, strict=True)]
        ends = list(itertools.accumulate(sizes, initial=0))
        if ends[-1] <= TOGETHER:
            whole = np.empty(ends[-1])
            parts, first = [whole[a:b] for a, b in itertools.pairwise(ends)], _address(whole)
            begins = [first + 8 * end for end in ends[:-1]]
        else:
            parts = [np.empty(size) for size in sizes]
            begins = [_address(part) for part in parts]
        made = {
            saved.name: part.reshape(lanes, count, *saved.shape)
            for saved, part, count in zip(self.saved, parts, counts, strict=True)
        }
        if lanes == self.width == 1:
            return made, np.array(begins).reshape(1, -1, 1)
        steps = 8 * np.array(sizes)[:, None] // lanes
        table = np.array(begins)[:, None] + steps * self.source
        return made, np.ascontiguousarray(table.reshape(-1, self.blocks, self.width).swapaxes(0, 1))

    def call(
        self, kernel, records: np.ndarray, outs: np.ndarray, first: int, stop: int, every: int, threads: int, block: int = 0
    ) -> None:
        """Steps `first` to `stop` − 1 of the trajectories of these records, whose first block has number `block`; blocks shared
        among threads. Ctrl-C waits for their end."""
        p = self.problem
        numbers = (p.t0, p.h, p.first_step, first, stop, every, p.max_iterations)
        params, stride = self._at
        if len(records) == 1:
            kernel(_address(records), params + block * stride, _address(outs), 1, *numbers)
            return
        places = (_address(records), records.strides[0]), (params + block * stride, stride), (_address(outs), outs.strides[0])

        def part(low: int, high: int) -> None:
            kernel(*[place + low * stride for place, stride in places], high - low, *numbers)

        if threads == 1:
            part(0, len(records))
            return
        bounds = np.linspace(0, self.blocks, min(self.blocks, SHARES * threads) + 1).astype(int).tolist()
        with ThreadPoolExecutor(threads) as pool:
            for future in [pool.submit(part, a, b) for a, b in itertools.pairwise(bounds)]:
                future.result()
