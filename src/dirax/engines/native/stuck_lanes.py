"""Lanes for which Newton's method has not converged, as `engines/stuck.py` goes on with them, and with the whole Jacobian."""

from collections.abc import Sequence

import numpy as np

from dirax.engines.contract import NOT_CONVERGED, OK
from dirax.engines.native.kernels import Kernels, kernels
from dirax.engines.native.lanes import Lanes
from dirax.engines.native.one_lane import OneLane
from dirax.engines.sizes import Sizes
from dirax.engines.stuck import AbstractStuck, Standing, by_other_ways, with_present_sizes
from dirax.program.interpreter import UnsupportedPrimitive
from dirax.text.representation import counted


class StuckLanes(AbstractStuck):
    """They go on by the kernel of `made`."""

    def __init__(self, lanes: Lanes | OneLane, made: Kernels):
        self.problem, self.lanes, self.made, self.record = lanes.problem, lanes, made, lanes.record
        self.stages = [stage.unknowns for stage, _ in self.problem.equation.stages]

    def ended(self, status: Sequence[int]) -> np.ndarray:
        return np.flatnonzero(np.isin(self.lanes.table()[:, self.record.status], status))

    def standing(self, some: np.ndarray) -> Standing:
        own, record, stages = self.lanes.table()[some], self.record, self.stages
        unknowns = tuple(own[:, record.unknowns(i, k)] for i, k in enumerate(stages))
        sizes = tuple(own[:, record.sizes(i, k)] for i, k in enumerate(stages))
        return Standing(own[:, record.completed], own[:, record.state], unknowns, sizes)

    def further(
        self, some: np.ndarray, sizes: Sizes | None = None, unknowns: Sequence[np.ndarray] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        own, record = self.lanes.table()[some], self.record
        own[:, record.status] = OK
        if sizes is not None:
            record.put_sizes(own, sizes)
        if unknowns is not None:
            own[:, record.differences] = 0.0
            for i, u in enumerate(unknowns):
                own[:, record.unknowns(i, self.stages[i])] = u
        after = self.lanes.attempt(some, self.made, own)
        further = after[:, record.completed] > own[:, record.completed]
        if np.any(further):
            self.lanes.put(some[further], after[further])
        return some[further], after[further, record.status]


def otherwise(lanes: Lanes | OneLane, made: Kernels) -> list[str]:
    """Go on with trajectories that are stuck, in other ways. Returns what was tried."""
    stuck = StuckLanes(lanes, made)
    if not any(stage.weak for stage, _ in stuck.problem.equation.stages):
        return by_other_ways(stuck)[1]
    with_present_sizes(stuck)
    tried, stuck = _with_weak_entries(stuck)
    return [*tried, *by_other_ways(stuck)[1]]


def _with_weak_entries(stuck: StuckLanes) -> tuple[list[str], StuckLanes]:
    """Go on with trajectories whose steps are so long that entries of the Jacobian which are weak in others have to be in it.
    Returns what was tried, and by what to go on."""
    p, lanes, some = stuck.problem, stuck.lanes, stuck.ended((NOT_CONVERGED,))
    if not len(some):
        return [], stuck
    try:
        whole = kernels(p.equation, p.params, p.batch_params, p.compensated, whole=True)
        whole.runs.kernel(1, p.steps)
    except UnsupportedPrimitive:  # too large to be written out: they end where they are
        return [], stuck
    own = lanes.table()[some]
    own[:, stuck.record.status] = OK
    lanes.put(some, lanes.attempt(some, whole, own))
    return [f"with the whole Jacobian, {counted(len(some), 'trajectory', 'trajectories')}"], StuckLanes(lanes, whole)
