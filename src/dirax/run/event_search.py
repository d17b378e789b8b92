"""Where the functions of events change their sign along a run, inside the steps."""

from typing import Any, NamedTuple

import numpy as np

from dirax.numerics.brackets import bracketed_roots
from dirax.run.dips import changes, changes_beside_dips, dips
from dirax.run.event import Event, evaluated, refuse_unknown
from dirax.run.event_scan import FEWEST, EventScan
from dirax.solution.dense import Dense
from dirax.solution.events import Events

FEWEST_POINTS = 4
"""Points of a step at which a function is looked at, its beginning among them."""

TOGETHER = 1024
"""Steps that are looked into together: fewer than `StepsAgain` takes machine code for, which has other last digits."""


def places_for(equation: Any) -> int:
    """Points of a step at which functions are looked at, more of them for a polynomial of high degree."""
    tableau = getattr(getattr(equation.stages[0][0], "collocation", None), "tableau", None)
    return max(FEWEST_POINTS, 0 if tableau is None else tableau.stages + 1)


class Brackets(NamedTuple):
    """Places between which a function changes its sign: base + a and base + b, in steps, and its values there."""

    lanes: np.ndarray
    base: np.ndarray
    a: np.ndarray
    b: np.ndarray
    fa: np.ndarray
    fb: np.ndarray


class Places(NamedTuple):
    """Where the function of an event is zero: trajectories, numbers of steps, parts of these, and +1 or −1 for where it leads."""

    lanes: np.ndarray
    numbers: np.ndarray
    theta: np.ndarray
    direction: np.ndarray


