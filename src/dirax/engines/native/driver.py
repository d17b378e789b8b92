"""The native engine's `run`: the same Problem and Outcome as the xla engine's."""

import itertools
import os
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from dirax.engines.native import compile as llvm
from dirax.engines.native.interpret import UnsupportedPrimitive
from dirax.engines.native.program import Program, program
from dirax.engines.result import OK, Outcome, Problem, Progress

CHUNK_SECONDS = 0.1
WORTH_THREADS = 2e-3
"""Seconds of work from which on it is shared among threads."""

SHARES = 4
"""Parts of a batch per thread, so that a thread that is held up holds up little."""

FIRST_CHUNK = 20_000
"""Lane-steps of the first call, from which the speed is estimated."""


def supported(problem: Problem) -> str | None:
    """None if the native engine takes the problem; else why not, naming the primitive and the user's source line."""
    try:
        program(problem.equation, problem.params, problem.batch_params, problem.compensated)
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

    fields = lanes.arrays(p.rows)
    outs = lanes.addresses(fields)
    done, interrupted, threads = 0, False, 1
    count = max(1, FIRST_CHUNK // max(1, p.batch or 1))
    try:
        while done < p.steps and np.any(lanes.status == OK):
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
    closing_arrays = lanes.arrays(2)
    lanes.call(kernel, lanes.records.copy(), lanes.addresses(closing_arrays), 0, 1, 1, threads)
    closing = {name: a[:, 0] for name, a in closing_arrays.items()}
    completed = lanes.completed
    for name, values in fields.items():
        for lane in np.nonzero(completed < p.steps)[0]:
            values[lane, completed[lane] // p.save_every + 1 :] = np.nan
        if done == p.steps and lanes.place[name] == "node":
            values[:, -1] = closing[name]
    return Outcome(
        fields=fields,
        closing=closing,
        completed=completed,
        status=lanes.status.astype(np.int64),
        iterations=lanes.column(-2).astype(np.int64),
        max_residual=lanes.column(-1),
        last_state=lanes.state,
        last_unknowns=lanes.unknowns,
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
        self.place = {name: first.fields[name].place for name, _ in self.plan.fields}
        self._first_unknowns = first.unknowns

    def _blocked(self, table: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(table[self.source].reshape(self.blocks, self.width, -1).swapaxes(1, 2))

    def columns(self, first: int, count: int) -> np.ndarray:
        """Consecutive quantities of every trajectory, (B, count)."""
        chosen = self.records[:, first : first + count].swapaxes(1, 2)
        return chosen.reshape(self.blocks * self.width, count)[: self.lanes].copy()

    def column(self, index: int) -> np.ndarray:
        """One quantity of every trajectory."""
        return self.columns(index % self.plan.record, 1)[:, 0]

    @property
    def completed(self) -> np.ndarray:
        return self.column(-4).astype(np.int64)

    @property
    def status(self) -> np.ndarray:
        return self.column(-3)

    @property
    def state(self) -> np.ndarray:
        return self.columns(0, self.plan.state_size)

    @property
    def unknowns(self) -> np.ndarray:
        return self.columns(self.plan.state_size, self._first_unknowns)

    def arrays(self, rows: int) -> dict[str, np.ndarray]:
        """Room for the saved arrays of so many rows."""
        rows_of = lambda name: rows - (self.place[name] == "step")
        shapes = {name: self.plan.equations[self.plan.stages[0][0]].rows[name].shape for name in self.place}
        return {name: np.empty((self.lanes, rows_of(name), *shape)) for name, shape in shapes.items()}

    def addresses(self, arrays: dict[str, np.ndarray]) -> np.ndarray:
        """(blocks, fields, width) addresses of row 0."""
        columns = [arrays[name].ctypes.data + arrays[name].strides[0] * self.source for name, _ in self.plan.fields]
        table = np.array(columns, dtype=np.int64).reshape(len(columns), self.blocks, self.width)
        return np.ascontiguousarray(table.swapaxes(0, 1))

    def call(self, kernel, records: np.ndarray, outs: np.ndarray, first: int, stop: int, every: int, threads: int) -> None:
        """Steps `first` to `stop` − 1 of every trajectory, blocks shared among threads; Ctrl-C waits for their end."""
        p = self.problem
        numbers = (p.t0, p.h, p.first_step, first, stop, every, p.max_iterations)

        def part(low: int, high: int) -> None:
            pointers = (a.ctypes.data + low * a.strides[0] for a in (records, self.params, outs))
            kernel(*pointers, high - low, *numbers)

        if threads == 1:
            part(0, self.blocks)
            return
        bounds = np.linspace(0, self.blocks, min(self.blocks, SHARES * threads) + 1).astype(int).tolist()
        with ThreadPoolExecutor(threads) as pool:
            for future in [pool.submit(part, a, b) for a, b in itertools.pairwise(bounds)]:
                future.result()
