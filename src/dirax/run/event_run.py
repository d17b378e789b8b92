"""A run with events: carried out in stretches of which every row is kept, and looked through."""

import time
import warnings
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from dirax.program.user_functions import is_traced
from dirax.run.event import TRACED, Event, captures_traced, evaluated, refuse_unknown
from dirax.run.event_search import EventSearch, places_for
from dirax.run.event_traced import with_traced_events
from dirax.run.impact import Impact
from dirax.run.impact_run import check_walls, fly_all
from dirax.run.impact_traced import flight_of, flown
from dirax.run.redundancy import without_redundant
from dirax.run.traced_run import carried_by_jax
from dirax.solution.dense import Dense
from dirax.solution.events import Events, joined
from dirax.solution.restarts import refuse_restarting, refuse_sums, resumes_in_its_own_way
from dirax.solution.solution import Solution

FIRST_STEPS = 3
"""Steps by which it is found out whether a step from a row goes on with the run."""

FIRST_STRETCH = 256
"""Steps of the first stretch of a run that may end at an event; every other one is as long as all before it."""


def with_events(run: Any, events: tuple[Any, ...], steps: int, save_every: int, progress: Any, traced: bool) -> Solution:
    """The Solution of a run with its events; `run(steps)` is that of so many steps with every row, with its impacts.

    Raises `ValueError` under JAX's transformations and for functions that are not finite at the start, `TypeError` for those that
    return no number.
    """
    watch = any(event.terminal for event in events) and not any(isinstance(event, Impact) for event in events)
    sol = run(min(steps, FIRST_STRETCH) if watch and not traced else steps)
    closed = _capture_traced(sol, events)
    if traced or is_traced(sol.t, sol.fields) or closed:
        if any(isinstance(event, Impact) for event in events):
            raise ValueError(TRACED)
        sol = run(steps) if int(sol.rows) <= steps else sol
        found = with_traced_events(sol, events, places_for(sol.equation), closed)
        kept = thinned(found, save_every)
        kept.events = found.events
        return kept
    searched = Searched(sol, events)
    searched.go_on(sol)
    while watch and not searched.over and int(sol.stats["steps"]) < steps:
        done = int(sol.stats["steps"])
        sol = sol.extend(min(done, steps - done), progress)
        searched.go_on(sol)
    return searched.solution(save_every, steps)


def _capture_traced(sol: Solution, events: tuple[Any, ...]) -> bool:
    """Whether the function of an event closes over values that JAX traces."""
    nodes = {name: jax.ShapeDtypeStruct(f.shape, float) for name, f in sol.field_info.items() if f.place == "node"}
    known = nodes | {"t": jax.ShapeDtypeStruct((), float)} | ({"v": nodes["q"]} if "q" in nodes else {})
    for number, event in enumerate(events):
        if isinstance(event, Event):
            refuse_unknown(event, number, nodes)
            own = {name: known[name] for name in event.arguments if name in known}
            value = lambda own, params, number=number, event=event: evaluated(event, number, own, params)
            if captures_traced(f"the function of events[{number}]", value, own, sol.params_of_one)[1]:
                return True
    return False


