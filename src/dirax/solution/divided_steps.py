"""The inside of steps that walls divide: by steps of a part of the length from the last impact before."""

from functools import cached_property
from typing import Any

import numpy as np

from dirax.schemes.step import PART, STEP_DENSITY
from dirax.solution.trajectory import BESIDE_ROW

AT_ROW = 1e-12
"""Part of a step by which a time may lie off a saved row and still be at it, where steps of a part are taken."""


class DividedSteps:
    """Those of the run of a `Dense`."""

    def __init__(self, dense: Any):
        self.dense, self.sol = dense, dense.sol

    @cached_property
    def impacts(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of every impact: trajectory, number of the step, and where in it, by the time."""
        hits = self.sol.impacts
        if self.sol.has_own_times:
            return hits.lane, *self.dense.place(hits.lane, hits.t)
        at = (hits.t - float(self.sol.axis[0])) / float(self.sol.step)
        return hits.lane, np.floor(at).astype(np.int64), at - np.floor(at)

    def among(self, lanes: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        """Which of these steps have an impact in them, or end at one: the row there has the momentum after it."""
        of_lanes, of_steps, places = self.impacts
        at_row = (places < BESIDE_ROW) & (of_steps > 0)
        divided = np.concatenate([of_steps, of_steps[at_row] - 1])
        size = int(self.dense.counts[-1]) + 1
        return np.isin(lanes * size + numbers, np.append(of_lanes, of_lanes[at_row]) * size + divided)

    def inside(self, lanes: np.ndarray, numbers: np.ndarray, theta: np.ndarray, hit: np.ndarray) -> dict[str, np.ndarray]:
        """The fields inside steps, some of which walls divide: by the scheme's own step from the last impact before."""
        dense, sol = self.dense, self.sol
        found = {name: a[lanes, numbers].astype(float) for name, a in dense.saved.items() if name in dense.nodes}
        if not np.all(hit):
            for name, values in dense.inside(lanes[~hit], numbers[~hit], theta[~hit]).items():
                if name in found:
                    found[name][~hit] = values
        some = np.flatnonzero(hit)
        row, part, t = {name: a[some] for name, a in found.items()}, np.zeros(len(some)), np.zeros(len(some))
        for i, at in enumerate(some):
            last, part[i], t[i] = self._since_impact(lanes[at], numbers[at], theta[at])
            for name, values in sol.impacts.fields.items() if last is not None else ():
                if name in row:
                    row[name][i] = values[last]
        states, u = dense.again.begin(lanes[some], row, t)
        moved = part > AT_ROW
        if np.any(moved):
            h, own = part[moved] * float(sol.step), lanes[some][moved]
            after = dense.again.step(own, states[moved], u[moved], t[moved], h)
            made = dense.again.row(own, *after, t[moved] + h, h)
            for name in found:
                row[name][moved] = made[name]
        for name in found:
            found[name][some] = row[name]
        return found

    def _since_impact(self, lane: int, number: int, theta: float) -> tuple[int | None, float, float]:
        """(which it was, part, time): the last impact before a place in a step, None where there is none; which part of the step
        of the run leads there from it, or from the row; and when it was."""
        of_lanes, of_steps, places = self.impacts
        own = np.flatnonzero((of_lanes == lane) & (of_steps == number))
        count = int(np.sum(places[own] <= theta + AT_ROW + 4 * np.spacing(float(number + 1))))
        last, begins = (int(own[count - 1]), places[own[count - 1]]) if count else (None, 0.0)
        one, fields = np.array([lane]), self.sol.impacts.fields
        time = lambda place: float(self.dense.time_at(one, np.array([number]), np.array([place]))[0])
        part, t = max(float(theta - begins), 0.0), time(begins)
        if not self.sol.has_own_times or part == 0.0:
            return last, part, t
        then = own[count] if count < len(own) else None
        ends, whole = (1.0, 1.0) if then is None else (places[then], fields[PART][then])
        density = self.dense.saved[STEP_DENSITY][lane, number] if last is None else fields[STEP_DENSITY][last]
        whole -= 0.0 if last is None else fields[PART][last]
        h = float(self.sol.step)
        return last, float(step_for(part / (ends - begins), density, time(ends) - t, whole * h) / h), t


def step_for(theta: Any, density: Any, length: Any, h: Any) -> Any:
    """The step of variable steps that lasts θ of the `length` that the step of h from a place of this density lasts."""
    return theta * length * density * h / (h - theta * (h - density * length))
