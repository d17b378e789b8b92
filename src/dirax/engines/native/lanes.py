"""The trajectories of a run in memory: records in blocks of lanes, saved arrays, and calls of a kernel on several threads."""

import dataclasses
import itertools
import math
import os
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar

import jax
import numpy as np

from dirax.engines.contract import OK, Problem
from dirax.engines.native import compile as llvm
from dirax.engines.native.collocation_kernels import CollocationKernels
from dirax.engines.native.kernels import Kernels
from dirax.engines.sizes import sizes_of

SHARES = 4
"""Parts of a batch per thread, so that a thread that is held up holds up little."""

TOGETHER = 2**17
"""Numbers to save up to which all arrays are parts of one, since it takes a microsecond to find where an array begins."""


def width_for(batch: int) -> int:
    """Lanes side by side for a batch."""
    widest = llvm.vector_width()
    return 1 if batch == 1 else next((w for w in (2, 4) if batch <= w <= widest), widest)


at_most: ContextVar[int | None] = ContextVar("at_most", default=None)
"""Threads for batches in this context, where several batches run side by side."""


def thread_count() -> int:
    """Threads for batches: as many as the context has, else DIRAX_THREADS, else the processors this process may use."""
    if (most := at_most.get()) is not None:
        return most
    chosen = os.environ.get("DIRAX_THREADS", "")
    if chosen.isdigit() and int(chosen) > 0:
        return int(chosen)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Lanes:
    """The records of all trajectories in blocks of `width` lanes: (blocks, quantities, width) doubles.

    The last block is filled up with copies of its first lane, which write where that one writes.
    """

    def __init__(self, problem: Problem, made: Kernels | CollocationKernels, width: int):
        p = self.problem = problem
        self.width = width
        self.lanes = p.batch or 1
        self.blocks = -(-self.lanes // width)
        self.threads = min(thread_count(), self.blocks) if self.blocks > 1 else 1
        self.source = np.arange(self.blocks * width)
        self.source[self.lanes :] = (self.blocks - 1) * width
        self.record = made.record
        table = np.zeros((self.lanes, self.record.size))
        table[:, self.record.state] = np.asarray(p.state).reshape(self.lanes, -1)
        for stage, guess in enumerate(p.guess):
            values = np.asarray(guess).reshape(self.lanes, -1)
            table[:, self.record.unknowns(stage, values.shape[1])] = values
        for stage, sizes in enumerate(sizes_of(p)):
            for part, numbers in zip(self.record.sizes(stage, sizes.shape[-1]), np.moveaxis(sizes, -2, 0), strict=True):
                table[:, part] = numbers
        self.records = self._blocked(table)
        leaves = made.step.parameters.flatten(p.params, p.batch if p.batch_params else None)
        self.params = self._blocked(np.broadcast_to(leaves, (self.lanes, leaves.shape[-1])))
        rows = made.step.equations[made.step.stages[0][0]].rows
        stages = len(p.equation.stages)
        front = lambda name: (stages,) if stages > 1 and p.fields[name].rule == "each" else ()
        self.shapes = {name: (*front(name), *rows[name].shape) for name in sorted(rows)}
        self.ends_before = [not p.is_node(name) for name in self.shapes]
        self.sizes = [math.prod(shape) for shape in self.shapes.values()]
        self._at = self.params.ctypes.data, self.params.strides[0]

    def alone(self, numbers: np.ndarray, made: Kernels, sizes: tuple) -> "Lanes":
        """Some of the trajectories, each in a block of its own, of these sizes."""
        p, count = self.problem, len(numbers)
        of = lambda a: np.asarray(a).reshape(self.lanes, *np.shape(a)[int(p.batch is not None) :])[numbers]
        params = jax.tree.map(of, p.params) if p.batch_params else p.params
        guess = tuple(map(of, p.guess))
        chosen = dataclasses.replace(p, state=of(p.state), guess=guess, params=params, batch=count, sizes=sizes)
        return Lanes(chosen, made, 1)

    def _blocked(self, table: np.ndarray) -> np.ndarray:
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
        lanes, counts = self.lanes, [rows - step for step in self.ends_before]
        sizes = [lanes * count * size for count, size in zip(counts, self.sizes, strict=True)]
        ends = list(itertools.accumulate(sizes, initial=0))
        if ends[-1] <= TOGETHER:
            whole = np.empty(ends[-1])
            parts, first = [whole[a:b] for a, b in itertools.pairwise(ends)], whole.ctypes.data
            begins = [first + 8 * end for end in ends[:-1]]
        else:
            parts = [np.empty(size) for size in sizes]
            begins = [part.ctypes.data for part in parts]
        made = {
            name: part.reshape(lanes, count, *shape)
            for (name, shape), part, count in zip(self.shapes.items(), parts, counts, strict=True)
        }
        if len(self.source) == 1:
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
        places = (records.ctypes.data, records.strides[0]), (params + block * stride, stride), (outs.ctypes.data, outs.strides[0])

        def part(low: int, high: int) -> None:
            kernel(*[place + low * stride for place, stride in places], high - low, *numbers)

        if threads == 1:
            part(0, len(records))
            return
        bounds = np.linspace(0, self.blocks, min(self.blocks, SHARES * threads) + 1).astype(int).tolist()
        with ThreadPoolExecutor(threads) as pool:
            for future in [pool.submit(part, a, b) for a, b in itertools.pairwise(bounds)]:
                future.result()
