"""A run with impacts: flights from one wall to the next, and steps divided where a wall is hit."""

import time
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.engines.contract import NOT_CONVERGED, OK, Outcome, Problem, finished
from dirax.engines.walk import Walk
from dirax.program.memo import Memo, Same
from dirax.run.event import captures_traced
from dirax.run.impact import Impact, Numbers, jump
from dirax.run.impact_search import ImpactSearch
from dirax.run.result import solution_of
from dirax.schemes.collision_step import HELD, LEAVING, CollisionStep
from dirax.schemes.step import CLOCK, PART, STEP_DENSITY, StepEquation
from dirax.schemes.watched_step import NONE, PARTS, WatchedStep
from dirax.solution.events import Events
from dirax.solution.solution import Solution

FIRST_STRETCH, LONGEST_STRETCH = 16, 2**14
"""Steps after which a flight looks up first, and at the latest; others are twice as long as the flight before."""

ACCUMULATED = 1e-9
"""Part of a step: when impacts follow each other faster, again and again, they are called accumulating."""

AGAIN = 3
"""How often."""


@dataclass
class Flight:
    """One trajectory of a run with impacts."""

    search: ImpactSearch
    jumps: list[Numbers]
    walk: Walk
    """By steps that end where a wall may be hit; its rows are those of the run."""
    look: Walk
    """One such step."""
    collide: Walk
    """One step onto a wall."""
    hits: list[tuple] = field(default_factory=list)
    message: str = ""
    status: int = OK

    def __post_init__(self):
        p, layout = self.search.problem, self.search.layout
        self.q, self.p = layout.place("q"), layout.place("p")
        self.extra = [layout.place(name) for name in (STEP_DENSITY, CLOCK) if name in layout]
        self.rows = self.walk.rows
        self.closing: dict[str, np.ndarray] = {name: np.full(f.shape, np.nan) for name, f in p.fields.items()}
        self.close, self.last = 0, -np.inf

    @property
    def iterations(self) -> int:
        """Updates of Newton's method."""
        return sum(walk.iterations for walk in (self.walk, self.look, self.collide))

    @property
    def max_residual(self) -> float:
        """The largest that any step left."""
        return max(walk.max_residual for walk in (self.walk, self.look, self.collide))

    # ------------------------------------------------------------------------------------------ the whole run

    def fly(self) -> tuple[int, np.ndarray, np.ndarray]:
        """The number of good steps, and the state and the unknowns at the end."""
        p, done, stretch = self.search.problem, 0, FIRST_STRETCH
        state, u = np.asarray(p.state), np.asarray(p.guess[0])
        while done < p.steps:
            stop = min(done + stretch, p.steps)
            good = self.walk.go(_alert(state, 1.0), u, done, stop, p.t0 + done * p.h, p.h)
            state, u, done = self.walk.state[:-3], self.walk.unknowns, done + good
            stretch = min(2 * stretch, LONGEST_STRETCH)
            if done == stop:
                continue
            found = self._divided(state, u, done)
            if found is None:
                break
            (state, u), done = found, done + 1
            stretch = max(FIRST_STRETCH, min(2 * good, LONGEST_STRETCH))
        self._close(state, u, done)
        return done, state, u

    def _close(self, state: np.ndarray, u: np.ndarray, done: int) -> None:
        """Find the row at the end."""
        out = self.search.steps(state, u, done, 1.0)
        good = bool(out.completed[0])
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
            good = self.look.go(_alert(state, 0.0), u, 0, 1, t, h)
            wall, place = self.look.state[-2:].tolist()
            if good and wall == NONE:
                if at == 0.0:
                    self._keep(step, self.look.rows)
                return self.look.state[:-3], self.look.unknowns
            hit = good and wall >= 0.0 and self._onto(wall, place, state, t, h)
            if not hit:
                return self._searched(state, u, step, at)
            if at == 0.0:
                self._keep(step, self.collide.rows)
            at += (1.0 - at) * self.collide.unknowns[-1]
            state, u = self.collide.state[:-3], self.collide.rows[LEAVING][0].copy()
            if not self._noted(state, int(wall), step + at):
                return None

    def _onto(self, wall: float, place: float, state: np.ndarray, t: float, h: float) -> bool:
        """Whether the step onto a wall ends between the places at which its gap was seen to change its sign."""
        begun, guess = np.concatenate([state, [0.0, wall, place]]), np.append(self.look.unknowns, place)
        if not self.collide.go(begun, guess, 0, 1, t, h):
            return False
        low = np.floor(place * PARTS) / PARTS
        return bool(low <= self.collide.unknowns[-1] <= low + 1.0 / PARTS)

    def _noted(self, state: np.ndarray, wall: int, at: float) -> bool:
        """Note an impact, of which this is the state after it; whether the run goes on."""
        t, number = self.search.time(state, at), self.search.numbers[wall]
        self.close = self.close + 1 if at - self.last < ACCUMULATED else 0
        self.last = at
        if self.close >= AGAIN:
            return self._accumulated(number, t)
        self.hits.append((t, number, state[self.q].copy(), state[self.p].copy(), at, *(state[i][0] for i in self.extra)))
        return True

    def _accumulated(self, number: int, t: float) -> bool:
        return self._end(
            f"impacts on events[{number}] accumulate at t = {t:.6g} (Zeno), after {len(self.hits)} of them: what comes after "
            "is a motion on the wall, which can be run with a holonomic constraint"
        )

    def _end(self, message: str) -> bool:
        self.message, self.status = message, NOT_CONVERGED
        return False

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
            state, u = moved
            if found is None:
                return state, u
            at, first = at + part, False
            hit = self._bounced(state, found[1], step + at)
            if hit is None:
                return None
            state, u = hit

    def _bounced(self, state: np.ndarray, wall: int, at: float) -> tuple[np.ndarray, np.ndarray] | None:
        """The state after an impact, and a guess of the unknowns of the step that leaves it; None where the run ends there."""
        t, number, size = self.search.time(state, at), self.search.numbers[wall], len(state)
        found = self.jumps[wall].one(state, t, self.search.problem.h)
        after, u, (speed, share) = found[:size], found[size:-2], found[-2:]
        if not np.all(np.isfinite(found)) or share < HELD:
            why = "constraints hold it back" if share < HELD else "its jump is not finite: L must be regular there"
            self._end(f"events[{number}] was hit at t = {t:.6g}, and nothing can bounce off it: {why}")
            return None
        if speed >= 0.0:
            self._accumulated(number, t)
            return None
        return (after, u) if self._noted(after, wall, at) else None


