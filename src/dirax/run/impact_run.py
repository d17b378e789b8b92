"""A run with impacts: stretches by the engine from one wall to the next, and steps divided where a wall is hit."""

import time
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.engines.contract import NOT_CONVERGED, OK, Outcome, Problem
from dirax.numerics.brackets import bracketed_roots
from dirax.program.memo import Same
from dirax.run.event_search import dips
from dirax.run.impact import Impact, Numbers, jump
from dirax.run.result import solution_of
from dirax.solution.events import Events
from dirax.solution.solution import Solution

FIRST_STRETCH = 16
"""Steps after which it is looked for the first wall; later stretches are as long as the flights before."""

PARTS = 4
"""Places of a step at which the gaps are looked at."""

FINER, LEVELS = 8, 3
"""Around a place where a gap comes near to zero, they are looked at in as many more, again and again."""

ON_WALL = 1e-13
"""Gaps below this, relative to q, are none."""

SHORTEST = 1e-12
"""The shortest flight, in steps."""

SHORT, BEYOND = 0.25, 0.5
"""Parts of a step below the first may be too short to be solved; then a step is taken that is longer by the second."""

ACCUMULATED = 1e-9
"""Part of a step: when impacts follow each other faster, again and again, they are called accumulating."""

AGAIN = 3
"""How often."""


