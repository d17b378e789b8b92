"""The native engine's `run`: the same Problem and Outcome as the xla engine's."""

import itertools
import math
import os
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from dirax.engines.native import compile as llvm
from dirax.engines.native.program import Program, program
from dirax.engines.result import OK, Outcome, Problem, Progress
from dirax.program.interpreter import UnsupportedPrimitive

CHUNK_SECONDS = 0.1
WORTH_THREADS = 2e-3
"""Seconds of work from which on it is shared among threads."""

SHARES = 4
"""Parts of a batch per thread, so that a thread that is held up holds up little."""

FIRST_CHUNK = 20_000
"""Lane-steps of the first call, from which the speed is estimated."""

TOGETHER = 2**17
"""Numbers to save up to which all arrays are parts of one, since it takes a microsecond to find where an array begins."""


def supported(problem: Problem, most_operations: int | None = None) -> str | None:
    """None if the native engine takes the problem; else why not, naming the primitive and the user's source line, or how many
    operations a step has more than `most_operations`, which do not matter for one that is nested."""
    try:
        made, _ = program(problem.equation, problem.params, problem.batch_params, problem.compensated)
        if most_operations is not None and not made.nested:
            made.check()
            if made.operations > most_operations:
                return f"{made.operations} scalar operations a step, more than {most_operations}"
    except UnsupportedPrimitive as error:
        return str(error)
    return None


def run(problem: Problem, progress: Progress | None = None) -> Outcome:
    """Run `problem`, saving into NumPy arrays; Ctrl-C and failing steps keep what was computed.

    Raises `UnsupportedPrimitive` for a step that cannot be compiled.
    """
    p, started = problem, time.perf_counter()
    made, _ = program(p.equation, p.params, p.batch_params, p.compensated)
    lanes = Lanes(p, made, width_for(p.batch or 1))
    kernel, cached = made.kernel(lanes.width)
    compile_seconds, started = time.perf_counter() - started, time.perf_counter()

    fields, outs = lanes.arrays(p.rows)
    done, interrupted, threads = 0, False, 1
    count = max(1, FIRST_CHUNK // max(1, p.batch or 1))
    try:
        while done < p.steps and (done == 0 or lanes.going):
            count = min(count, p.steps - done)
            tick = time.perf_counter()
            lanes.call(kernel, lanes.records, outs, done, done + count, p.save_every, threads)
            done += count
            rate = count / max(time.perf_counter() - tick, 1e-9)
            count = max(1, int(rate * CHUNK_SECONDS))
            threads = lanes.threads if threads > 1 or p.steps - done > rate * WORTH_THREADS else 1
            if progress:
                progress(done, p.steps)
    except KeyboardInterrupt:
        interrupted = True
    closing_arrays, closing_outs = lanes.arrays(2)
    lanes.call(kernel, lanes.records.copy(), closing_outs, 0, 1, 1, threads)
    closing = {name: a[:, 0] for name, a in closing_arrays.items()}
    table = lanes.table()
    completed, status, iterations = (table[:, k].astype(np.int64) for k in (-4, -3, -2))
    ended = np.nonzero(completed < p.steps)[0].tolist()
    for name, values in fields.items():
        for lane in ended:
            values[lane, completed[lane] // p.save_every + 1 :] = np.nan
        if done == p.steps and lanes.place[name] == "node":
            values[:, -1] = closing[name]
    return Outcome(
        fields=fields,
        closing=closing,
        completed=completed,
        status=status,
        iterations=iterations,
        max_residual=table[:, -1].copy(),
        last_state=table[:, : lanes.states].copy(),
        last_unknowns=table[:, lanes.states : lanes.states + lanes.first_unknowns].copy(),
        interrupted=interrupted,
        compile_seconds=compile_seconds,
        run_seconds=time.perf_counter() - started,
        engine="native",
        notes={
            "unknowns": sum(len(made.equations[i].unknowns) for i, _ in made.stages),
            "operations": made.operations,
            "lanes": lanes.width,
            "threads": lanes.threads,
            "kernel_cached": cached,
        },
    )


def width_for(batch: int) -> int:
    """Lanes side by side for a batch."""
    widest = llvm.vector_width()
    return 1 if batch == 1 else next((w for w in (2, 4) if batch <= w <= widest), widest)


def thread_count() -> int:
    """Threads for batches: DIRAX_THREADS, else the processors this process may use."""
    chosen = os.environ.get("DIRAX_THREADS", "")
    if chosen.isdigit() and int(chosen) > 0:
        return int(chosen)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Lanes:
    """The records of all trajectories in blocks of `width` lanes: (blocks, quantities, width) doubles.

    The last block is filled up with copies of its first lane, which write where that one writes.
    """

    def __init__(self, problem: Problem, made: Program, width: int):
        p, self.plan, self.width = problem, made.bare, width
        self.problem = p
        self.lanes = p.batch or 1
        self.blocks = -(-self.lanes // width)
        self.threads = min(thread_count(), self.blocks) if self.blocks > 1 else 1
        self.source = np.arange(self.blocks * width)
        self.source[self.lanes :] = (self.blocks - 1) * width
        table = np.zeros((self.lanes, self.plan.record))
        s, k = self.plan.state_size, self.plan.history
        table[:, :s] = np.asarray(p.state).reshape(self.lanes, s)
        for stage, guess in enumerate(p.guess):
            values = np.asarray(guess).reshape(self.lanes, -1)
            table[:, s + stage * k : s + stage * k + values.shape[1]] = values
        self.records = self._blocked(table)
        leaves = made.parameters.flatten(p.params, p.batch if p.batch_params else None)
        self.params = self._blocked(np.broadcast_to(leaves, (self.lanes, leaves.shape[-1])))
        first = p.equation.stages[0][0]
        rows = self.plan.equations[self.plan.stages[0][0]].rows
        self.shapes = {name: rows[name].shape for name in sorted(rows)}
        self.place = {name: first.fields[name].place for name in self.shapes}
        self.ends_before = [place == "step" for place in self.place.values()]
        self.sizes = [math.prod(shape) for shape in self.shapes.values()]
        self._at = self.params.ctypes.data, self.params.strides[0]
        self.states, self.first_unknowns = s, first.unknowns

    def _blocked(self, table: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(table[self.source].reshape(self.blocks, self.width, -1).swapaxes(1, 2))

    def table(self) -> np.ndarray:
        """The records of all trajectories, (B, quantities)."""
        return self.records.swapaxes(1, 2).reshape(self.blocks * self.width, -1)[: self.lanes]

    @property
    def going(self) -> bool:
        """Whether a trajectory has neither failed nor ended before its time."""
        return bool((self.records[:, -3] == OK).any())

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

    def call(self, kernel, records: np.ndarray, outs: np.ndarray, first: int, stop: int, every: int, threads: int) -> None:
        """Steps `first` to `stop` − 1 of every trajectory, blocks shared among threads; Ctrl-C waits for their end."""
        p = self.problem
        numbers = (p.t0, p.h, p.first_step, first, stop, every, p.max_iterations)
        places = (records.ctypes.data, records.strides[0]), self._at, (outs.ctypes.data, outs.strides[0])

        def part(low: int, high: int) -> None:
            kernel(*[place + low * stride for place, stride in places], high - low, *numbers)

        if threads == 1:
            part(0, self.blocks)
            return
        bounds = np.linspace(0, self.blocks, min(self.blocks, SHARES * threads) + 1).astype(int).tolist()
        with ThreadPoolExecutor(threads) as pool:
            for future in [pool.submit(part, a, b) for a, b in itertools.pairwise(bounds)]:
                future.result()