class Searched:
    """A run as far as it has been looked through."""

    def __init__(self, sol: Solution, events: tuple[Any, ...]):
        self.events, self.sol, self.done, self.seconds = events, sol, 0, 0.0
        self.found: Events | None = None
        self.endings = np.full(sol.batch or 1, np.inf)
        """When a terminal event ends each trajectory, or nobody knows any more."""
        self.undefined: dict[int, np.ndarray] = {}
        """By number of an event, when its function is no number first in each trajectory."""

    @property
    def over(self) -> bool:
        """Whether no trajectory goes on: each has met a terminal event, or has failed."""
        return bool(np.all(np.isfinite(self.endings) | ~np.atleast_1d(self.sol.ok)))

    def go_on(self, sol: Solution) -> None:
        """Look through the steps that a longer run has more."""
        began, self.sol = time.perf_counter(), sol
        own = [(i, event) for i, event in enumerate(self.events) if isinstance(event, Event)]
        parts = [self.found] if self.found is not None else []
        if sol.impacts is not None:
            parts = [sol.impacts, *(part[np.isin(part.index, [i for i, _ in own])] for part in parts)]
        if sol.rows > 1 and own:
            dense = Dense(sol)
            last = int(dense.ends.max())
            for i, event in own:
                search = EventSearch(dense, event, i)
                parts.append(search.found(self.done, last))
                self._note(search)
            self.done = last
        if parts:
            self.found = joined(parts)
            for i, event in own:
                if event.terminal:
                    ends = self.found.of(i)
                    np.minimum.at(self.endings, ends.lane, ends.t)
            self.found = self.found[self.found.t <= self.endings[self.found.lane]]
        self.seconds += time.perf_counter() - began

    def _note(self, search: EventSearch) -> None:
        """Take down when the function of an event is no number first. Raises `ValueError` where it is none at the start."""
        number = search.number
        known = self.undefined.setdefault(number, np.full(len(self.endings), np.inf))
        np.minimum(known, search.undefined, out=known)
        if np.any(first := known <= float(self.sol.axis[0])):
            whose = f" of trajectory {int(np.argmax(first))}" if self.sol.batch is not None else ""
            raise ValueError(f"the function of events[{number}] must be a number, but it is none at the start{whose}.")
        if search.event.terminal:
            np.minimum(self.endings, search.last_known, out=self.endings)

    def _lost(self) -> np.ndarray:
        """Which trajectories end because nobody knows whether a terminal event has ended them."""
        lost = np.zeros(len(self.endings), bool)
        for number, undefined in self.undefined.items():
            if self.events[number].terminal:
                lost |= np.isfinite(undefined) & (self.endings == np.nextafter(undefined, -np.inf))
        return lost

    def _said(self) -> list[str]:
        """Why trajectories ended, and of which not all events are known, which is warned of."""
        said, lost = [""] * len(self.endings), self._lost()
        for lane in np.flatnonzero(np.isfinite(self.endings) & ~lost).tolist():
            said[lane] = self._ending(lane)
        unknown: list[str] = []
        for number, undefined in self.undefined.items():
            for lane in np.flatnonzero(np.isfinite(undefined) & ((undefined <= self.endings) | lost)).tolist():
                what = f"the function of events[{number}] is no number at t = {undefined[lane]:.6g}"
                said[lane] = said[lane] or (f"ended where {what}" if lost[lane] else f"{what}: events after that are not known")
                unknown.append(what + (f" in trajectory {lane}" if self.sol.batch is not None else ""))
        if unknown:
            warnings.warn(
                f"{unknown[0]}: its events after that are not known. Give a function that is one all along, by jnp.where.",
                RuntimeWarning,
                stacklevel=7,
            )
        return said

    def solution(self, save_every: int, steps: int) -> Solution:
        """The Solution of the run with the rows that are to be kept, and its events."""
        sol, ended = self.sol, np.isfinite(self.endings)
        kept = thinned(ended_at(sol, self.endings), save_every)
        kept.stats = sol.stats | {"events_seconds": self.seconds}
        kept.events = self.found
        if sol.impacts is not None:
            kept.impacts = sol.impacts[sol.impacts.t <= self.endings[sol.impacts.lane]]
        own, lost = self._said(), self._lost()
        if np.any(ended) or any(own):
            before = [sol.message] if sol.batch is None else sol.message or [""] * len(own)
            messages = [one or other for one, other in zip(own, before, strict=True)]
            ok = np.where(ended, ~lost, np.atleast_1d(sol.ok))
            kept.message, kept.ok = (messages[0], bool(ok[0])) if sol.batch is None else (messages, ok)
        kept.example = sol.example
        if sol.continuation is not None:
            kept.continuation = LongerWithEvents(self, save_every, steps)
            kept.again = self.again if sol.impacts is not None else None
        return kept

    def again(self, steps: int) -> Solution:
        """The first so many steps of a run with walls once more, with every row."""
        return self.sol.continuation(self.sol, steps - int(self.sol.stats["steps"]), False)

    def _ending(self, lane: int) -> str:
        assert self.found is not None
        own = self.found[self.found.lane == lane]
        number = int(own.index[own.t == self.endings[lane]][-1])
        return f"ended at t = {self.endings[lane]:.6g} by events[{number}], {self.events[number]!r}"