@dataclass
class Flight:
    """One trajectory of a run with impacts."""

    walls: tuple[Impact, ...]
    numbers: tuple[int, ...]
    """Their places in `events=`."""
    system: Any
    problem: Problem
    """That of this trajectory, every step of it saved."""
    run: Any
    gaps: Numbers
    jumps: list[Numbers]
    rows: dict[str, np.ndarray] = field(init=False)
    hits: list[tuple] = field(default_factory=list)
    message: str = ""
    status: int = OK
    iterations: int = 0
    max_residual: float = 0.0

    def __post_init__(self):
        p, layout = self.problem, self.problem.equation.stages[0][0].state_layout
        self.q, self.p = layout.place("q"), layout.place("p")
        lengths = ((name, p.steps + p.is_node(name), about.shape) for name, about in p.fields.items())
        self.rows = {name: np.full((length, *shape), np.nan) for name, length, shape in lengths}
        self.close, self.last = 0, -np.inf

    # ------------------------------------------------------------------------------------------ the whole run

    def fly(self) -> tuple[int, np.ndarray, np.ndarray]:
        """The number of good steps, and the state and the unknowns at the end."""
        p, done, stretch = self.problem, 0, FIRST_STRETCH
        state, u = np.asarray(p.state), np.asarray(p.guess[0])
        while done < p.steps:
            count = min(stretch, p.steps - done)
            out = self._steps(state, u, self._time(done), p.h, count)
            good = int(out.completed[0])
            hit = self._first_hit(out.fields["q"][0][: good + 1], done)
            if hit is not None and hit < good:
                if hit:
                    out = self._steps(state, u, self._time(done), p.h, hit)
                    self._keep(out, done, hit)
                    state, u = out.last_state[0], out.last_unknowns[0]
                done += hit
                found = self._divided(state, u, done)
                if found is None:
                    break
                state, u = found
                done += 1
                stretch = max(FIRST_STRETCH, 2 * hit)
                continue
            self._keep(out, done, good)
            state, u = out.last_state[0], out.last_unknowns[0]
            done += good
            if good < count:
                self.status = int(out.status[0])
                break
            stretch *= 2
        self._close(state, u, done)
        return done, state, u

    def _time(self, step: Any) -> Any:
        return self.problem.t0 + step * self.problem.h

    def _steps(self, state: np.ndarray, u: np.ndarray, t: float, h: float, count: int) -> Outcome:
        """So many steps of length h from a state."""
        problem = self.problem.with_numbers(state=state, guess=(u,), t0=t, h=h, steps=count, save_every=1)
        return self.run(problem, None)

    def _keep(self, out: Outcome, at: int, count: int) -> None:
        """Save the rows of so many steps from number `at` on."""
        for name, values in self.rows.items():
            values[at : at + count] = out.fields[name][0][:count]
        self.iterations += int(out.iterations[0])
        self.max_residual = max(self.max_residual, float(out.max_residual[0]))

    def _close(self, state: np.ndarray, u: np.ndarray, done: int) -> None:
        """Save the row at the end."""
        out = self._steps(state, u, self._time(done), self.problem.h, 1)
        source = out.fields if int(out.completed[0]) else out.closing
        for name, values in self.rows.items():
            if self.problem.is_node(name):
                values[done] = source[name][0][0] if int(out.completed[0]) else source[name][0]

    def _first_hit(self, q: np.ndarray, done: int) -> int | None:
        """The number of the first step, of those between these rows, in which a wall may be hit."""
        if len(q) < 2:
            return None
        bend = q[:3].T @ np.array([1.0, -2.0, 1.0]) if len(q) > 2 else 0.0
        fall = q[-3:].T @ np.array([1.0, -2.0, 1.0]) if len(q) > 2 else 0.0
        wide = np.concatenate([[2 * q[0] - q[1] + bend], q, [2 * q[-1] - q[-2] + fall]])
        theta = np.arange(PARTS)[:, None] / PARTS
        a, b, c, d = (wide[i : i + len(q) - 1, None] for i in range(4))
        # the cubic through four rows
        inner = (
            -theta * (theta - 1) * (theta - 2) / 6 * a
            + (theta + 1) * (theta - 1) * (theta - 2) / 2 * b
            - (theta + 1) * theta * (theta - 2) / 2 * c
            + (theta + 1) * theta * (theta - 1) / 6 * d
        )
        places = np.concatenate([inner.reshape(-1, q.shape[1]), q[-1:]])
        t = self._time(done + np.arange(len(places)) / PARTS)
        gaps = self.gaps.many(t, places)[0]
        gaps[0] = np.maximum(gaps[0], 0.0)
        bad = gaps < 0.0
        if len(gaps) > 2:
            bad[1:-1] |= dips(gaps[:-2], gaps[1:-1], gaps[2:])
        where = np.flatnonzero(bad.any(axis=1))
        return max(0, (int(where[0]) - 1) // PARTS) if len(where) else None

    # ------------------------------------------------------------------------------------------ a step with impacts

    def _divided(self, state: np.ndarray, u: np.ndarray, step: int) -> tuple[np.ndarray, np.ndarray] | None:
        """The state and the unknowns after a step in which walls may be hit; None where it does not end."""
        at, first = 0.0, True
        while True:
            found = self._next(state, u, step + at, 1.0 - at)
            part = 1.0 - at if found is None else found[0]
            out, moved = self._part(state, u, step + at, part)
            if first:
                self._keep(out, step, 1)
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

    def _part(self, state: np.ndarray, u: np.ndarray, at: float, part: float) -> tuple[Outcome, tuple | None]:
        """A step of a part of the length; state and unknowns after it, None where it has no solution.

        The forces of constraints are lost in rounding in a very short step: one that is longer is solved then, and one back.
        """
        h = self.problem.h
        out = self._steps(state, u, self._time(at), (part or 1.0) * h, 1)
        if part == 0.0:
            return out, (state, u)
        if int(out.completed[0]):
            return out, (out.last_state[0], out.last_unknowns[0])
        if part < SHORT:
            there = self._steps(state, u, self._time(at), (part + BEYOND) * h, 1)
            if int(there.completed[0]):
                back = self._steps(there.last_state[0], there.last_unknowns[0], self._time(at + part + BEYOND), -BEYOND * h, 1)
                if int(back.completed[0]):
                    return there, (back.last_state[0], back.last_unknowns[0])
        return out, None

    def _bounced(self, state: np.ndarray, wall: int, at: float) -> tuple[np.ndarray, np.ndarray] | None:
        """The state after an impact, and a guess of the unknowns of the step that leaves it; None where the run ends there."""
        t, n = self._time(at), self.q.stop - self.q.start
        found = self.jumps[wall].one(t, state[self.q], state[self.p], self.problem.h)
        after, u, (speed, share) = found[:n], found[n:-2], found[-2:]
        number = self.numbers[wall]
        if not np.all(np.isfinite(found)) or share < 1e-12:
            why = "constraints hold it back" if share < 1e-12 else "its jump is not finite: L must be regular there"
            return self._end(f"events[{number}] was hit at t = {t:.6g}, and nothing can bounce off it: {why}")
        self.close = self.close + 1 if at - self.last < ACCUMULATED else 0
        self.last = at
        if self.close >= AGAIN or speed >= 0.0:
            return self._end(
                f"impacts on events[{number}] accumulate at t = {t:.6g} (Zeno), after {len(self.hits)} of them: what comes after "
                "is a motion on the wall, which can be run with a holonomic constraint"
            )
        state = state.copy()
        state[self.p] = after
        self.hits.append((t, number, state[self.q].copy(), after))
        return state, u

    def _end(self, message: str) -> None:
        self.message, self.status = message, NOT_CONVERGED
        return None

    def _next(self, state: np.ndarray, u: np.ndarray, at: float, rest: float) -> tuple[float, int] | None:
        """How long it is to the next impact within a rest of a step, and which wall is hit; None where none is."""
        here = self._gaps(state, at)
        values: dict[float, np.ndarray] = {0.0: np.where(here < ON_WALL * (1.0 + np.max(np.abs(state[self.q]))), 0.0, here)}

        def gap(part: float) -> np.ndarray:
            if part not in values:
                _, moved = self._part(state, u, at, part)
                values[part] = np.full(len(self.walls), np.nan) if moved is None else self._gaps(moved[0], at + part)
            return values[part]

        for k in range(1, PARTS + 1):
            gap(k * rest / PARTS)
        hits = [found for wall in range(len(self.walls)) if (found := self._hit(wall, gap, values)) is not None]
        return min(hits) if hits else None

    def _gaps(self, state: np.ndarray, at: float) -> np.ndarray:
        return self.gaps.one(self._time(at), state[self.q])

    def _hit(self, wall: int, gap: Any, values: dict[float, np.ndarray]) -> tuple[float, int] | None:
        """When a wall is hit, and the wall."""
        for _ in range(LEVELS):
            places = sorted(values)
            g = np.array([values[x][wall] for x in places])
            below = np.flatnonzero(g < 0.0)
            if len(below):
                break
            near = np.flatnonzero(dips(g[:-2], g[1:-1], g[2:])) + 1
            if not len(near):
                return None
            for i in near:
                for x in np.linspace(places[i - 1], places[i + 1], 2 * FINER + 1)[1:-1]:
                    gap(float(x))
        else:
            return None
        a, b = places[below[0] - 1], places[below[0]]
        while gap(a)[wall] <= 0.0:  # it begins on the wall: off it, and back in less than a part of a step?
            middle = (a + b) / 2.0
            a, b = (a, middle) if gap(middle)[wall] <= 0.0 else (middle, b)
            if b < SHORTEST:
                return 0.0, wall
        function = lambda x, _: np.array([gap(float(x[0]))[wall]])
        one = lambda x: np.array([x])
        return float(bracketed_roots(function, one(a), one(b), one(gap(a)[wall]), one(gap(b)[wall]))[0]), wall


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
        flight = Flight(walls, numbers, system, lane, run, *_functions(system, lane, walls))
        _refuse_behind(flight, number if p.batch is not None else None)
        ends.append(flight.fly())
        flights.append(flight)
    stack = lambda pick: np.stack([pick(flight) for flight in flights])
    fields = {name: stack(lambda flight, name=name: flight.rows[name]) for name in p.fields}
    done = np.array([end[0] for end in ends])
    seconds = time.perf_counter() - started
    sample = run(own[0].with_numbers(steps=1, save_every=1), None)
    outcome = Outcome(
        fields=fields,
        closing={name: np.stack([fields[name][i, done[i]] for i in range(lanes)]) for name in fields if p.is_node(name)},
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
    sol = solution_of(system, settings.scheme, begun.case, p, outcome, begun.row0, False, said)
    sol.impacts = _events(flights, p)
    return sol


def _functions(system: Any, p: Problem, walls: tuple[Impact, ...]) -> tuple[Numbers, list[Numbers]]:
    """The gaps at (t, q), and of every wall its jump at (t, q, p)."""
    n = p.equation.stages[0][0].state_layout["q"][0]
    t, q = np.zeros(()), np.zeros(n)
    gaps = lambda t, q, params: jnp.stack([jnp.asarray(wall(t, q, params), float) for wall in walls])
    own = tuple(map(Same, walls))
    stage = p.equation.stages[0][0]

    def jumped(wall: Impact) -> Any:
        def function(t, q, p, h, params):
            after, v, speed, share = jump(system, wall, q, p, t, params)
            _, u = stage.resume({"q": q, "p": after, "v": v, "t": t}, h, params)
            return after, u, speed, share

        return function

    key = "jump", Same(system), Same(p.equation)
    jumps = [Numbers(jumped(wall), [t, q, q, t], p.params, *key, own[i]) for i, wall in enumerate(walls)]
    return Numbers(gaps, [t, q], p.params, "gaps", *own), jumps


def check_walls(system: Any, p: Problem, walls: tuple[Impact, ...], numbers: tuple[int, ...]) -> None:
    """Raise `TypeError` and `ValueError` for walls that these steps cannot bounce off, and gaps that are none."""
    stages = p.equation.stages
    layout = stages[0][0].state_layout
    if system.lagrangian_form() is None or len(stages) > 1 or set(layout) - {"q", "p", "work"} or not {"q", "p"} <= set(layout):
        raise TypeError(
            "dx.Impact bounces Lagrangian systems in coordinates by schemes of one part whose state is (q, p), such as "
            "dx.LagrangeDAlembert(), dx.DiscreteDirac() and dx.Collocation(); this is "
            f"{type(system).__name__} with a {'composition' if len(stages) > 1 else 'state of ' + ', '.join(layout)}."
        )
    if p.first_step:
        raise ValueError("a run with dx.Impact starts from q= with v= or p=, not from two points.")
    t, q = jax.ShapeDtypeStruct((), jnp.float64), jax.ShapeDtypeStruct((layout["q"][0],), jnp.float64)
    own = jax.tree.map(lambda leaf: jnp.asarray(leaf)[0], p.params) if p.batch_params else p.params
    for wall, number in zip(walls, numbers, strict=True):
        try:
            found = jax.eval_shape(wall, t, q, own)
        except Exception as error:
            raise TypeError(
                f"the gap of events[{number}] could not be traced by JAX: {type(error).__name__}: "
                f"{(str(error).splitlines() or [''])[0]}"
            ) from error
        if not hasattr(found, "shape") or found.shape != ():
            came = f"shape {found.shape}: index or sum its result" if hasattr(found, "shape") else type(found).__name__
            raise ValueError(f"the gap of events[{number}] must return one number, but it returned {came}.")


def _refuse_behind(flight: Flight, lane: int | None) -> None:
    """Raise `ValueError` for a trajectory that begins behind a wall, by more than rounding."""
    state, whose = np.asarray(flight.problem.state), "" if lane is None else f" of trajectory {lane}"
    gaps = flight.gaps.one(flight.problem.t0, state[flight.q])
    for number, gap in zip(flight.numbers, gaps, strict=True):
        if not gap >= -1e-12 * (1.0 + np.max(np.abs(state[flight.q]))):
            raise ValueError(
                f"the gap of events[{number}] must not be negative at the start{whose}, but it is {gap:.6g}: begin in front "
                "of the wall, or change the sign of the gap."
            )


def _events(flights: list[Flight], p: Problem) -> Events:
    hits = [(lane, *hit) for lane, flight in enumerate(flights) for hit in flight.hits]
    n = p.equation.stages[0][0].state_layout["q"][0]
    array = lambda i, shape=(), kind=float: np.array([hit[i] for hit in hits], kind).reshape(len(hits), *shape)
    fields = {"q": array(3, (n,)), "p": array(4, (n,))}
    return Events(array(1), array(2, (), int), np.full(len(hits), -1), array(0, (), int), fields)
