"""A walk by a kernel: its record stays where it is in memory, and the kernel writes every row where it belongs."""

import math
import time

import numpy as np

from dirax.engines.contract import Problem
from dirax.engines.native.kernels import kernels
from dirax.engines.native.lanes import arrays_saved
from dirax.engines.walk import AbstractWalk


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
        self._unknowns = self.record.unknowns(0, p.equation.stages[0][0].unknowns)

    def go(self, state: np.ndarray, unknowns: np.ndarray, first: int, stop: int, t: float, h: float) -> int:
        memory, record = self._memory, self.record
        memory[record.state_size :] = 0.0
        memory[record.state] = state
        memory[self._unknowns] = unknowns
        began = time.thread_time()
        self.kernel(*self._at, 1, t, h, 0, first, stop, 1, self.problem.max_iterations)
        self.runs.spent(1, time.thread_time() - began)
        if self.runs.quick_pays(1, 0.0):
            self.kernel, _ = self.runs.kernel(1, math.inf)
        self.state, self.unknowns = memory[record.state].copy(), memory[self._unknowns].copy()
        completed, _, iterations, residual = memory[record.completed :].tolist()
        self.iterations += int(iterations)
        self.max_residual = max(self.max_residual, residual)
        return int(completed)
