"""A walk by a kernel: its record stays where it is in memory, and the kernel writes every row where it belongs."""

import math
import time

import numpy as np

from dirax.engines.contract import NOT_CONVERGED, OK, Problem
from dirax.engines.native.kernels import kernels
from dirax.engines.native.lanes import arrays_saved
from dirax.engines.sizes import grown
from dirax.engines.walk import AbstractWalk

FEW = 8
"""How often a walk may be stuck before it is asked how large its unknowns are, for which the step is traced once more."""


class KernelWalk(AbstractWalk):
    """Raises `UnsupportedPrimitive` for a step that cannot be compiled."""

    def __init__(self, p: Problem):
        super().__init__(p)
        made = kernels(p.equation, p.params, p.batch_params, p.compensated)
        self.runs, self.record = made.runs, made.record
        self.kernel, _ = made.runs.kernel(1, p.steps)
        self._memory = np.zeros(self.record.size)
        self._params = np.array(made.step.parameters.flatten(p.params, None), float).ravel()
        self._outs = np.array([self.rows[saved.name].ctypes.data for saved in arrays_saved(p, made)], np.int64)
        self._at = tuple(array.ctypes.data for array in (self._memory, self._params, self._outs))
        count = p.equation.stages[0][0].unknowns
        self._stuck = 0
        self._unknowns, self._sizes = self.record.unknowns(0, count), self.record.sizes(0, count)

    def go(self, state: np.ndarray, unknowns: np.ndarray, first: int, stop: int, t: float, h: float) -> int:
        memory, record = self._memory, self.record
        sizes = memory[self._sizes].copy()
        memory[record.state_size :] = 0.0
        memory[record.state], memory[self._unknowns], memory[self._sizes] = state, unknowns, sizes
        self._advance(first, stop, t, h)
        while memory[record.status] == NOT_CONVERGED and self._grown(t, h):
            memory[record.status] = OK
            self._advance(first + int(memory[record.completed]), stop, t, h)
        self.state, self.unknowns = memory[record.state].copy(), memory[self._unknowns].copy()
        completed, _, iterations, residual = memory[record.completed :].tolist()
        self.iterations += int(iterations)
        self.max_residual = max(self.max_residual, residual)
        return int(completed)

    def _advance(self, first: int, stop: int, t: float, h: float) -> None:
        began = time.thread_time()
        self.kernel(*self._at, 1, t, h, 0, first, stop, 1, self.problem.max_iterations)
        self.runs.spent(1, time.thread_time() - began)
        if self.runs.quick_pays(1, 0.0):
            self.kernel, _ = self.runs.kernel(1, math.inf)

    def _grown(self, t: float, h: float) -> bool:
        """Whether the unknowns are larger than is known of them where Newton's method has not converged; their sizes are kept."""
        self._stuck += 1
        if self._stuck <= FEW:
            return False
        memory, record, one = self._memory, self.record, np.zeros(1, int)
        places = record.completed, record.state, self._unknowns, self._sizes
        completed, state, unknowns, before = (memory[place][None] for place in places)
        (sizes,), more = grown(self.problem.with_numbers(t0=t, h=h), one, completed, state, (unknowns,), (before,))
        memory[self._sizes] = sizes[0]
        return bool(more[0])