@dataclass(frozen=True)
class LongerWithEvents:
    """`sol.extend` of a run with events: every row of it is known here."""

    searched: Searched
    save_every: int
    steps: int

    def __call__(self, sol: Solution, more: int, progress: Any) -> Solution:
        """The solution of the run of so many more steps. One that an event has ended stays as it is."""
        before = self.searched
        if before.over:
            return sol
        after = Searched(before.sol, before.events)
        after.done, after.found, after.endings = before.done, before.found, before.endings.copy()
        after.go_on(before.sol.extend(self.steps - int(before.sol.stats["steps"]) + more, progress))
        longer = after.solution(self.save_every, self.steps + more)
        longer.metadata, longer.example = sol.metadata, sol.example
        return longer


def ended_at(sol: Solution, endings: np.ndarray) -> Solution:
    """The solution without the rows after these times (B,): one trajectory ends before it, in a batch they are NaN."""
    if not np.any(np.isfinite(endings)):
        return sol
    t = np.asarray(sol.t)
    if sol.batch is None:
        return sol[: int(np.searchsorted(t, endings[0], side="right"))]
    t = np.broadcast_to(t, (sol.batch, sol.rows))
    fields = {}
    for name, values in sol.fields.items():
        rows = t if sol.field_info[name].place == "node" else t[:, 1:]
        after = rows > endings[:, None]
        fields[name] = np.where(after.reshape(*after.shape, *(1,) * (values.ndim - 2)), np.nan, values)
    return sol.replace(fields=fields)


def thinned(sol: Solution, every: int) -> Solution:
    """The solution with every so many of its rows, and the last one."""
    if every == 1 or sol.rows < 2:
        return sol.replace()
    first = int("q0" in sol.initial)
    rows = np.unique([*range(first), *range(first, sol.rows, every), sol.rows - 1])
    lead = (slice(None),) * (sol.batch is not None)
    pick = lambda name, a: a[(*lead, rows if sol.field_info[name].place == "node" else rows[:-1])]
    fields = {name: pick(name, a) for name, a in sol.fields.items()}
    return sol.replace(t=sol.axis[rows], fields=fields, save_every=every, derived={})


def run_with_events(
    carry_out: Any, begin: Any, settings: Any, case: Any, steps: int, save_every: int, progress: Any, kind: Any, entered: float
) -> Solution:
    """A run whose settings have events."""
    plain = replace(settings, events=())
    every = min(save_every, max(1, steps - int(case.two_points)))
    walls = [i for i, event in enumerate(settings.events) if isinstance(event, Impact)]
    if case.traced and 0 < len(walls) < len(settings.events):
        raise ValueError(TRACED)

    def run(count: int) -> Solution:
        if not walls:
            return carry_out(plain, case, count, 1, progress, kind, entered)
        own = tuple(settings.events[i] for i in walls)

        def begun_at(case: Any) -> tuple[Any, bool]:
            begun = begin(plain, case, count, 1, 1)
            captured = check_walls(plain.system, begun.problem, own, tuple(walls))
            first = begun.problem.equation.stages[0][0]
            if begun.traced or captured:
                refuse_sums(first, begun.problem.params)
            elif resumes_in_its_own_way(first):
                refuse_restarting(Dense(carry_out(plain, case, min(count, FIRST_STEPS), 1, False)).again)
            return begun, captured

        if case.traced:
            known = without_redundant(plain.system, case, plain.project)

            def by_jax(case: Any) -> tuple:
                begun, captured = begun_at(case)
                on_host = not (captured or plain.engine.compiles_start(True))
                return flown(plain.system, begun, own, tuple(walls), on_host)

            found = carried_by_jax(by_jax, plain, known, count, *walls, *own)
            return flight_of(plain, case, *found)
        began = time.perf_counter()
        begun, captured = begun_at(case)
        if begun.traced or captured:
            return flight_of(plain, case, *flown(plain.system, begun, own, tuple(walls), False))
        started = time.perf_counter()
        sol = fly_all(plain, begun, own, tuple(walls))
        known = sol.stats["compile_seconds"] + sol.stats["run_seconds"]
        sol.stats |= {
            "validate_seconds": began - entered if entered else 0.0,
            "start_seconds": started - began,
            "result_seconds": max(0.0, time.perf_counter() - started - known),
        }
        sol.continuation = lambda _, more, progress: run(count + more)
        return sol

    if len(walls) == len(settings.events):
        sol = run(steps)
        if is_traced(sol.t, sol.fields):
            found = sol.events
            sol = thinned(sol, every)
            sol.events = sol.impacts = found
            return sol
        if not case.traced:
            return with_events(lambda _: sol, settings.events, steps, every, progress, False)
    return with_events(run, settings.events, steps, every, progress, case.traced)
