"""A short run in one call of machine code: the sizes of its unknowns, its steps, and the row of its last state."""

import ctypes
import functools
import struct
from typing import Any

import numpy as np

from dirax.engines.contract import Problem
from dirax.program import machine_code as llvm

TEXT = """
declare void @llvm.memcpy.p0.p0.i64(ptr, ptr, i64, i1)

define void @at_once(ptr %orders) {{
entry:
{loads}
  %none = icmp eq ptr %sizes, null
  br i1 %none, label %steps_from_there, label %find_sizes
find_sizes:
  call void %sizes(ptr %record, ptr %params, ptr %outs, {numbers}, i64 0, i64 0, i64 %every, i64 %limit)
  %outcome = load double, ptr %status
  %doubtful = fcmp une double %outcome, 0.0
  br i1 %doubtful, label %end, label %steps_from_there
steps_from_there:
  call void %run(ptr %record, ptr %params, ptr %outs, {numbers}, i64 0, i64 %steps, i64 %every, i64 %limit)
  call void @llvm.memcpy.p0.p0.i64(ptr %copy, ptr %record, i64 %bytes, i1 false)
  %done = load double, ptr %completed
  %wanted = sitofp i64 %steps to double
  %whole = fcmp oeq double %done, %wanted
  %closing = select i1 %whole, ptr %last, ptr %early
  call void %run(ptr %copy, ptr %params, ptr %closing, {numbers}, i64 0, i64 1, i64 1, i64 %limit)
  br label %end
end:
  ret void
}}
"""

ORDERS = (
    *[(name, "ptr") for name in ("sizes", "run", "record", "params", "outs", "early", "last", "copy", "status", "completed")],
    *[("bytes", "i64"), ("t0", "double"), ("h", "double")],
    *[(name, "i64") for name in ("first_step", "steps", "every", "limit")],
)
"""What a call is told, in words of eight bytes."""

PLACES = {name: i for i, (name, _) in enumerate(ORDERS)}

NUMBERS = struct.Struct("=ddqqqq")
"""The last of them, which a run brings."""


def _text() -> str:
    loads = "\n".join(
        f"  %at.{name} = getelementptr i64, ptr %orders, i64 {i}\n  %{name} = load {kind}, ptr %at.{name}"
        for i, (name, kind) in enumerate(ORDERS)
    )
    return TEXT.format(loads=loads, numbers="i64 1, double %t0, double %h, i64 %first_step")


@functools.cache
def _machine_code() -> Any:
    library = llvm.load(llvm.object_code(_text(), level=0), ("at_once",))
    return llvm.function(library, "at_once", ctypes.CFUNCTYPE(None, ctypes.c_void_p))


class Orders:
    """What one call is told of the memory of a run; `record` … `completed` are addresses there, `bytes` those of a record."""

    def __init__(self, **of_memory: int):
        self._words = np.zeros(len(ORDERS), np.int64)
        for name, value in of_memory.items():
            self._words[PLACES[name]] = value
        words: Any = self._words
        self._view = memoryview(words).cast("B")
        self._at, self._kernels = self._words.ctypes.data, (None, None)
        self._call = _machine_code()

    def carry_out(self, sizes: Any, run: Any, p: Problem) -> None:
        """Have the run of the problem taken, from its first step, by compiled functions of one lane. Where sizes are in doubt it
        is not begun."""
        if self._kernels[0] is not sizes or self._kernels[1] is not run:
            self._words[:2] = 0 if sizes is None else sizes.address, run.address
            self._kernels = sizes, run
        NUMBERS.pack_into(self._view, 8 * PLACES["t0"], p.t0, p.h, p.first_step, p.steps, p.save_every, p.max_iterations)
        self._call(self._at)
