"""Trajectories for which Newton's method has not converged, whatever the engine: they go on with the sizes that unknowns have
where they stand, or from the solution that those of easier equations lead to."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from dirax.engines.contract import NOT_CONVERGED, UNSOLVED, Problem
from dirax.engines.following import FOLLOWED
from dirax.engines.following import UPDATES as OF_FOLLOWING
from dirax.engines.sizes import Sizes, grown
from dirax.engines.steps_in_numbers import StepsInNumbers
from dirax.text.representation import counted

RESUMED = 16
"""How often trajectories go on with other sizes."""

BEFORE, OF_STEPS = 16, 1 / 8
"""How many steps of a trajectory are followed at most: so many, and this part of those that it has done."""


class Standing(NamedTuple):
    """Where some trajectories stand, entry by entry: after so many steps, at a state, with the unknowns of the step before and
    their sizes, stage by stage."""

    completed: np.ndarray
    state: np.ndarray
    unknowns: tuple[np.ndarray, ...]
    sizes: Sizes

    def __getitem__(self, some: Any) -> "Standing":
        return Standing(
            self.completed[some], self.state[some], tuple(u[some] for u in self.unknowns), tuple(a[some] for a in self.sizes)
        )


class AbstractStuck(ABC):
    """The trajectories of a run that its engine has come to the end of."""

    problem: Problem

    @abstractmethod
    def ended(self, status: Sequence[int]) -> np.ndarray:
        """The numbers of those that ended like this."""

    @abstractmethod
    def standing(self, some: np.ndarray) -> Standing:
        """Where these stand."""

    @abstractmethod
    def further(
        self, some: np.ndarray, sizes: Sizes | None = None, unknowns: Sequence[np.ndarray] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Have these go on with unknowns of other sizes, or with others, which do not change, for a guess: which of them came to
        another step, and how they ended then. The others stay as they were."""


def by_other_ways(stuck: AbstractStuck) -> tuple[bool, list[str]]:
    """Go on with trajectories that are stuck. Returns whether some did with other sizes, and what `stats` say of other ways."""
    found, steps, tried = with_present_sizes(stuck), 0, 0
    while len(stuck.ended(UNSOLVED)):
        count, tried = by_following(stuck, tried), tried + 1
        steps += count
        if not count:
            if not with_present_sizes(stuck):
                break
            found = True
    return found, [f"{counted(steps, 'step')} followed from easier ones on"] if steps else []


def with_present_sizes(stuck: AbstractStuck) -> bool:
    """Go on with trajectories whose unknowns have become larger than where they began. An attempt that does not come to another
    step leaves no trace. Returns whether there was another."""
    failed, found = stuck.ended((NOT_CONVERGED,)), False
    for _ in range(RESUMED):
        if not len(failed):
            break
        at = stuck.standing(failed)
        sizes, more = grown(stuck.problem, failed, at.completed, at.state, at.unknowns, at.sizes)
        if not np.any(more):
            break
        chosen, status = stuck.further(failed[more], sizes=tuple(a[more] for a in sizes))
        failed, found = chosen[status == NOT_CONVERGED], found or len(chosen) > 0
    return found


def by_following(stuck: AbstractStuck, tried: int) -> int:
    """Go on with trajectories whose next step has a solution that others lead to, but not Newton's method: where friction stops
    what slides, say. Returns how many; `tried`, how often that was done before."""
    p, failed = stuck.problem, stuck.ended(UNSOLVED)
    if max(stage.unknowns for stage, _ in p.equation.stages) > FOLLOWED or p.max_iterations < OF_FOLLOWING:
        return 0
    at = stuck.standing(failed)
    may = tried < BEFORE + OF_STEPS * at.completed
    failed, at = failed[may], at[may]
    if not len(failed) or (steps := StepsInNumbers.found(p.equation, p.params, p.batch_params)) is None:
        return 0
    params = steps.parameters(p.params, p.batch if p.batch_params else None, failed)
    t = p.t0 + (p.first_step + at.completed) * p.h
    found = steps.step(at.state, at.unknowns, t, p.h, params, alone=True, far=True)
    if not np.any(found.good):
        return 0
    return len(stuck.further(failed[found.good], unknowns=[u[found.good] for u in found.unknowns])[0])
