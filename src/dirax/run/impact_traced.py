"""A run with impacts whose values JAX traces: each step with as many impacts in it as there may be, times and all differentiated.

The time of an impact is the root of the gap along the step, and has its derivative by the implicit function theorem: what
comes after then has that of the saltation matrix, without a formula for it.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from dirax.engines.contract import NOT_CONVERGED, OK, Outcome, Problem
from dirax.program.given_tangents import implicit
from dirax.run.impact import Impact, gaps_of, jump
from dirax.run.result import solution_of
from dirax.schemes.step import CLOCK, StepEquation
from dirax.schemes.watched_step import ON_WALL, PARTS, gap_terms
from dirax.solution.events import Events
from dirax.solution.solution import Solution
from dirax.solution.steps_again import stepped

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

    def moved(self, state, u, t, h, params):
        """The state after a step of length h and its unknowns; NaN where it has no solution."""
        after, (u,), _ = stepped(self.problem.equation, state, (u,), t, h, params)
        return after, u

    def fly(self, state, u, params, t0, h):
        """Rows (steps + 1, …), impacts (steps, MOST, …) with NaN where there are none, the last state and its unknowns."""
        step = lambda carry, k: self._step(carry[0], carry[1], t0 + k * h, h, params)
        (state, u), (rows, hits) = jax.lax.scan(step, (state, u), jnp.arange(self.problem.steps, dtype=float))
        t = t0 + self.problem.steps * h
        closing = self.equation.unpack(state, u, t, h, params)
        node = self.problem.is_node
        rows = {name: jnp.concatenate([a, closing[name][None]]) if node(name) else a for name, a in rows.items()}
        return rows, hits, state, u

    def _step(self, state, u, t, h, params):
        """One step with its impacts: what is carried on, and its row with them."""

        def part(carry, _):
            state, u, at, _ = carry
            theta, wall, hit = self._next(state, u, t, at, h, params, jax.lax.stop_gradient(begun[0]))
            length = jnp.where(hit, theta, 1.0 - at)
            there, of_part = self.moved(state, u, t + at * h, jnp.where(length > 0.0, length, 1.0) * h, params)
            there = jnp.where(length > 0.0, there, state)
            at = jnp.where(hit, at + theta, 1.0)
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
        row = self.equation.unpack(state, unknowns[0], t, lengths[0], params)
        return (jnp.where(ended, after, jnp.nan), then), (row, jax.tree.map(lambda a: a[:MOST], hits))

    def number(self, wall):
        """The place of a wall in `events=`."""
        return jnp.asarray(self.numbers, float)[wall]

    def _bounced(self, state, u, wall, t, h, params):
        """The state after an impact, and a guess of the unknowns after it."""

        def off(one: Impact):
            def function():
                after, guess, _, _ = jump(self.system, self.equation, one, state, self.time(state, t), h, params)
                return after, jax.lax.stop_gradient(guess)

            return function

        return jax.lax.switch(wall, [off(one) for one in self.walls])

    def _next(self, state, u, t, at, h, params, origin):
        """(θ, wall, whether there is one) of the next impact in what is left of a step that began at the state `origin`."""
        fixed, begun = jax.lax.stop_gradient((state, u, t, at, h, params)), jax.lax.stop_gradient(at)

        def seen(theta, values):
            state, u, t, at, h, params = values
            there, _ = self.moved(state, u, t + at * h, jnp.where(theta > 0.0, theta, 1.0) * h, params)
            there = jnp.where(theta > 0.0, there, state)
            return self.gaps(t + (at + theta) * h, there, params), there

        places = jnp.arange(PARTS + 1) / PARTS * (1.0 - begun)
        values, states = jax.lax.map(lambda theta: seen(theta, fixed), places)
        small = ON_WALL * self.terms(t + begun * h, fixed[0], (states[-1], origin), fixed[5])
        gaps = lambda theta, values: seen(theta, values)[0]
        values = values.at[0].set(jnp.where(values[0] < small, 0.0, values[0]))
        below = values < -small[None]
        first = jnp.argmax(below, axis=0)
        roots, finds = [], []
        for wall in range(len(self.walls)):
            of_wall = lambda theta, wall=wall: gaps(theta, fixed)[wall]
            found = jnp.any(below[:, wall])
            roots.append(jax.lax.cond(
                found,
                lambda i=first[wall], f=of_wall, g=values[:, wall]: bracketed_fall(f, places[i - 1], g[i - 1], places[i], g[i]),
                lambda: jnp.zeros(()),
            ))  # fmt: skip
            finds.append(found)
        roots, finds = jnp.stack(roots), jnp.stack(finds)
        wall = jnp.argmin(jnp.where(finds, roots, jnp.inf))
        hit = jnp.any(finds)

        def theta():
            residual = lambda root, values: gaps(root[0], values)[wall][None]
            return implicit(residual, roots[wall][None], (state, u, t, at, h, params), lambda a, b: b / a[0])[0]

        return jax.lax.cond(hit, theta, lambda: jnp.zeros(())), wall, hit


def bracketed_fall(function, a, fa, b, fb):
    """The place between a, where a function is not negative, and b, where it is, through which it falls: by the rule of false
    position that halves the value of an end that stays (Illinois), off a place at which it begins with zero."""

    def narrower(carry):
        a, fa, b, fb, count, side = carry
        guess = (a * fb - b * fa) / (fb - fa)
        x = jnp.where((fa > 0.0) & (guess > a) & (guess < b), guess, 0.5 * (a + b))
        fx = function(x)
        above = fx > 0.0
        start = ~above & (fa <= 0.0)  # it begins on the wall, and is behind it here
        fa = jnp.where(above, fx, jnp.where((side == -1) & ~above, 0.5 * fa, fa))
        fb = jnp.where(above, jnp.where(side == 1, 0.5 * fb, fb), fx)
        return jnp.where(above, x, a), fa, jnp.where(above, b, x), fb, count + 1, jnp.where(start, 0, jnp.where(above, 1, -1))

    def open_yet(carry):
        a, _, b, fb, count, _ = carry
        return (b - a > 1e-15) & (fb < 0.0) & (count < HALVINGS + 40)

    a, _, b, _, _, _ = jax.lax.while_loop(open_yet, narrower, (a, fa, b, fb, 0, 0))
    return b


def flown(system: Any, begun: Any, walls: tuple[Impact, ...], numbers: tuple[int, ...]) -> tuple[Problem, Outcome, Any]:
    """Problem and outcome of a traced run with impacts, every row saved; and the given row 0 with what was hit."""
    p = begun.problem
    flight = TracedFlight(walls, numbers, system, p)
    lead = lambda a: jnp.asarray(a) if p.batch is not None else jnp.asarray(a)[None]
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


def flight_of(settings: Any, case: Any, problem: Problem, outcome: Outcome, more: Any) -> Solution:
    """The Solution of what `flown` gives. `sol.events` has MOST entries a step, in the order of time; those that there are not
    are NaN."""
    row0, impacts = more
    sol = solution_of(settings.system, settings.scheme, case, problem, outcome, row0, True)
    sol.events = sol.impacts = Events(*impacts)
    return sol