def _alert(state: np.ndarray, alert: float) -> np.ndarray:
    return np.concatenate([state, [alert, NONE, 0.0]])


# ---------------------------------------------------------------------------------------------- all trajectories


def fly_all(settings: Any, begun: Any, walls: tuple[Impact, ...], numbers: tuple[int, ...]) -> Solution:
    """The Solution of a problem with impacts, of which every row is saved. Raises `TypeError` and `ValueError`."""
    p, system, started = begun.problem, settings.system, time.perf_counter()
    lanes = p.batch or 1
    one = lambda a, lane: np.asarray(a)[lane] if p.batch is not None else np.asarray(a)
    params = lambda lane: jax.tree.map(lambda leaf: np.asarray(leaf)[lane], p.params) if p.batch_params else p.params
    own = [
        p.with_numbers(
            state=one(p.state, lane),
            guess=tuple(one(g, lane) for g in p.guess),
            params=params(lane),
            batch=None,
            batch_params=False,
        )
        for lane in range(lanes)
    ]
    run = settings.engine.prepared(own[0])
    flights, ends = [], []
    for number, lane in enumerate(own):
        flight = _flight(settings.engine, run, system, lane, walls, numbers)
        _refuse_behind(flight, number if p.batch is not None else None)
        ends.append(flight.fly())
        flights.append(flight)
    done = np.array([end[0] for end in ends])
    fields = {name: np.stack([flight.rows[name] for flight in flights]) for name in p.fields}
    closing = {name: np.stack([flight.closing[name] for flight in flights]) for name in p.fields}
    for name in filter(p.is_node, closing):
        fields[name] = np.concatenate([fields[name], closing[name][:, None]], axis=1)
    seconds = time.perf_counter() - started
    sample = run(own[0].with_numbers(steps=1, save_every=1), None)
    outcome = Outcome(
        fields=fields,
        closing=closing,
        completed=done,
        status=np.array([flight.status for flight in flights]),
        iterations=np.array([flight.iterations for flight in flights]),
        max_residual=np.array([flight.max_residual for flight in flights]),
        last_state=np.stack([end[1] for end in ends]),
        last_unknowns=np.stack([end[2] for end in ends]),
        engine=sample.engine,
        run_seconds=seconds,
        notes={**sample.notes, "impacts": sum(len(flight.hits) for flight in flights)},
    )
    said = [flight.message for flight in flights]
    sol = solution_of(system, settings.scheme, begun.case, p, finished(p, outcome), begun.row0, False, said)
    sol.impacts = _events(flights, p)
    return sol


_steps: Memo[tuple[StepEquation, StepEquation]] = Memo(64)


