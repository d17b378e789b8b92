"""What kernels call seldom: compiled once in a process for all of them, which takes a third of the time of a small kernel."""

import functools
from typing import Any

from dirax.engines.native.functions.far_reduction import FAR_NAME, add_far_reduction
from dirax.engines.native.ir.emitter import Module
from dirax.engines.native.loops.dense import DENSE_NAME, add_dense_solve
from dirax.program import machine_code as llvm

DECLARED = {FAR_NAME: "ptr, ptr, ptr, ptr, i64", DENSE_NAME: "ptr, ptr, ptr, ptr, i64, i64"}
"""The functions by name, with their arguments."""


def declare_shared(module: Module) -> None:
    """Declare them in a module, which is linked with their `addresses`."""
    module.globals.extend(f"declare void @{name}({arguments}) cold" for name, arguments in DECLARED.items())


def addresses() -> dict[str, int]:
    """Where they are in this process."""
    library = _library()
    return {name: library[name] for name in DECLARED}


def shared_module(fma: bool) -> str:
    """IR of them."""
    module = Module(fma)
    add_far_reduction(module, "")
    add_dense_solve(module)
    return module.text()


@functools.cache
def _library() -> Any:
    return llvm.load(llvm.object_code(shared_module(llvm.has_fma()), level=0), tuple(DECLARED))
