"""The sizes of unknowns in the records of trajectories, where a run begins."""

import time
from collections.abc import Callable

import jax
import numpy as np

from dirax.engines.contract import OK, Problem
from dirax.engines.native.kernels import Kernels
from dirax.engines.native.lanes import Lanes
from dirax.engines.native.loops.record import DOUBTFUL
from dirax.engines.native.one_lane import OneLane
from dirax.engines.sizes import Sizes, sizes_of, sizes_there
from dirax.program.memo import Memo, Same

_looked: Memo[Sizes] = Memo(64)
"""What was found for single trajectories, for runs that begin as others did."""


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
        lanes.record.put_sizes(table, _known(lanes.problem, table, lambda: sizes_of(lanes.problem)))
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
    record.put_sizes(own, _known(p, own, look))
    own[:, record.status] = OK
    lanes.put(doubtful, own)


def _known(p: Problem, table: np.ndarray, look: Callable[[], Sizes]) -> Sizes:
    """What `look` finds for these records. Of a single trajectory it is kept: to go backward, its run is gone through again."""
    if (p.batch or 1) > 1:
        return look()
    numbers = p.t0, p.h, p.first_step, table.tobytes(), *(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(p.params))
    return _looked.get((Same(p.equation), *numbers), look)
