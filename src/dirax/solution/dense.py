"""Between the rows of a run in numbers: the fields at any time, by what the scheme says of the inside of a step."""

from functools import cached_property
from typing import Any

import numpy as np

from dirax.program.memo import by_value
from dirax.schemes.step import CLOCK, STEP_DENSITY
from dirax.solution.between_rows import BetweenRows, velocity_of
from dirax.solution.divided_steps import AT_ROW, DividedSteps, step_for
from dirax.solution.steps_again import Entries, StepsAgain
from dirax.solution.trajectory import last_rows

SHORT = 1e-3
"""Part of a step from which on there is no doubt that it can be solved, and that its impulses have most of their digits."""

SLACK = 1e-9
"""Part of a step by which a time may lie outside of the run: what rounding does to t0 + k·h."""


class Dense(BetweenRows):
    """The inside of the steps of a run, many places in one call."""

    @cached_property
    def counts(self) -> np.ndarray:
        """The number of the step that leaves each row."""
        t = np.asarray(self.sol.axis, float)
        return np.rint((t - t[0]) / float(self.sol.step)).astype(np.int64)

    @cached_property
    def entries(self) -> Entries:
        """Functions of places in this run."""
        return Entries(self.sol)

    @cached_property
    def again(self) -> StepsAgain:
        """The steps of this run once more."""
        return StepsAgain(self.sol, self.counts, self.entries)

    @cached_property
    def saved(self) -> dict[str, np.ndarray]:
        """The fields with an axis of the batch."""
        one = self.sol.batch is None
        return {name: np.asarray(a)[None] if one else np.asarray(a) for name, a in self.sol.fields.items()}

    @cached_property
    def about(self) -> np.ndarray | None:
        """Near what the velocities of rows are, (B, rows, n)."""
        near = self.sol.row_fields.get("about")
        return near if near is None else np.asarray(near).reshape(*self.sol.times.shape, -1)

    @cached_property
    def ends(self) -> np.ndarray:
        """The number of the last step + 1 that each trajectory reached, (B,)."""
        return self.counts[np.maximum(last_rows([self.saved[name] for name in self.nodes]), 0)]

    def velocities(self, lanes: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """v at saved rows, (entries, n)."""
        size = self.saved["q"].shape[1]
        own, which = np.unique(lanes * size + rows, return_inverse=True)
        lanes, rows = own // size, own % size
        fields = {name: self.saved[name][lanes, rows] for name in self.nodes}
        return self.velocity(lanes, fields, np.broadcast_to(np.asarray(self.sol.t), self.saved["q"].shape[:2])[lanes, rows])[
            which
        ]

    def velocity(self, lanes: np.ndarray, fields: dict[str, np.ndarray], t: np.ndarray) -> np.ndarray:
        """The velocities that belong to q and p."""
        system = self.sol.system
        given = {name: fields[name] for name in ("q", "p")}
        if self.about is not None:
            given["about"] = self.about[lanes, self._row(self.place(lanes, t)[0])]
        function = lambda values, params: velocity_of(system, values[0], values[1], params)
        return self.entries(function, lanes, (given, t), "velocity", by_value(system))

    def place(self, lanes: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The number of the step in which each time lies, and where in it, from 0 to 1."""
        t0, h = float(self.sol.axis[0]), float(self.sol.step)
        last = np.maximum(self.ends[lanes] - 1, 0)
        if self.sol.has_own_times:
            numbers = np.zeros(len(lanes), np.int64)
            for lane in np.unique(lanes):
                own = lanes == lane
                numbers[own] = np.searchsorted(self.saved[CLOCK][lane, : self.ends[lane] + 1], times[own], side="right") - 1
            numbers = np.clip(numbers, 0, last)
            begins, ends = (self.time_at(lanes, numbers + i, 0.0) for i in (0, 1))
            return numbers, np.clip((times - begins) / (ends - begins), 0.0, 1.0)
        numbers = np.clip(np.floor((times - t0) / h).astype(np.int64), 0, last)
        return numbers, np.clip((times - (t0 + numbers * h)) / h, 0.0, 1.0)

    def inside(self, lanes: np.ndarray, numbers: np.ndarray, theta: np.ndarray) -> dict[str, np.ndarray]:
        """The fields of nodes inside steps (entries, …), and `v` where it is found on the way."""
        sol, again = self.sol, self.again
        h = np.full(len(theta), float(sol.step))
        t = self.time_at(lanes, numbers, 0.0)
        if sol.impacts is not None and np.any(hit := self.divided.among(lanes, numbers)):
            return self.divided.inside(lanes, numbers, theta, hit)
        if self.interpolate is not None:
            states, u = again.at(lanes, numbers)
            interpolate = self.interpolate
            function = lambda values, params: interpolate(*values, params)
            return self.entries(function, lanes, (theta, u, states, t, h), "interpolate", *again.key)
        if self.between is not None:
            pick = lambda at: {name: self.saved[name][lanes, at] for name in self.nodes} | {"v": self.velocities(lanes, at)}
            rows = [pick(numbers + i) | {"t": self.time_at(lanes, numbers + i, 0.0)} for i in (0, 1)]
            between = self.between
            function = lambda values, params: between(*values, params)
            return self.entries(function, lanes, (theta, *rows, h), "between", *again.key)
        return self._by_steps(lanes, numbers, theta, t, h)

    @cached_property
    def divided(self) -> DividedSteps:
        """The steps that walls divide."""
        return DividedSteps(self)

    def _by_steps(self, lanes, numbers, theta, t, h) -> dict[str, np.ndarray]:
        if lacking := [name for name in self.nodes if name not in self.again.equation.fields]:
            raise ValueError(
                f"{', '.join(lacking)} are known at the rows of this run alone, for its steps do not say them: call at() of the "
                "solution that dx.reconstruct returned, before a part of it is taken or it is saved."
            )
        row, at_row = self._saved_row(numbers, theta)
        found = {name: self.saved[name][lanes, row].astype(float) for name in self.nodes}
        near = ~at_row & (theta > AT_ROW) & (theta < SHORT)
        if np.any(near):
            for name, values in self._near_row(lanes[near], numbers[near], theta[near]).items():
                found[name][near] = values
        if np.any(off := ~at_row & ~near):
            lanes, t = lanes[off], t[off]
            part = self.step_to(lanes, numbers[off], theta[off])
            states, u = self.again.at(lanes, numbers[off])
            inside = theta[off] > AT_ROW
            if np.any(inside):
                at = lanes[inside], states[inside], u[inside], t[inside], part[inside]
                states[inside], u[inside] = self.again.step(*at)
            made = self.again.row(lanes, states, u, t + part, np.where(inside, part, h[off]))
            for name, values in found.items():
                values[off] = made[name]
        return found

    def step_to(self, lanes: np.ndarray, numbers: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """The lengths of the steps that lead from the beginnings of these steps to parts of them."""
        h = float(self.sol.step)
        part = theta * h
        if not self.sol.has_own_times:
            return part
        length = self.time_at(lanes, numbers + 1, 0.0) - self.time_at(lanes, numbers, 0.0)
        return step_for(part / h, self.saved[STEP_DENSITY][lanes, numbers], length, h)

    def _saved_row(self, numbers: np.ndarray, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The saved rows that are nearest to places in steps, and which of these are at them."""
        nearest = numbers + (theta > 0.5)
        row = np.minimum(np.searchsorted(self.counts, nearest), self.sol.rows - 1)
        return row, (np.abs(numbers + theta - nearest) <= AT_ROW) & (self.counts[row] == nearest)

    def _near_row(self, lanes: np.ndarray, numbers: np.ndarray, theta: np.ndarray) -> dict[str, np.ndarray]:
        """The same so near to a row that a step of this length is not solved in floats, or its impulses are lost in them: by the
        cubic through the row and longer steps."""
        places = np.arange(4) * 2 * SHORT
        points = [self.fields_at(lanes, numbers, np.full(len(theta), place)) for place in places]
        weights = [np.prod([(theta - b) / (a - b) for b in places if b != a], axis=0) for a in places]
        column = lambda w, a: w.reshape(-1, *(1,) * (a.ndim - 1)) * a
        whole = lambda name: np.sum([column(w, p[name]) for w, p in zip(weights, points, strict=True)], axis=0)
        return {name: whole(name) for name in self.nodes}

    def at(self, times: np.ndarray) -> dict[str, np.ndarray]:
        """The fields at times (T,) or (B, T): (B, T, …). Raises `ValueError` for times outside of the run."""
        sol = self.sol
        batch = sol.batch or 1
        times = np.broadcast_to(times, (batch, times.shape[-1]))
        self._refuse_outside(times)
        lanes, flat = np.repeat(np.arange(batch), times.shape[1]), times.ravel()
        numbers, theta = self.place(lanes, flat)
        fields = self.fields_at(lanes, numbers, theta)
        row, there = self._saved_row(numbers, theta)
        if sol.impacts is None:  # which may be at rows
            for name, values in fields.items():
                values[there] = self.saved[name][lanes[there], row[there]]
        if sol.save_every == 1:
            steps = {name: a for name, a in self.saved.items() if name not in fields}
            fields |= {name: a[lanes, np.minimum(numbers, a.shape[1] - 1)] for name, a in steps.items()}
        if sol.batch is not None:
            beyond = flat > self.time_at(lanes, self.ends[lanes], 0.0) + SLACK * float(sol.step)
            for a in fields.values():
                a[beyond] = np.nan
        return {name: a.reshape(batch, times.shape[1], *a.shape[1:]) for name, a in fields.items()}

    def fields_at(self, lanes: np.ndarray, numbers: np.ndarray, theta: np.ndarray) -> dict[str, Any]:
        """The fields of nodes inside steps; those of which the polynomial or the cubic says nothing by a part of the step, of
        which a row is made, and for rows that steps do not make, those of the row before."""
        found = self.inside(lanes, numbers, theta)
        lacking = [name for name in self.nodes if name not in found]
        if lacking and set(self.nodes) <= set(self.equation.fields):
            t, h = self.time_at(lanes, numbers, 0.0), np.full(len(theta), float(self.sol.step))
            made = self._by_steps(lanes, numbers, theta, t, h)
            found |= {name: made[name] for name in lacking}
        return {name: found[name] if name in found else self.saved[name][lanes, self._row(numbers)] for name in self.nodes}

    def _row(self, numbers: np.ndarray) -> np.ndarray:
        """The last rows that are not after the beginnings of these steps."""
        return np.searchsorted(self.counts, numbers, side="right") - 1

    def time_at(self, lanes: np.ndarray, numbers: np.ndarray, theta: Any) -> np.ndarray:
        """The times of places inside steps."""
        if not self.sol.has_own_times:
            return float(self.sol.axis[0]) + (numbers + theta) * float(self.sol.step)
        t = self.saved[CLOCK]
        begins = t[lanes, numbers]
        return begins + np.where(theta > 0.0, theta * (t[lanes, np.minimum(numbers + 1, t.shape[1] - 1)] - begins), 0.0)

    def _refuse_outside(self, times: np.ndarray) -> None:
        first, last = float(self.sol.axis[0]), float(self.sol.axis[-1])
        if self.sol.has_own_times:  # those that have failed are NaN after their end
            t, whole = self.saved[CLOCK], self.ends == np.max(self.ends)
            first, last = float(np.max(t[:, 0])), float(np.min(t[whole, np.max(self.ends)]))
        slack = SLACK * float(self.sol.step) + 4 * np.spacing(max(abs(first), abs(last)))
        outside = ~((times >= first - slack) & (times <= last + slack))
        if np.any(outside):
            raise ValueError(
                f"sol.at takes times inside the run, from {first:.6g} to {last:.6g}, but {float(times[outside][0])!r} is not "
                "among them: run more steps, or go on with sol.extend(steps)."
            )
