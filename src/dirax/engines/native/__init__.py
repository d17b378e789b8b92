"""The native engine: a step traced to scalars, compiled by LLVM, run on vectors of trajectories and several threads.

trace.py, interpret.py and the rules   StepEquation → jaxpr → graph.py
newton_step.py                         Jacobian and elimination on the graph
step_loop.py, lower.py, emitter.py     graph → LLVM IR; the elementary functions in IR
compile.py, program.py, driver.py        IR → machine code, caches, calls
"""

from dirax.engines.native.driver import run, supported
from dirax.engines.native.gradients.differentiate import run_traced
from dirax.program.interpreter import UnsupportedPrimitive

__all__ = ["UnsupportedPrimitive", "run", "run_traced", "supported"]
