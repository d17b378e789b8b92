"""What makes the flights of the trajectories of a run with impacts."""

from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from dirax.engines.contract import Problem
from dirax.program.memo import Memo, Same, by_value
from dirax.run.flight import Flight, alerted, fields_beside
from dirax.run.impact import Impact, Numbers, gaps_of, jump, restitutions_of
from dirax.run.impact_search import ImpactSearch
from dirax.schemes.collision_step import CollisionStep
from dirax.schemes.step import StepEquation
from dirax.schemes.watched_step import ON_WALL, WatchedStep, gap_terms

BEHIND = 10.0 * ON_WALL
"""How far behind a wall, relative to the terms of its gap, a trajectory may begin: by rounding."""

_steps: Memo[tuple[StepEquation, StepEquation]] = Memo(64)


class Flights:
    """The flights of problems that differ in numbers alone from the one given here. `run` is the engine's for it."""

    def __init__(self, engine: Any, run: Any, system: Any, p: Problem, walls: tuple[Impact, ...], numbers: tuple[int, ...]):
        self.numbers, self.run, self.constrained = numbers, run, system.constraints.any
        stage, gaps, key = p.equation.stages[0][0], gaps_of(walls), (by_value(system), Same(p.equation))
        self.watched, self.collision = _steps.get(
            ("walls", *key, *walls),
            lambda: (
                WatchedStep(stage, system, gaps).equation(),
                CollisionStep(stage, system, gaps, restitutions_of(walls)).equation(),
            ),
        )
        t, q, state = np.zeros(()), np.zeros(stage.state_layout["q"][0]), np.asarray(p.state)
        self.gap = Numbers(gaps, [t, q], p.params, "gaps", *walls)
        sizes = lambda t, q, end, params: gap_terms(gaps, t, q, [end], params)
        self.terms = Numbers(sizes, [t, q, q], p.params, "terms of gaps", *walls)
        jumped = lambda wall: lambda state, t, h, params: jump(system, stage, wall, wall.restitution_at, state, t, h, params)
        self.jumps = [Numbers(jumped(wall), [state, t, t], p.params, "jump", *key, wall) for wall in walls]
        others = fields_beside(p)

        def row_of(state, u, t, h, params):
            row = stage.unpack(state, u, t, h, params)
            return jnp.concatenate([jnp.zeros(0), *(jnp.ravel(row[name]) for name in others)])

        self.row = Numbers(row_of, [state, np.asarray(p.guess[0]), t, t], p.params, "row", *key)
        many, _, hit = self._problems(p)
        self.watch, self.collide = engine.walks(many), engine.walks(hit)

    @property
    def by_programs(self) -> bool:
        """Whether nothing in them is computed by JAX, where the engine does not."""
        return all(numbers.program is not None for numbers in (self.gap, self.terms, self.row, *self.jumps))

    def _problems(self, p: Problem) -> tuple[Problem, Problem, Problem]:
        state, (u,) = alerted(p.state, 1.0), p.guess
        many = replace(p, equation=self.watched, state=state, save_every=1)
        hit = replace(p, equation=self.collision, state=state, guess=(np.append(u, 0.5),), save_every=1, steps=1)
        return many, many.with_numbers(steps=1), hit

    def __call__(self, p: Problem, most: float = np.inf) -> Flight:
        """The flight of a problem of one trajectory."""
        many, one, hit = self._problems(p)
        search = ImpactSearch(p, self.numbers, self.run, self.gap.of(p.params), self.terms.of(p.params))
        jumps = [one.of(p.params) for one in self.jumps]
        return Flight(search, jumps, self.watch(many), self.watch(one), self.collide(hit), self.row.of(p.params), most)


def behind(flight: Flight) -> str:
    """Why a flight must not begin: it does so behind a wall, by more than rounding, or where a gap is no number; else ""."""
    search, p = flight.search, flight.search.problem
    state = np.asarray(p.state)
    for wall, (number, gap) in enumerate(zip(search.numbers, search.gaps.one(p.t0, state[flight.q]), strict=True)):
        if not np.isfinite(gap):
            return f"the gap of events[{number}] must be finite along the run, but it is {gap} at the start{{}}."
        if gap < 0.0 and not gap >= -BEHIND * _terms(flight)[wall]:
            return (
                f"the gap of events[{number}] must not be negative at the start{{}}, but it is {gap:.6g}: begin in front "
                "of the wall, or change the sign of the gap."
            )
    return ""


def _terms(flight: Flight) -> np.ndarray:
    """The sizes of the terms of the gaps at the start, for the first step."""
    search, state = flight.search, np.asarray(flight.search.problem.state)
    end = search.part(state, np.asarray(search.problem.guess[0]), 0.0, 1.0)[1]
    return search.terms_at(state, end, 0.0)
