"""The next impact in a rest of a step, found by steps of parts of it: where it is doubtful whether there is one, and which."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from dirax.engines.contract import Outcome, Problem
from dirax.numerics.brackets import bracketed_roots
from dirax.run.dips import changes_beside_dips, dips
from dirax.run.impact import Numbers
from dirax.schemes.step import CLOCK
from dirax.schemes.watched_step import EARLY, ON_WALL, PARTS

SHORTEST = 1e-12
"""The shortest flight, in steps."""

SHORT, BEYOND = 0.25, 0.5
"""Parts of a step below the first may be too short to be solved; then a step is taken that is longer by the second."""


class NoNumber(ValueError):
    """A gap is no number."""


@dataclass
class ImpactSearch:
    """The steps of one trajectory, of any part of the length, and the gaps after them."""

    problem: Problem
    numbers: tuple[int, ...]
    """The places of the walls in `events=`."""
    run: Any
    gaps: Numbers
    terms: Numbers
    """Of (t, q, q elsewhere in the step), as of `gap_terms`."""

    def __post_init__(self):
        self.layout = self.problem.equation.stages[0][0].state_layout

    def time(self, state: np.ndarray, at: float) -> float:
        """The time at a state, so many steps after the start."""
        p = self.problem
        return float(state[self.layout.place(CLOCK)][0]) if CLOCK in self.layout else p.t0 + at * p.h

    def steps(self, state: np.ndarray, u: np.ndarray, at: float, part: float) -> Outcome:
        """A step of a part of the length."""
        p = self.problem
        h, t = part * p.h, p.t0 + at * p.h
        return self.run(p.with_numbers(state=state, guess=(u,), t0=t, h=h, steps=1, save_every=1), None)

    def part(self, state: np.ndarray, u: np.ndarray, at: float, part: float) -> tuple[Outcome, tuple | None]:
        """A step of a part of the length; state and unknowns after it, None where it has no solution.

        The forces of constraints are lost in rounding in a very short step: one that is longer is solved then, and one back.
        """
        out = self.steps(state, u, at, part or 1.0)
        if part == 0.0:
            return out, (state, u)
        if int(out.completed[0]):
            return out, (out.last_state[0], out.last_unknowns[0])
        if part < SHORT:
            there = self.steps(state, u, at, part + BEYOND)
            if int(there.completed[0]):
                back = self.steps(there.last_state[0], there.last_unknowns[0], at + part + BEYOND, -BEYOND)
                if int(back.completed[0]):
                    return there, (back.last_state[0], back.last_unknowns[0])
        return out, None

    def next(self, state: np.ndarray, u: np.ndarray, at: float, rest: float) -> tuple[float, int] | None:
        """How long it is to the next impact within a rest of a step, and which wall is hit; None where none is. Raises
        `NoNumber` for a gap that is none."""
        whole = self.part(state, u, at, 1.0)[1]  # in a short rest a coordinate that is zero may be so all along
        end = whole if rest == 1.0 else self.part(state, u, at, rest)[1]
        small = ON_WALL * self.terms_at(state, whole, at)
        here = self.gaps_at(state, at)
        values: dict[float, np.ndarray] = {0.0: np.where(here < small, 0.0, here)}

        def gap(part: float) -> np.ndarray:
            if part not in values:
                moved = end if part == rest else self.part(state, u, at, part)[1]
                values[part] = np.full(len(self.numbers), np.nan) if moved is None else self.gaps_at(moved[0], at + part)
            return values[part]

        def beyond(part: float) -> np.ndarray:
            """The same outside of the rest, where it need not be a number."""
            try:
                return gap(part)
            except NoNumber:
                return np.full(len(self.numbers), np.nan)

        places = rest * np.arange(-1, PARTS + 2) / PARTS  # one before and one after it, for dips at its ends
        g = np.array([beyond(places[0]), *(gap(float(x)) for x in places[1:-1]), beyond(places[-1])])
        walls = range(len(self.numbers))
        hits = [found for wall in walls if (found := self._hit(wall, gap, places, g[:, wall], -small[wall])) is not None]
        return min(hits) if hits else None

    def terms_at(self, state: np.ndarray, end: tuple | None, at: float) -> np.ndarray:
        """The sizes of the terms of every gap at the first state of a step with this end, as `part` gives it."""
        q, last = self.layout.place("q"), state if end is None else end[0]
        return self.terms.one(self.time(state, at), state[q], last[q])

    def gaps_at(self, state: np.ndarray, at: float) -> np.ndarray:
        """Of every wall. Raises `NoNumber` for one that is none."""
        t = self.time(state, at)
        found = self.gaps.one(t, state[self.layout.place("q")])
        for number, gap in zip(self.numbers, found, strict=True):
            if not np.isfinite(gap):
                raise NoNumber(f"ended where the gap of events[{number}] is {gap}, at t = {t:.6g}")
        return found

    def _hit(self, wall: int, gap: Any, places: np.ndarray, g: np.ndarray, behind: float) -> tuple[float, int] | None:
        """When a wall is hit, and the wall, behind which gaps are less than `behind`: others there are by rounding alone. The
        first and the last of the places are outside."""
        function = lambda x, _: np.array([gap(float(part))[wall] for part in x])
        above = lambda g: np.where(np.abs(g) <= -behind, -behind, g)  # a dip may have a place on the wall
        lifted = above(g)
        below, near = np.flatnonzero(g[1:-1] < behind) + 1, np.flatnonzero(dips(lifted[:-2], lifted[1:-1], lifted[2:])) + 1
        near = near[near < below[0]] if len(below) else near
        found = changes_beside_dips(lambda x, which: above(function(x, which)), places[near - 1], places[near + 1])
        falls = np.flatnonzero((found.fa > 0.0) & (found.fb < behind) & (found.a >= 0.0) & (found.a < places[-2]))
        if len(falls):
            first = falls[np.argmin(found.a[falls])]
            a, b = float(found.a[first]), float(found.b[first])
        elif len(below):
            a, b = float(places[below[0] - 1]), float(places[below[0]])
        elif g[1] == 0.0 and len(early := np.flatnonzero(function(soon := places[2] * np.arange(1, EARLY) / EARLY, 0) < behind)):
            a, b = 0.0, float(soon[early[0]])  # it begins on the wall, and is behind and in front of it again soon
        else:
            return None
        while gap(a)[wall] <= 0.0:  # it begins on the wall: off it, and back in less than a part of a step?
            middle = (a + b) / 2.0
            a, b = (a, middle) if gap(middle)[wall] <= 0.0 else (middle, b)
            if b - a < SHORTEST:
                return a, wall
        one = lambda x: np.array([x])
        return float(bracketed_roots(function, one(a), one(b), one(gap(a)[wall]), one(gap(b)[wall]))[0]), wall