class EventSearch:
    """Looks for one event in the steps of a run, of which every row was saved."""

    def __init__(self, dense: Dense, event: Event, number: int):
        self.dense, self.event, self.number = dense, event, number
        refuse_unknown(event, number, dense.nodes)
        self.points = places_for(dense.equation)
        self.undefined = np.full(len(dense.ends), np.inf)
        """When the function is no number first, of what was seen of each trajectory."""

    @property
    def last_known(self) -> np.ndarray:
        """The last time at which it may be one; ∞ where it always is."""
        return np.where(np.isfinite(self.undefined), np.nextafter(self.undefined, -np.inf), np.inf)

    def value(self, lanes: np.ndarray, base: np.ndarray, x: np.ndarray) -> np.ndarray:
        """The function at base + x, in steps; NaN where it is no number."""
        numbers, theta = self._place(lanes, base, x)
        return self._of(lanes, self.dense.inside(lanes, numbers, theta), self.dense.time_at(lanes, numbers, theta))

    def _place(self, lanes: np.ndarray, base: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The number of the step in which base + x lies, and where in it; the end of the last step belongs to that step."""
        whole, last = np.floor(x), self.dense.ends[lanes] - 1
        numbers = base + whole.astype(np.int64)
        return np.minimum(numbers, last), np.where(numbers > last, 1.0, x - whole)

    def at_rows(self, lanes: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        """The function at saved rows."""
        fields = {name: self.dense.saved[name][lanes, numbers] for name in self.dense.nodes}
        if "v" in self.event.arguments:
            fields["v"] = self.dense.velocities(lanes, numbers)
        return self._of(lanes, fields, self.dense.time_at(lanes, numbers, np.zeros(len(numbers))))

    def _of(self, lanes: np.ndarray, fields: dict[str, np.ndarray], t: np.ndarray) -> np.ndarray:
        event, dense, number = self.event, self.dense, self.number
        if "v" in event.arguments and "v" not in fields:
            fields = fields | {"v": dense.velocity(lanes, fields, t)}
        known = {name: fields[name] for name in event.arguments if name in fields} | {"t": t}
        one = lambda known, params: evaluated(event, number, known, params)
        values = dense.entries(one, lanes, known, "event", event)
        if np.any(bad := ~np.isfinite(values)):
            values = np.where(bad, np.nan, values)
            np.minimum.at(self.undefined, lanes[bad], t[bad])
        return values

    def found(self, first: int, last: int) -> Events:
        """The events in the steps from number `first` to before `last`."""
        return self.events(self.places(first, last))

    def places(self, first: int, last: int) -> Places:
        """Where they are."""
        lanes, numbers = self._steps(first, last)
        blocks = [slice(i, i + TOGETHER) for i in range(0, len(lanes), TOGETHER)]
        parts = [self._brackets(lanes[block], numbers[block]) for block in blocks]
        return self._located(Brackets(*map(np.concatenate, zip(*parts, strict=True))) if parts else _none())

    def _steps(self, first: int, last: int) -> tuple[np.ndarray, np.ndarray]:
        """(trajectories, numbers) of the steps to be looked into: of many, those in which the scan sees something."""
        if (last - first) * len(self.dense.ends) >= FEWEST:
            scan = EventScan(self.dense, self.event, self.number, self.points)
            if (run := scan.run()) is not None and (found := scan.steps(run, first, last)) is not None:
                return found
        lanes, numbers = np.nonzero(np.arange(first, last)[None] < self.dense.ends[:, None])
        return lanes, numbers + first

    def _brackets(self, lanes: np.ndarray, numbers: np.ndarray) -> Brackets:
        """The changes of sign in these steps, and their surroundings where the function comes near to zero."""
        values, x = self._at_points(lanes, numbers), np.arange(self.points + 1) / self.points
        some, at = np.nonzero(changes(values[:, :-1], values[:, 1:]))
        found = [Brackets(lanes[some], numbers[some], x[at], x[at + 1], values[some, at], values[some, at + 1])]
        # dips between points: inside the step, and around its beginning with the last point of the step before
        some, at = np.nonzero(dips(values[:, :-2], values[:, 1:-1], values[:, 2:]))
        found.append(self._beside(lanes[some], numbers[some], x[at], x[at + 2]))
        near = np.flatnonzero((numbers > 0) & dips(self._before(lanes, numbers, values), values[:, 0], values[:, 1]))
        step = np.full(len(near), 1 / self.points)
        found.append(self._beside(lanes[near], numbers[near], -step, step))
        return Brackets(*map(np.concatenate, zip(*found, strict=True)))

    def _at_points(self, lanes: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        """The function at the points of these steps, both ends among them, (entries, points + 1)."""
        values, inner = np.empty((len(lanes), self.points + 1)), np.arange(1, self.points) / self.points
        repeated = lambda a: np.repeat(a, len(inner))
        values[:, 0] = self.at_rows(lanes, numbers)
        values[:, 1:-1] = self.value(repeated(lanes), repeated(numbers), np.tile(inner, len(lanes))).reshape(len(lanes), -1)
        values[:, -1] = self.at_rows(lanes, numbers + 1)
        return values

    def _before(self, lanes: np.ndarray, numbers: np.ndarray, values: np.ndarray) -> np.ndarray:
        """The function at the last point of the step before each of these, NaN where there is none."""
        before = np.full(len(lanes), np.nan)
        follows = np.flatnonzero((numbers[1:] == numbers[:-1] + 1) & (lanes[1:] == lanes[:-1])) + 1
        before[follows] = values[follows - 1, -2]
        others = np.flatnonzero(np.isnan(before) & (numbers > 0))
        before[others] = self.value(lanes[others], numbers[others] - 1, np.full(len(others), 1.0 - 1 / self.points))
        return before

    def _beside(self, lanes: np.ndarray, base: np.ndarray, low: np.ndarray, high: np.ndarray) -> Brackets:
        """The changes of sign between two places around the one where the function is nearest to zero."""
        which, *found = changes_beside_dips(lambda x, which: self.value(lanes[which], base[which], x), low, high)
        return Brackets(lanes[which], base[which], *found)

    def _located(self, brackets: Brackets) -> Places:
        """The places in brackets, of the direction that is asked for."""
        rises = np.where(brackets.fa != 0.0, brackets.fa < 0.0, brackets.fb > 0.0)
        direction = np.where(rises, 1, -1)
        asked = direction == self.event.direction if self.event.direction else np.ones(len(direction), bool)
        lanes, base, a, b, fa, fb = (array[asked] for array in brackets)
        x = bracketed_roots(lambda x, which: self.value(lanes[which], base[which], x), a, b, fa, fb)
        numbers, theta = self._place(lanes, base, x)
        order = np.lexsort((theta, numbers, lanes))
        order = order[self.dense.time_at(lanes, numbers, theta)[order] < self.undefined[lanes[order]]]
        return Places(*(a[order] for a in (lanes, numbers, theta, direction[asked])))

    def events(self, places: Places) -> Events:
        """What the run is like there."""
        dense, (lanes, numbers, theta, direction) = self.dense, places
        fields = dense.fields_at(lanes, numbers, theta)
        return Events(dense.time_at(lanes, numbers, theta), np.full(len(lanes), self.number), direction, lanes, fields)


def _none() -> Brackets:
    whole, real = np.zeros(0, np.int64), np.zeros(0)
    return Brackets(whole, whole, real, real, real, real)
