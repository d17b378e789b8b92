"""A flight: one trajectory of a run with impacts, from one wall to the next, with steps that are divided where a wall is hit."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from dirax.engines.contract import NOT_CONVERGED, NOT_FINITE, OK, Problem
from dirax.engines.walk import AbstractWalk
from dirax.run.impact import Numbers
from dirax.run.impact_search import ImpactSearch, NoNumber
from dirax.schemes.collision_step import HELD, LEAVING
from dirax.schemes.step import CLOCK, STEP_DENSITY
from dirax.schemes.watched_step import NONE, PARTS

FIRST_STRETCH, LONGEST_STRETCH = 16, 2**14
"""Steps after which a flight looks up first, and at the latest; others are twice as long as the flight before."""

ACCUMULATED = 1e-9
"""Part of a step: when impacts on one wall alone follow each other faster, again and again, they are called accumulating."""

AGAIN = 3
"""How often."""


MOST_AT_ONCE = 400
"""Impacts in a corner, at one moment, from which on they are said to accumulate."""

MOST_IN_STEP = 10_000
"""Impacts in one step from which on walls are said to close in on the motion."""


class Part(NamedTuple):
    """A part of a step that walls divide: from the state at `at` on, `length` of the step long, onto the number of a `wall` and
    off it, or NONE. `leaving` is a guess of the unknowns of the part that follows."""

    step: int
    at: float
    length: float
    wall: int
    state: np.ndarray
    unknowns: np.ndarray
    after: np.ndarray
    leaving: np.ndarray


@dataclass
class Flight:
    """One trajectory of a run with impacts."""

    search: ImpactSearch
    jumps: list[Numbers]
    walk: AbstractWalk
    """By steps that end where a wall may be hit; its rows are those of the run."""
    look: AbstractWalk
    """One such step."""
    collide: AbstractWalk
    """One step onto a wall."""
    row: Numbers
    """(state, u, t, h) ↦ the fields of nodes there but q, p, time and density, one after the other."""
    most: float = np.inf
    """Impacts with more of which the trajectory ends."""
    hits: list[tuple] = field(default_factory=list)
    parts: list[Part] = field(default_factory=list)
    """Those of divided steps, but of steps that turned out to be whole."""
    leaving: np.ndarray | None = None
    """The unknowns of the step that leaves the last state; None where it has no solution."""
    message: str = ""
    status: int = OK
    interrupted: bool = False

    def __post_init__(self):
        p, layout = self.search.problem, self.search.layout
        self.q, self.p = layout.place("q"), layout.place("p")
        self.extra = [layout.place(name) for name in (STEP_DENSITY, CLOCK) if name in layout]
        self.others = fields_beside(p)
        self.rows = self.walk.rows
        self.closing: dict[str, np.ndarray] = {name: np.full(f.shape, np.nan) for name, f in p.fields.items()}
        self.close, self.last, self.wall = [0] * len(self.jumps), [-np.inf] * len(self.jumps), -1
        self.done, self.state, self.unknowns = 0, np.asarray(p.state), np.asarray(p.guess[0])

    @property
    def iterations(self) -> int:
        """Updates of Newton's method."""
        return sum(walk.iterations for walk in (self.walk, self.look, self.collide))

    @property
    def max_residual(self) -> float:
        """The largest that any step left."""
        return max(walk.max_residual for walk in (self.walk, self.look, self.collide))

    # ------------------------------------------------------------------------------------------ the whole run

    def fly(self) -> None:
        """Go as far as there are steps and walls to bounce off; Ctrl-C ends it where it is."""
        try:
            self._go_on()
        except KeyboardInterrupt:
            self.interrupted, self.hits = True, [hit for hit in self.hits if hit[4] <= self.done]
        except NoNumber as error:
            self._end(str(error), NOT_FINITE)
        self.finish()

    def _go_on(self) -> None:
        p, stretch = self.search.problem, FIRST_STRETCH
        while self.done < p.steps:
            begun, stop = self.done, min(self.done + stretch, p.steps)
            good = self.walk.go(alerted(self.state, 1.0), self.unknowns, begun, stop, p.t0 + begun * p.h, p.h)
            self.state, self.unknowns, self.done = self.walk.state[:-3], self.walk.unknowns, begun + good
            stretch = min(2 * stretch, LONGEST_STRETCH)
            if self.done < stop:
                found = self._divided(self.state, self.unknowns, self.done)
                if found is None:
                    break
                (self.state, self.unknowns), self.done = found, self.done + 1
                stretch = max(FIRST_STRETCH, min(2 * good, LONGEST_STRETCH))

    def finish(self) -> None:
        """Find the row at the end."""
        out = self.search.steps(self.state, self.unknowns, self.done, 1.0)
        good = bool(out.completed[0])
        self.leaving = out.last_unknowns[0] if good else None
        for name in self.closing:
            if self.search.problem.is_node(name):
                self.closing[name] = out.fields[name][0][0] if good else out.closing[name][0]

    def _keep(self, step: int, rows: dict[str, np.ndarray]) -> None:
        for name, values in self.rows.items():
            values[step] = rows[name][0]

    # ------------------------------------------------------------------------------------------ a step with impacts

    def _divided(self, state: np.ndarray, u: np.ndarray, step: int) -> tuple[np.ndarray, np.ndarray] | None:
        """The state and the unknowns after a step in which walls may be hit; None where it does not end."""
        p, at = self.search.problem, 0.0
        while True:
            t, h = p.t0 + (step + at) * p.h, (1.0 - at) * p.h
            good = self.look.go(alerted(state, 0.0), u, 0, 1, t, h)
            wall, place = self.look.state[-2:].tolist()
            if good and wall == NONE:
                after, leaving = self.look.state[:-3], self.look.unknowns
                if at == 0.0:
                    self._keep(step, self.look.rows)
                else:
                    self.parts.append(Part(step, at, 1.0 - at, int(NONE), state, leaving, after, leaving))
                return after, leaving
            hit = good and wall >= 0.0 and self._onto(wall, place, state, t, h)
            if not hit:
                return self._searched(state, u, step, at)
            if at == 0.0:
                self._keep(step, self.collide.rows)
            length, before = (1.0 - at) * self.collide.unknowns[-1], (at, state)
            at += length
            state, u = self.collide.state[:-3], self.collide.rows[LEAVING][0].copy()
            if not self._noted(state, u, int(wall), step + at):
                return None
            self.parts.append(Part(step, before[0], length, int(wall), before[1], self.collide.unknowns[:-1], state, u))

    def _onto(self, wall: float, place: float, state: np.ndarray, t: float, h: float) -> bool:
        """Whether the step onto a wall ends between the places at which its gap was seen to change its sign."""
        begun, guess = np.concatenate([state, [0.0, wall, place]]), np.append(self.look.unknowns, place)
        if not self.collide.go(begun, guess, 0, 1, t, h):
            return False
        low = np.floor(place * PARTS) / PARTS
        return bool(low <= self.collide.unknowns[-1] <= low + 1.0 / PARTS)

    def _noted(self, state: np.ndarray, u: np.ndarray, wall: int, at: float) -> bool:
        """Note an impact, of which these are the state after it and a guess of the unknowns; whether the run goes on."""
        t, number = self.search.time(state, at), self.search.numbers[wall]
        alone = self.wall == wall  # in a corner, walls are hit in turn, and as often as it takes
        self.close[wall] = self.close[wall] + 1 if alone and at - self.last[wall] < ACCUMULATED else 0
        self.last[wall], self.wall = at, wall
        if self.close[wall] >= AGAIN:
            return self._accumulated(number, t)
        if len(self.hits) >= MOST_AT_ONCE and self.hits[-MOST_AT_ONCE][4] > at - ACCUMULATED:
            return self._accumulated(number, t)
        if len(self.hits) >= self.most:
            return self._end(f"more than {self.most} impacts up to t = {t:.6g}, the last one on events[{number}]")
        if len(self.hits) >= MOST_IN_STEP and self.hits[-MOST_IN_STEP][4] > at - 1.0:
            return self._end(
                f"{MOST_IN_STEP} impacts within one step up to t = {t:.6g}, the last one on events[{number}]: walls close in on "
                "the motion, or the step is far too long for it"
            )
        others = self.row.one(state, u, t, self.search.problem.h) if self.others else np.zeros(0)
        self.hits.append((t, number, state[self.q].copy(), state[self.p].copy(), at, others, *(state[i][0] for i in self.extra)))
        return True

    def _accumulated(self, number: int, t: float) -> bool:
        return self._end(
            f"impacts on events[{number}] accumulate at t = {t:.6g} (Zeno), after {len(self.hits)} of them: what comes after "
            "is a motion on the wall, which can be run with a holonomic constraint"
        )

    def _end(self, message: str, status: int = NOT_CONVERGED) -> bool:
        self.message, self.status = message, status
        return False

    def refuse(self, message: str) -> None:
        """End the trajectory where it begins, for this reason."""
        self._end(message)
        self.finish()

    # ------------------------------------------------------------------------------------------ where it is doubtful

    def _searched(self, state: np.ndarray, u: np.ndarray, step: int, at: float) -> tuple[np.ndarray, np.ndarray] | None:
        """`_divided` from a part of a step on, by a search for each impact."""
        search, first = self.search, at == 0.0
        while True:
            found = search.next(state, u, step + at, 1.0 - at)
            part = 1.0 - at if found is None else found[0]
            out, moved = search.part(state, u, step + at, part)
            if first:
                self._keep(step, {name: rows[0] for name, rows in out.fields.items()})
            if moved is None:
                self.status = int(out.status[0])
                return None
            if found is None:
                self.parts.append(Part(step, at, part, int(NONE), state, moved[1], *moved))
                return moved
            begins, at, first = at, at + part, False
            hit = self._bounced(moved[0], found[1], step + at)
            if hit is None:
                return None
            self.parts.append(Part(step, begins, part, found[1], state, moved[1], *hit))
            state, u = hit

    def _bounced(self, state: np.ndarray, wall: int, at: float) -> tuple[np.ndarray, np.ndarray] | None:
        """The state after an impact, and a guess of the unknowns of the step that leaves it; None where the run ends there."""
        t, number, size = self.search.time(state, at), self.search.numbers[wall], len(state)
        found = self.jumps[wall].one(state, t, self.search.problem.h)
        after, u, (speed, share) = found[:size], found[size:-2], found[-2:]
        if not np.all(np.isfinite(found)) or share < HELD:
            regular = "its jump is not finite: L must be regular there, and the restitution from 0 to 1"
            why = "constraints hold it back" if share < HELD else regular
            self._end(f"events[{number}] was hit at t = {t:.6g}, and nothing can bounce off it: {why}")
            return None
        if speed >= 0.0:
            self._accumulated(number, t)
            return None
        return (after, u) if self._noted(after, u, wall, at) else None


def fields_beside(p: Problem) -> list[str]:
    """The fields of nodes but q, p, and what steps of lengths of their own have."""
    return [name for name in p.fields if p.is_node(name) and name not in ("q", "p", STEP_DENSITY, CLOCK)]


def alerted(state: np.ndarray, alert: float) -> np.ndarray:
    """The state of a watched step."""
    return np.concatenate([state, [alert, NONE, 0.0]])