def _flight(engine: Any, run: Any, system: Any, p: Problem, walls: tuple[Impact, ...], numbers: tuple[int, ...]) -> Flight:
    stage = p.equation.stages[0][0]
    gaps = lambda t, q, params: jnp.stack([jnp.asarray(wall(t, q, params), float) for wall in walls])
    own = tuple(map(Same, walls))
    watched, collision = _steps.get(
        ("walls", Same(system), Same(p.equation), *own),
        lambda: (
            WatchedStep(stage, system, gaps).equation(),
            CollisionStep(stage, system, gaps, tuple(wall.restitution for wall in walls)).equation(),
        ),
    )
    state, (u,) = _alert(p.state, 1.0), p.guess
    many = replace(p, equation=watched, state=state, save_every=1)
    hit = replace(p, equation=collision, state=state, guess=(np.append(u, 0.5),), save_every=1, steps=1)
    t, q = np.zeros(()), np.zeros(stage.state_layout["q"][0])
    search = ImpactSearch(p, numbers, run, Numbers(gaps, [t, q], p.params, "gaps", *own))
    jumped = lambda wall: lambda state, t, h, params: jump(system, stage, wall, state, t, h, params)
    key = "jump", Same(system), Same(p.equation)
    jumps = [
        Numbers(jumped(wall), [np.asarray(p.state), t, t], p.params, *key, same) for wall, same in zip(walls, own, strict=True)
    ]
    return Flight(search, jumps, *(engine.walk(one) for one in (many, replace(many, steps=1), hit)))


def check_walls(system: Any, p: Problem, walls: tuple[Impact, ...], numbers: tuple[int, ...]) -> bool:
    """Whether a gap closes over values that JAX traces. Raises `TypeError` and `ValueError` for walls that these steps cannot
    bounce off, and gaps that are none."""
    stages = p.equation.stages
    layout = stages[0][0].state_layout
    if system.lagrangian_form() is None or len(stages) > 1 or not {"q", "p"} <= set(layout):
        raise TypeError(
            "dx.Impact bounces Lagrangian systems in coordinates by schemes of one part whose state holds (q, p), such as "
            "dx.LagrangeDAlembert(), dx.DiscreteDirac() and dx.Collocation(); this is "
            f"{type(system).__name__} with a {'composition' if len(stages) > 1 else 'state of ' + ', '.join(layout)}."
        )
    if p.first_step:
        raise ValueError("a run with dx.Impact starts from q= with v= or p=, not from two points.")
    t, q = jax.ShapeDtypeStruct((), jnp.float64), jax.ShapeDtypeStruct((layout["q"][0],), jnp.float64)
    own = jax.tree.map(lambda leaf: jnp.asarray(leaf)[0], p.params) if p.batch_params else p.params
    traced = False
    for wall, number in zip(walls, numbers, strict=True):
        try:
            found, seen = captures_traced(wall, t, q, own)
        except Exception as error:
            raise TypeError(
                f"the gap of events[{number}] could not be traced by JAX: {type(error).__name__}: "
                f"{(str(error).splitlines() or [''])[0]}"
            ) from error
        if not hasattr(found, "shape") or found.shape != ():
            came = f"shape {found.shape}: index or sum its result" if hasattr(found, "shape") else type(found).__name__
            raise ValueError(f"the gap of events[{number}] must return one number, but it returned {came}.")
        traced = traced or seen
    return traced


def _refuse_behind(flight: Flight, lane: int | None) -> None:
    """Raise `ValueError` for a trajectory that begins behind a wall, by more than rounding."""
    p, whose = flight.search.problem, "" if lane is None else f" of trajectory {lane}"
    state = np.asarray(p.state)
    gaps = flight.search.gaps.one(p.t0, state[flight.q])
    for number, gap in zip(flight.search.numbers, gaps, strict=True):
        if not np.isfinite(gap):
            raise ValueError(f"the gap of events[{number}] must be finite along the run, but it is {gap} at the start{whose}.")
        if not gap >= -1e-12 * (1.0 + np.max(np.abs(state[flight.q]))):
            raise ValueError(
                f"the gap of events[{number}] must not be negative at the start{whose}, but it is {gap:.6g}: begin in front "
                "of the wall, or change the sign of the gap."
            )


def _events(flights: list[Flight], p: Problem) -> Events:
    hits, layout = [(lane, *hit) for lane, flight in enumerate(flights) for hit in flight.hits], flights[0].search.layout
    n = layout["q"][0]
    array = lambda i, shape=(), kind=float: np.array([hit[i] for hit in hits], kind).reshape(len(hits), *shape)
    fields = {"q": array(3, (n,)), "p": array(4, (n,))}
    if CLOCK in layout:
        fields |= {STEP_DENSITY: array(6), CLOCK: array(7), PART: array(5) % 1.0}
    return Events(array(1), array(2, (), int), np.full(len(hits), -1), array(0, (), int), fields)
