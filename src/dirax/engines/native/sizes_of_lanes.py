"""The sizes of unknowns in the records of trajectories, where a run begins."""

import time

import jax
import numpy as np

from dirax.engines.contract import OK
from dirax.engines.native.kernels import Kernels
from dirax.engines.native.lanes import Lanes
from dirax.engines.native.loops.record import DOUBTFUL
from dirax.engines.native.one_lane import OneLane
from dirax.engines.sizes import sizes_of, sizes_there
from dirax.program.memo import Memo, Same

_looked: Memo[tuple] = Memo(64)
"""What a closer look at single trajectories found, for runs that begin as others did."""


def find_sizes(lanes: Lanes | OneLane, made: Kernels) -> float:
    """Write the sizes into records that have none: by NumPy, until runs have spent so much on it that a kernel is compiled.
    Returns the seconds for which that was waited for."""
    if not lanes.record.kept:  # an explicit step
        return 0.0
    entered = time.perf_counter()
    kernel, ready = made.of_sizes(lanes.width)
    waited = 0.0 if ready else time.perf_counter() - entered
    if kernel is not None:
        lanes.advance(kernel, 0, 0)
        look_closer(lanes)
    else:
        started, table = time.thread_time(), lanes.table()
        lanes.record.put_sizes(table, sizes_of(lanes.problem))
        lanes.put(np.arange(len(table)), table)
        made.sizing += time.thread_time() - started
    return waited


def look_closer(lanes: Lanes | OneLane) -> None:
    """Find the sizes that are in doubt."""
    if not lanes.doubtful:
        return
    p, record, table = lanes.problem, lanes.record, lanes.table()
    doubtful = np.flatnonzero(table[:, record.status] == DOUBTFUL)
    own = table[doubtful]
    guess = tuple(own[:, record.unknowns(i, stage.unknowns)] for i, (stage, _) in enumerate(p.equation.stages))
    look = lambda: sizes_there(p, doubtful, own[:, record.completed], own[:, record.state], guess)
    numbers = p.t0, p.h, p.first_step, own.tobytes(), *(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(p.params))
    found = look() if p.batch is not None else _looked.get((Same(p.equation), *numbers), look)
    record.put_sizes(own, found)
    own[:, record.status] = OK
    lanes.put(doubtful, own)
