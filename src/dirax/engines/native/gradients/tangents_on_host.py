"""Tangents and cotangents of a run on the host: the run again, segment by segment, and the linearized loop over each."""

import itertools
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from dirax.engines.native.gradients.recording import Recorded
from dirax.engines.native.kernels import kernels
from dirax.engines.native.lanes import Lanes, width_for
from dirax.engines.native.sizes_of_lanes import find_sizes
from dirax.engines.native.stuck_lanes import otherwise

SEGMENT_BYTES = 2**26
"""Memory for the steps that are gone over at a time."""


class Segments:
    """A recorded run whose stages are gone over in either direction, segment by segment."""

    def __init__(self, task: Recorded, inputs: tuple[np.ndarray, ...], reverse: bool):
        self.task, self.problem = task, task.problem(*inputs, every_stage=True)
        p = self.problem
        self.stages = len(p.equation.stages)
        self.made = made = kernels(p.equation, p.params, True, p.compensated)
        self.lanes = Lanes(p, made, width_for(p.batch or 1))
        self.kernel, _ = made.runs.kernel(self.lanes.width, p.steps * self.lanes.blocks)
        find_sizes(self.lanes, made)
        sizes = self.lanes.records[:, self.lanes.record.all_sizes]
        self.numbers = np.concatenate([self.lanes.params, sizes], axis=1)
        self.linearized = made.linearized(reverse, self.lanes.width)
        row_bytes = 8 * (p.batch or 1) * self.stages * (task.state_size + task.unknowns)
        self.length = max(1, SEGMENT_BYTES // row_bytes)

    def segments(self) -> list[tuple[int, int, np.ndarray]]:
        """(first step, number of steps, records there); the last segment ends with the step leaving the last row."""
        found, table = [], self.lanes.table()
        for first in range(0, self.problem.steps + 1, self.length):
            count = min(self.length, self.problem.steps + 1 - first)
            found.append((first, count, table))
            if first + count <= self.problem.steps:
                table = self._run(first, count, table).table()
        return found

    def _run(self, first: int, count: int, table: np.ndarray) -> Lanes:
        """The trajectories after a segment, as they went through it before."""
        p = self.problem.with_numbers(steps=first + count, save_every=1, first_row=first, record=(table,))
        lanes = Lanes(p, self.made, self.lanes.width)
        lanes.advance(self.kernel, first, first + count, lanes.threads)
        if lanes.stuck:
            otherwise(lanes, self.made)
        return lanes

    def rows(self, first: int, count: int, table: np.ndarray, completed: np.ndarray) -> np.ndarray:
        """State and unknowns of every stage of a segment, (blocks, rows, quantities, width); NaN for trajectories that do not get
        as far as their run, which has `completed` (B,) steps."""
        lanes = self._run(first, count, table)
        parts = (lanes.fields[name][:, :count] for name in ("state", "unknowns"))
        rows = np.concatenate([a.reshape(len(table), count * self.stages, -1) for a in parts], axis=2)
        rows[lanes.table()[:, lanes.record.completed] < np.minimum(completed, first + count)] = np.nan
        return self.blocked(rows)

    def blocked(self, rows: np.ndarray) -> np.ndarray:
        """(blocks, …, width) from (B, …)."""
        lanes = self.lanes
        shaped = rows[lanes.source].reshape(lanes.blocks, lanes.width, *rows.shape[1:])
        return np.ascontiguousarray(np.moveaxis(shaped, 1, -1))

    def unblocked(self, rows: np.ndarray) -> np.ndarray:
        """(B, …) from (blocks, …, width)."""
        lanes = self.lanes
        return np.moveaxis(rows, -1, 1).reshape(lanes.blocks * lanes.width, *rows.shape[1:-1])[: lanes.lanes]

    def call(self, carry: np.ndarray, rows: np.ndarray, flow: np.ndarray, first: int, count: int) -> None:
        """The linearized loop over a segment, blocks shared among threads."""
        p, lanes = self.problem, self.lanes

        def part(low: int, high: int) -> None:
            pointers = (a.ctypes.data + low * a.strides[0] for a in (carry, self.numbers, rows, flow))
            self.linearized(*pointers, high - low, p.t0, p.h, p.first_step, first, count)

        bounds = np.linspace(0, lanes.blocks, lanes.threads + 1).astype(int).tolist()
        if lanes.threads == 1:
            part(0, lanes.blocks)
            return
        with ThreadPoolExecutor(lanes.threads) as pool:
            for future in [pool.submit(part, a, b) for a, b in itertools.pairwise(bounds)]:
                future.result()

    def saved(self, first: int, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Which saved rows are in a segment, and at which of its rows their parts are, (rows, parts)."""
        numbers = np.minimum(np.arange(self.problem.rows) * self.problem.save_every, self.problem.steps)
        chosen = np.flatnonzero((numbers >= first) & (numbers < first + count))
        return chosen, ((numbers[chosen] - first) * self.stages)[:, None] + np.arange(self.task.parts)

    def limits(self, completed: np.ndarray, closing: np.ndarray) -> np.ndarray:
        """The step before which each trajectory ended (B, 1): with the one that leaves the last row where that matters."""
        steps = self.problem.steps
        return np.where((completed == steps) & closing, steps + 1.0, completed)[:, None]


def jvp(task: Recorded, *arrays: np.ndarray) -> list[np.ndarray]:
    """Tangents of states and unknowns from (state, guess, c, t0, h, completed, ẋ, ċ, ṫ0, ḣ)."""
    *inputs, completed, state, c, t0, h = arrays
    batch, s = state.shape
    parts = Segments(task, tuple(inputs), reverse=False)
    limits = parts.limits(completed, np.ones(batch, bool))
    carry = parts.blocked(np.concatenate([state, c, t0[:, None], h[:, None], limits], axis=1))
    states = np.zeros((batch, task.rows, task.parts, s))
    unknowns = np.zeros((batch, task.rows, task.parts, task.unknowns))
    for first, count, table in parts.segments():
        rows = parts.rows(first, count, table, completed)
        flow = np.zeros_like(rows)
        parts.call(carry, rows, flow, first, count)
        chosen, at = parts.saved(first, count)
        found = parts.unblocked(flow[:, at])
        states[:, chosen], unknowns[:, chosen] = found[..., :s], found[..., s:]
    return [a.reshape(batch, task.rows, -1) for a in (states, unknowns)]


def vjp(task: Recorded, *arrays: np.ndarray) -> list[np.ndarray]:
    """Cotangents of (state, c, t0, h) from (state, guess, c, t0, h, completed, those of the states, of the unknowns)."""
    *inputs, completed, states, unknowns = arrays
    batch, s, m = len(states), task.state_size, inputs[2].shape[1]
    parts = Segments(task, tuple(inputs), reverse=True)
    closing = np.concatenate([states[:, -1, s:], unknowns[:, -1]], axis=1)
    limits = parts.limits(completed, np.any(closing != 0, axis=1))
    carry = parts.blocked(np.concatenate([np.zeros((batch, s + m + 2)), limits], axis=1))
    given = np.concatenate([a.reshape(batch, task.rows, task.parts, -1) for a in (states, unknowns)], axis=3)
    for first, count, table in reversed(parts.segments()):
        rows = parts.rows(first, count, table, completed)
        flow = np.zeros((batch, count * parts.stages, given.shape[3]))
        chosen, at = parts.saved(first, count)
        flow[:, at] = given[:, chosen]
        parts.call(carry, rows, parts.blocked(flow), first, count)
    out = parts.unblocked(carry)
    return [out[:, :s], out[:, s : s + m], out[:, s + m], out[:, s + m + 1]]
