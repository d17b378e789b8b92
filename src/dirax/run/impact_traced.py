"""A run with impacts whose values JAX traces, by JAX alone: each step with as many impacts in it as there may be, times and all
differentiated.

What a part of a step ends with, its length among it, is the root of the equations of the step and of the gap of the wall, and
has its derivative by the implicit function theorem: what comes after then has that of the saltation matrix, without a formula
for it. The search for the wall is not differentiated, and has the step in one place, for XLA compiles every copy of it.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from dirax.engines.contract import NOT_CONVERGED, OK, Outcome, Problem
from dirax.engines.in_jax import in_scalars
from dirax.engines.parameters import parameters
from dirax.engines.xla.lane import passing
from dirax.engines.xla.newton import as_function
from dirax.program.interpreter import UnsupportedPrimitive
from dirax.run.impact import Impact, gaps_of, jump, restitutions_of
from dirax.run.impact_on_host import FlightsOnHost
from dirax.run.result import solution_of
from dirax.run.step_parts import StepParts
from dirax.schemes.step import CLOCK, StepEquation
from dirax.schemes.watched_step import ON_WALL, PARTS, gap_terms
from dirax.solution.events import Events
from dirax.solution.solution import Solution
from dirax.solution.steps_again import sized_step

MOST = 4
"""Impacts in one step: with more of them a trajectory ends."""

HALVINGS = 60


@dataclass(frozen=True)
class TracedFlight:
    """One trajectory of a problem with walls."""

    walls: tuple[Impact, ...]
    numbers: tuple[int, ...]
    system: Any
    problem: Problem

    @property
    def equation(self) -> StepEquation:
        """That of the only part of a step."""
        return self.problem.equation.stages[0][0]

    def time(self, state, t):
        """The time at a state: t, but where steps have lengths of their own."""
        layout = self.equation.state_layout
        return state[layout.place(CLOCK)][0] if CLOCK in layout else t

    def gaps(self, t, state, params):
        """Of every wall, (walls,)."""
        return gaps_of(self.walls)(self.time(state, t), state[self.equation.state_layout.place("q")], params)

    def terms(self, t, state, others, params):
        """The sizes of the terms of every gap, as of `gap_terms`, at a state and `others` of its step that are finite."""
        q = self.equation.state_layout.place("q")
        places = [jnp.where(jnp.isfinite(other), other, state)[q] for other in others]
        return jax.lax.stop_gradient(gap_terms(gaps_of(self.walls), self.time(state, t), state[q], places, params))

    @property
    def written(self) -> StepEquation:
        """The same in scalars, where it is a scalar program."""
        return in_scalars(self.problem.equation, self.problem.params, False)[0].stages[0][0]

    def fly(self, state, u, params, t0, h):
        """Rows (steps + 1, …), impacts (steps, MOST, …) with NaN where there are none, the last state and its unknowns."""
        steps = self.problem.steps

        def step(carry, k):
            """The last row is that of one more step, which no wall is in and which is undone."""
            state, u = carry
            after, found = self._step(state, u, t0 + k * h, h, params, k == steps)
            return jax.tree.map(lambda a, b: jnp.where(k < steps, a, b), after, carry), found

        (state, u), (rows, hits) = jax.lax.scan(step, (state, u), jnp.arange(steps + 1, dtype=float))
        rows = {name: a if self.problem.is_node(name) else a[:steps] for name, a in rows.items()}
        return rows, jax.tree.map(lambda a: a[:steps], hits), state, u

    def _step(self, state, u, t, h, params, free):
        """One step with its impacts, or without any where it is `free` of them: what is carried on, and its row with them."""

        def part(carry, _):
            state, u, at, _ = carry
            end, wall, hit = self._next(*jax.lax.stop_gradient((state, u, t, at, h, params, begun[0])), free)
            there, of_part, length = self._part(end, wall, hit, state, t, at, h, params)
            at = jnp.where(hit, at + length, 1.0)
            bounced, guess = self._bounced(there, of_part, wall, t + at * h, h, params)
            state, u = jnp.where(hit, bounced, there), jnp.where(hit, guess, of_part)
            place = self.equation.state_layout.place
            here = self.time(state, t + at * h), self.number(wall), state[place("q")], state[place("p")]
            record = jax.tree.map(lambda a: jnp.where(hit, a, jnp.nan), here)
            return (state, u, at, ~hit), (record, of_part, length * h)

        def next_part(carry, _):
            shapes = jax.eval_shape(part, carry, None)[1]
            idle = jax.tree.map(lambda a: jnp.full(a.shape, jnp.nan), shapes)
            return jax.lax.cond(carry[3], lambda carry: (carry, idle), lambda carry: part(carry, None), carry)

        begun = (state, u, jnp.zeros(()), jnp.array(False))
        (after, then, _, ended), (hits, unknowns, lengths) = jax.lax.scan(next_part, begun, None, length=MOST + 1)
        solved = jnp.all(jnp.isfinite(unknowns[0])) & jnp.isfinite(lengths[0])
        row = self.equation.unpack(state, jnp.where(solved, unknowns[0], u), t, jnp.where(solved, lengths[0], h), params)
        return (jnp.where(ended, after, jnp.nan), then), (row, jax.tree.map(lambda a: a[:MOST], hits))

    def number(self, wall):
        """The place of a wall in `events=`."""
        return jnp.asarray(self.numbers, float)[wall]

    def _bounced(self, state, u, wall, t, h, params):
        """The state after an impact, and a guess of the unknowns after it."""
        of_walls = gaps_of(self.walls), restitutions_of(self.walls)
        own, restitution = (lambda t, q, params, of=of: of(t, q, params)[wall] for of in of_walls)
        after, guess, _, _ = jump(self.system, self.equation, own, restitution, state, self.time(state, t), h, params)
        return after, jax.lax.stop_gradient(guess)

    def _next(self, state, u, t, at, h, params, origin, free):
        """The end of the next part of a step that began at the state `origin`, which wall is hit there, and whether one is; in a
        `free` step none is."""
        places = jnp.arange(PARTS + 1) / PARTS * (1.0 - at)

        def seen(x):
            flies = x > 0.0
            step = state, (u,), t + at * h, jnp.where(flies, x, 1.0) * h, params
            after, (of_x,), _, (sizes,) = sized_step(self.problem.equation, *step, differentiable=False)
            there, of_x = jnp.where(flies, after, state), jnp.where(jnp.all(jnp.isfinite(after)), of_x, jnp.nan)
            return End(x, there, of_x, sizes, self.gaps(t + (at + x) * h, there, params))

        def bracket(ends):
            """Between two places, of walls that are in front of the first and behind the second; the last place where none is."""
            small = ON_WALL * self.terms(t + at * h, state, (ends.state[-1], origin), params)
            gaps = ends.gaps.at[0].set(jnp.where(ends.gaps[0] < small, 0.0, ends.gaps[0]))
            below = (gaps < -small[None]) & ~free
            behind = jnp.any(below, axis=1)
            last = jnp.where(jnp.any(behind), jnp.argmax(behind), PARTS)
            first, walls = jnp.maximum(last - 1, 0), below[last]
            nearest = lambda place: jnp.min(jnp.where(walls, gaps[place], jnp.inf))
            fall = Fall.between(places[first], nearest(first), places[last], nearest(last))
            return fall, jax.tree.map(lambda a: a[last], ends), walls

        def look(carry):
            k, ends, fall, end, walls = carry
            found = seen(jnp.where(k <= PARTS, places[jnp.minimum(k, PARTS)], fall.guess))
            ends = jax.tree.map(lambda a, x: a.at[k].set(x, mode="drop"), ends, found)
            value = jnp.min(jnp.where(walls, found.gaps, jnp.inf))
            nearer = jax.tree.map(lambda x, y: jnp.where(value > 0.0, y, x), found, end)
            ways = lambda: (fall, end, walls), lambda: bracket(ends), lambda: (fall.narrower(found.length, value), nearer, walls)
            return k + 1, ends, *jax.lax.switch(jnp.sign(k - PARTS) + 1, ways)

        nothing = jax.tree.map(lambda s: jnp.full(s.shape, jnp.nan), jax.eval_shape(seen, places[0]))
        ends = jax.tree.map(lambda a: jnp.broadcast_to(a, (PARTS + 1, *a.shape)), nothing)
        none = jnp.zeros(len(self.walls), bool)
        begun = 0, ends, Fall.between(*jnp.zeros(4)), nothing, none
        open_yet = lambda carry: (carry[0] <= PARTS) | (jnp.any(carry[4]) & carry[2].open)
        _, _, _, end, walls = jax.lax.while_loop(open_yet, look, begun)
        return end, jnp.argmin(jnp.where(walls, end.gaps, jnp.inf)), jnp.any(walls)

    def _part(self, end, wall, hit, state, t, at, h, params):
        """State, unknowns and length of a part of a step with this end, as functions of what it begins with."""
        stage, args = self.written, passing((state, t, at, h, params), jnp.all(jnp.isfinite(end.unknowns)))

        def moved(z, state, t, at, h, params):
            flies = z[-1] > 0.0
            step = z[:-1], state, t + at * h, jnp.where(flies, z[-1], 1.0) * h, params
            return step, jnp.where(flies, stage.advance(*step), state)

        def residual(z, state, t, at, h, params):
            step, there = moved(z, state, t, at, h, params)
            off = lambda: self.gaps(t + (at + z[-1]) * h, there, params)[wall]
            return jnp.append(stage.residual(*step), jax.lax.cond(hit, off, lambda: z[-1] - (1.0 - at)))

        z = as_function(residual, jnp.append(end.unknowns, end.length), args, sizes=jnp.append(end.sizes, 1.0))
        return moved(z, *args)[1], z[:-1], z[-1]


class End(NamedTuple):
    """The end of a part of a step: its length, the state, the unknowns and their sizes, and the gaps of all walls."""

    length: Any
    state: Any
    unknowns: Any
    sizes: Any
    gaps: Any


class Fall(NamedTuple):
    """The place between a, where a function is not negative, and b, where it is, through which it falls: by the rule of false
    position that halves the value of an end that stays (Illinois), off a place at which it begins with zero."""

    a: Any
    fa: Any
    b: Any
    fb: Any
    count: Any
    side: Any

    @classmethod
    def between(cls, a, fa, b, fb) -> "Fall":
        """Nothing is known but the ends."""
        return cls(a, fa, b, fb, jnp.zeros((), int), jnp.zeros((), int))

    @property
    def open(self):
        """Whether it can be narrowed down further."""
        return (self.b - self.a > 1e-15) & (self.fb < 0.0) & (self.count < HALVINGS + 40)

    @property
    def guess(self):
        """Where to look next."""
        a, fa, b, fb, _, _ = self
        guess = (a * fb - b * fa) / (fb - fa)
        return jnp.where((fa > 0.0) & (guess > a) & (guess < b), guess, 0.5 * (a + b))

    def narrower(self, x, fx) -> "Fall":
        """With the value at the guess."""
        a, fa, b, fb, count, side = self
        above = fx > 0.0
        start = ~above & (fa <= 0.0)  # it begins on the wall, and is behind it here
        fa = jnp.where(above, fx, jnp.where((side == -1) & ~above, 0.5 * fa, fa))
        fb = jnp.where(above, jnp.where(side == 1, 0.5 * fb, fb), fx)
        side = jnp.where(start, 0, jnp.where(above, 1, -1))
        return Fall(jnp.where(above, x, a), fa, jnp.where(above, b, x), fb, count + 1, side)


def bracketed_fall(function, a, fa, b, fb):
    """The place of a `Fall` of a function."""
    look = lambda fall: fall.narrower(fall.guess, function(fall.guess))
    return jax.lax.while_loop(lambda fall: fall.open, look, Fall.between(a, fa, b, fb)).b


def flown(
    system: Any, begun: Any, walls: tuple[Impact, ...], numbers: tuple[int, ...], on_host: bool
) -> tuple[Problem, Outcome, Any]:
    """Problem and outcome of a traced run with impacts, every row saved; and the given row 0 with what was hit: `on_host`, where
    that can be."""
    p = begun.problem
    lead = lambda a: jnp.asarray(a) if p.batch is not None else jnp.asarray(a)[None]
    if on_host and (found := _flown_on_host(system, p, walls, numbers, lead)):
        return p, found[0], (begun.row0, found[1])
    flight = TracedFlight(walls, numbers, system, p)
    of_params = lead if p.batch_params and p.batch is not None else lambda a: jnp.broadcast_to(a, (p.batch or 1, *jnp.shape(a)))
    t0, h = jnp.asarray(p.t0, float), jnp.asarray(p.h, float)
    given = lead(p.state), lead(p.guess[0]), jax.tree.map(lambda a: of_params(jnp.asarray(a)), p.params)
    one = lambda lane: flight.fly(lane[0], lane[1], lane[2], t0, h)
    rows, hits, last, unknowns = jax.jit(lambda given: jax.lax.map(one, given))(given)
    good = jnp.all(jnp.isfinite(last), axis=1)
    states = jnp.all(jnp.isfinite(rows["q"]), axis=-1)
    done = jnp.sum(jnp.cumprod(states, axis=1), axis=1) - 1
    outcome = Outcome(
        fields=rows,
        closing={name: a[:, -1] for name, a in rows.items() if p.is_node(name)},
        completed=jnp.where(good, p.steps, done),
        status=jnp.where(good, OK, NOT_CONVERGED),
        iterations=jnp.zeros(p.batch or 1, int),
        max_residual=jnp.zeros(p.batch or 1),
        last_state=last,
        last_unknowns=unknowns,
        engine="xla",
    )
    t, number, q, momentum = (a.reshape(a.shape[0], -1, *a.shape[3:]) for a in hits)
    order = jnp.argsort(jax.lax.stop_gradient(t), axis=1)  # NaN is last
    pick = lambda a: jnp.concatenate(jnp.take_along_axis(a, order.reshape(*order.shape, *(1,) * (a.ndim - 2)), axis=1))
    lanes = jnp.repeat(jnp.arange(p.batch or 1), order.shape[1])
    impacts = pick(t), pick(number), jnp.full(lanes.shape, -1), lanes, {"q": pick(q), "p": pick(momentum)}
    return p, outcome, (begun.row0, impacts)


def _flown_on_host(system: Any, p: Problem, walls: tuple, numbers: tuple, lead: Any) -> tuple[Outcome, tuple] | None:
    """Outcome and impacts by the host; None where JAX has to find them."""
    try:
        leaves = parameters(p.params, p.batch_params)
    except UnsupportedPrimitive:
        return None
    c = leaves.flatten(p.params, p.batch if p.batch_params else None, jnp)
    c = c if c.ndim == 2 else jnp.broadcast_to(c, (p.batch or 1, c.shape[0]))
    known = p.with_numbers(state=None, guess=None, params=None, h=None, t0=None)
    found = FlightsOnHost(StepParts(system, known, walls, leaves), numbers)(lead(p.state), lead(p.guess[0]), c, p.t0, p.h)
    if found is None:
        return None
    outcome, (t, number, known) = found
    lanes = jnp.repeat(jnp.arange(p.batch or 1), t.shape[1])
    whole = lambda a: a.reshape(-1, *a.shape[2:])
    return outcome, (whole(t), whole(number), jnp.full(lanes.shape, -1), lanes, {name: whole(a) for name, a in known.items()})


def flight_of(settings: Any, case: Any, problem: Problem, outcome: Outcome, more: Any) -> Solution:
    """The Solution of what `flown` gives. `sol.events` has MOST entries a step, in the order of time; those that there are not
    are NaN."""
    row0, impacts = more
    sol = solution_of(settings.system, settings.scheme, case, problem, outcome, row0, True)
    sol.events = sol.impacts = Events(*impacts)
    return sol
