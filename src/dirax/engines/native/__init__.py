"""The native engine: a step traced to scalars, compiled by LLVM, run on vectors of trajectories and several threads.

kernels.py            a step's scalar program (engines/step_program.py) → the kernels compiled from it, by width
loops/                scalar program → the loop over rows, steps, stages and Newton's iterations as LLVM IR
ir/                   the writer of LLVM IR, and nodes written with it
functions/            the elementary functions in LLVM IR
compile.py            IR → machine code, and its cache
engine.py             what the engine supports; run.py its chunks and threads, lanes.py its memory
gradients/            derivatives of a run: the loops of tangents and cotangents, and the run as JAX's primitives
"""

from dirax.engines.native.engine import Native

__all__ = ["Native"]
