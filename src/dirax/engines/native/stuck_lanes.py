"""Trajectories for which Newton's method has not converged: with the sizes that unknowns have there, with the whole Jacobian, or
from the solution that those of short steps lead to."""

import numpy as np

from dirax.engines.contract import NOT_CONVERGED, OK, UNSOLVED
from dirax.engines.following import FOLLOWED
from dirax.engines.following import UPDATES as OF_FOLLOWING
from dirax.engines.native.kernels import Kernels, kernels
from dirax.engines.native.lanes import Lanes
from dirax.engines.native.one_lane import OneLane
from dirax.engines.sizes import grown
from dirax.engines.steps_in_numbers import StepsInNumbers
from dirax.program.graph import GraphTooLarge
from dirax.program.interpreter import UnsupportedPrimitive
from dirax.text.representation import counted

RESUMED = 16
"""How often trajectories go on with other sizes."""

BEFORE, OF_STEPS = 16, 1 / 8
"""How many steps of a trajectory are followed at most: so many, and this part of those that it has done."""


def otherwise(lanes: Lanes | OneLane, made: Kernels) -> list[str]:
    """Go on with trajectories that are stuck, in other ways. Returns what was tried."""
    with_present_sizes(lanes, made)
    tried, made = _with_weak_entries(lanes, made)
    steps = by_following(lanes, made)
    return [*tried, f"{counted(steps, 'step')} followed from shorter ones on"] if steps else tried


def with_present_sizes(lanes: Lanes | OneLane, made: Kernels) -> None:
    """Go on with trajectories whose unknowns have become larger than where they began. An attempt that does not come to another
    step leaves no trace."""
    p, record = lanes.problem, lanes.record
    if not lanes.stuck:
        return
    table = lanes.table()
    failed, tried = np.flatnonzero(table[:, record.status] == NOT_CONVERGED), 0
    while len(failed) and tried < RESUMED:
        tried, own, stages = tried + 1, table[failed], [stage.unknowns for stage, _ in p.equation.stages]
        places = [record.sizes(i, k) for i, k in enumerate(stages)]
        before = tuple(own[:, place] for place in places)
        guess = tuple(own[:, record.unknowns(i, k)] for i, k in enumerate(stages))
        sizes, more = grown(p, failed, own[:, record.completed], own[:, record.state], guess, before)
        if not np.any(more):
            return
        record.put_sizes(own, sizes)
        own[:, record.status] = OK
        chosen, status = _further(lanes, made, failed[more], own[more])
        table, failed = lanes.table(), chosen[status == NOT_CONVERGED]


def by_following(lanes: Lanes | OneLane, made: Kernels) -> int:
    """Go on with trajectories whose next step has a solution that those of shorter steps lead to, but not Newton's method: where
    friction stops what slides, say. Returns how many steps were found like that."""
    p, record, count = lanes.problem, lanes.record, 0
    stages = [stage.unknowns for stage, _ in p.equation.stages]
    if max(stages) > FOLLOWED or p.max_iterations < OF_FOLLOWING:
        return 0
    failed, tried = np.flatnonzero(np.isin(lanes.table()[:, record.status], UNSOLVED)), 0
    try:
        steps = StepsInNumbers.of(p.equation, p.params, p.batch_params) if len(failed) else None
    except (UnsupportedPrimitive, GraphTooLarge):
        return 0
    while steps is not None and len(failed):
        own = lanes.table()[failed]
        done = own[:, record.completed]
        may = tried < BEFORE + OF_STEPS * done
        failed, own, done, tried = failed[may], own[may], done[may], tried + 1
        if not len(failed):
            break
        guesses = [own[:, record.unknowns(i, k)] for i, k in enumerate(stages)]
        params = steps.parameters(p.params, p.batch if p.batch_params else None, failed)
        found = steps.step(own[:, record.state], guesses, p.t0 + (p.first_step + done) * p.h, p.h, params, alone=True)
        if not np.any(found.good):
            break
        own = own[found.good]
        for i, unknowns in enumerate(found.unknowns):
            own[:, record.unknowns(i, stages[i])] = unknowns[found.good]
        own[:, record.differences], own[:, record.status] = 0.0, OK
        chosen, status = _further(lanes, made, failed[found.good], own)
        count, failed = count + len(chosen), chosen[np.isin(status, UNSOLVED)]
    return count


def _further(lanes: Lanes | OneLane, made: Kernels, some: np.ndarray, own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Have trajectories go on from these records: which came to another step, and what became of them then; the others stay as
    they were."""
    after, record = lanes.attempt(some, made, own), lanes.record
    further = after[:, record.completed] > own[:, record.completed]
    if np.any(further):
        lanes.put(some[further], after[further])
    return some[further], after[further, record.status]


def _with_weak_entries(lanes: Lanes | OneLane, made: Kernels) -> tuple[list[str], Kernels]:
    """Go on with trajectories whose steps are so long that entries of the Jacobian which are weak in others have to be in it.
    Returns what was tried, and by what to go on."""
    p, record, table = lanes.problem, lanes.record, lanes.table()
    stuck = np.flatnonzero(table[:, record.status] == NOT_CONVERGED)
    if not len(stuck) or not any(stage.weak for stage, _ in p.equation.stages):
        return [], made
    try:
        whole = kernels(p.equation, p.params, p.batch_params, p.compensated, whole=True)
        whole.runs.kernel(1, p.steps)
    except UnsupportedPrimitive:  # too large to be written out: they end where they are
        return [], made
    own = table[stuck]
    own[:, record.status] = OK
    lanes.put(stuck, lanes.attempt(stuck, whole, own))
    with_present_sizes(lanes, whole)
    return [f"with the whole Jacobian, {counted(len(stuck), 'trajectory', 'trajectories')}"], whole
