"""Runs with impacts that JAX traces, by flights of the host: walls are found as in any other run, parts of steps differentiated.

A run is the parts of its steps: each leads from one state to the next one, onto a wall and off it or to the end of the step. The
host finds them as numbers. Their derivatives are those of the root of all their equations at once, each of which has two states
in it: one evaluation of every part, and a linear recurrence.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.engines.contract import Outcome, Problem
from dirax.engines.parameters import Parameters, parameters
from dirax.engines.policy import engine_of
from dirax.engines.xla.newton import as_function
from dirax.program.given_tangents import with_tangent
from dirax.program.interpreter import UnsupportedPrimitive
from dirax.program.memo import Same, by_value
from dirax.program.on_host import called_on_host, host_program, on_host
from dirax.run.flight import fields_beside
from dirax.run.flights import Flights
from dirax.run.flown_parts import Flown, flown, recording
from dirax.run.impact import Impact, gaps_of, jump
from dirax.schemes.step import CLOCK, PART, STEP_DENSITY, StepEquation

MARK = 2
"""Arguments of a part that are known as numbers: a mark, and what is known of it."""


def _where(there: Any, a: Any) -> Any:
    """Arrays (B, R, …), NaN in the rows that are not there."""
    return jnp.where(there.reshape(*there.shape, *(1,) * (a.ndim - 2)), a, jnp.nan)


@dataclass(frozen=True, eq=False)
class FlightsOnHost:
    """The trajectories of problems that differ in numbers alone from this one, of which nothing but shapes is known here."""

    system: Any
    problem: Problem
    walls: tuple[Impact, ...]
    numbers: tuple[int, ...]

    @cached_property
    def stage(self) -> StepEquation:
        """That of the only part of a step."""
        return self.problem.equation.stages[0][0]

    @cached_property
    def leaves(self) -> Parameters:
        """How params are numbers."""
        return parameters(self.problem.params, self.problem.batch_params)

    @cached_property
    def key(self) -> tuple:
        """Equal for equal equations, walls and kinds of params."""
        return by_value(self.system), Same(self.stage), *self.walls, self.leaves.key

    # ------------------------------------------------------------------------------------------ what is found by the host

    @cached_property
    def flights(self) -> Flights:
        """By the native engine. Raises `UnsupportedPrimitive` for what is no scalar program."""
        p, native = self.problem, engine_of("native")
        params = self.leaves.split(np.ones(self.leaves.size))
        example = replace(
            p, equation=recording(self.stage), state=np.zeros(self.stage.state_size), guess=(np.zeros(self.stage.unknowns),),
            params=params, t0=0.0, h=1.0, batch=None, batch_params=False,
        )  # fmt: skip
        made = Flights(native, native.prepared(example), self.system, example, self.walls, self.numbers)
        if not made.by_programs:
            raise UnsupportedPrimitive("the gap of a wall", "has no scalar program", "")
        return made

    def _flown(self, given: np.ndarray) -> list[np.ndarray]:
        """The arrays of `Flown`, one row for each of several trajectories: their states, guesses, params, t0 and h."""
        sizes = self.stage.state_size, self.stage.unknowns, self.leaves.size
        found: list[list[np.ndarray]] = []
        for numbers in np.asarray(given):
            state, u, c, (t0, h) = np.split(numbers, np.cumsum(sizes))
            own = replace(
                self.problem, equation=recording(self.stage), state=state, guess=(u,), params=self.leaves.split(c),
                t0=float(t0), h=float(h), batch=None, batch_params=False,
            )  # fmt: skip
            found.append([a.ravel() for a in flown(self.flights, own)])
        return [np.stack(a) for a in zip(*found, strict=True)]

    # ------------------------------------------------------------------------------------------ a part of a step

    def _split(self, x: Any) -> tuple:
        """(state, part of the step that is over, t, h, params) of the numbers that a part depends on."""
        s = self.stage.state_size
        return x[:s], x[s], x[s + 1], x[s + 2], self.leaves.split(x[s + 3 :])

    def _row(self, state, u, t, h, params) -> Any:
        row = self.stage.unpack(state, u, t, h, params)
        return jnp.concatenate([jnp.ravel(row[name]) for name in self.problem.fields])

    def free(self, mark, known, x) -> tuple[Any, Any]:
        """Where the rest of a step leads, and its row."""
        state, at, t, h, params = self._split(x)
        args = state, t + at * h, (1.0 - at + known[-1]) * h, params
        u = as_function(self.stage.residual, known[:-2], args)
        return jnp.append(self.stage.advance(u, *args), 0.0), self._row(state, u, *args[1:])

    def onto_wall(self, length, known, x) -> tuple[Any, Any]:
        """Where a part leads that ends on a wall, and is of this length, and the row at its beginning."""
        stage, gaps, place = self.stage, gaps_of(self.walls), self.stage.state_layout.place
        of_wall = lambda values: sum(jnp.where(known[-2] == i, values[i], 0.0) for i in range(len(self.walls)))
        time = lambda there, t: there[place(CLOCK)][0] if CLOCK in stage.state_layout else t
        step = lambda z, state, at, t, h, params: (z[:-1], state, t + at * h, z[-1] * h, params)

        def residual(z, state, at, t, h, params):
            args = step(z, state, at, t, h, params)
            there = stage.advance(*args)
            gap = of_wall(gaps(time(there, t + (at + z[-1]) * h), there[place("q")], params))
            return jnp.append(stage.residual(*args), gap)

        args = state, at, t, h, params = self._split(x)
        z = as_function(residual, jnp.append(known[:-2], length), args)
        there, over = stage.advance(*step(z, *args)), at + z[-1]
        own, restitution = lambda t, q, params: of_wall(gaps(t, q, params)), of_wall([wall.restitution for wall in self.walls])
        after = jump(self.system, stage, own, restitution, there, time(there, t + over * h), h, params)[0]
        return jnp.append(after, over), self._row(state, z[:-1], t + at * h, z[-1] * h, params)

    def as_it_is(self, mark, u, x) -> Any:
        """The row at a state, of given unknowns."""
        state, _, t, h, params = self._split(x)
        return self._row(state, u, t, h, params)

    def _has_programs(self, count: int) -> bool:
        """Whether the parts are scalar programs, which so many params are numbers of."""
        s, k = self.stage.state_size, self.stage.unknowns
        shape = lambda *sizes: jax.ShapeDtypeStruct(sizes, np.float64)
        kinds = (self.free, k + 2), (self.onto_wall, k + 2), (self.as_it_is, k)
        try:
            if any(
                host_program(part, [shape(), shape(known), shape(s + 3 + count)], self._key(part), MARK) is None
                for part, known in kinds
            ):
                return False
            return bool(self.flights)
        except UnsupportedPrimitive:
            return False

    def _key(self, part: Any) -> tuple:
        return part.__name__, *self.key

    def _of_entries(self, part: Any, mark: Any, known: Any, x: Any) -> Any:
        """A part of all entries (…), of which those without a mark are NaN, with derivatives of zero."""
        lead = mark.shape
        found = on_host(part, [a.reshape(mark.size, *a.shape[len(lead) :]) for a in (mark, known, x)], self._key(part), MARK)
        return jax.tree.map(lambda a: a.reshape(*lead, *a.shape[1:]), found)

    def _parts(self, marks: Any, known: Any, x: Any) -> tuple[Any, Any]:
        """(states after, rows) of parts (…): free, or onto a wall."""
        free, onto = (self._of_entries(part, marks[..., i], known, x) for i, part in enumerate((self.free, self.onto_wall)))
        hits = jnp.isfinite(marks[..., 1:])
        either = [jnp.where(hits, b, a) for a, b in zip(free, onto, strict=True)]
        return either[0], either[1]

    # ------------------------------------------------------------------------------------------ all of them

    def __call__(self, state: Any, guess: Any, c: Any, t0: Any, h: Any) -> tuple[Outcome, tuple] | None:
        """Outcome and impacts of arrays (B, …), `c` the numbers of params; of impacts there are MOST places a step, in the order
        of time and NaN where there are none. None where the steps, or what is differentiated, have no scalar program."""
        if not self._has_programs(c.shape[1]):
            return None
        batch, steps, s, layout = len(state), self.problem.steps, self.stage.state_size, self.stage.state_layout
        clock = jnp.broadcast_to(jnp.stack([jnp.asarray(t0, float), jnp.asarray(h, float)]), (batch, 2))
        shapes = Flown.shapes(self.stage, steps)
        found = called_on_host(self._flown, [*map(math.prod, shapes)], jnp.concatenate([state, guess, c, clock], axis=1))
        told = Flown(*(a.reshape(batch, *shape) for a, shape in zip(found, shapes, strict=True)))

        def with_numbers(states: Any, number: Any) -> Any:
            """What steps of these numbers depend on: their states, t, h and params."""
            t0, h = clock[:, :1], clock[:, 1:]
            times = jnp.stack([t0 + number * h, jnp.broadcast_to(h, number.shape)], axis=-1)
            own = jnp.broadcast_to(c[:, None], (*number.shape, c.shape[1]))
            return jnp.concatenate([states, times, own], axis=-1)

        no_states = jnp.zeros((batch, told.number.shape[1], 0))
        states = self._states(told, jnp.pad(state, ((0, 0), (0, 1))), with_numbers(no_states, told.number))
        pick = lambda a, index: jnp.take_along_axis(a, index[..., None].astype(int), axis=1)

        numbers = jnp.broadcast_to(jnp.arange(steps + 1.0), told.first.shape)
        first = pick(states, jnp.nan_to_num(told.first))
        x = with_numbers(jnp.concatenate([first[..., :s], jnp.zeros((batch, steps + 1, 1))], axis=-1), numbers)
        rows = self._parts(told.row_marks, told.row_known, x)[1]
        unsolved = jnp.where(jnp.isfinite(told.first) & jnp.all(jnp.isnan(told.row_marks), axis=-1), 1.0, jnp.nan)
        u = jnp.broadcast_to(told.closing[:, None], (*unsolved.shape, told.closing.shape[1]))
        rows = jnp.where(jnp.isfinite(unsolved)[..., None], self._of_entries(self.as_it_is, unsolved, u, x), rows)
        done = told.table[:, 0]
        good, fields = numbers[:, :-1] < done[:, None], self._fields(rows)
        for name in fields:
            if not self.problem.is_node(name):
                fields[name] = _where(good, fields[name][:, :-1])

        hit = jnp.isfinite(told.hit)
        index = jnp.nan_to_num(told.hit)
        after, number = pick(states, index + 1.0), jnp.take_along_axis(told.number, index.astype(int), axis=1)
        walls = jnp.take_along_axis(told.known[..., -2], index.astype(int), axis=1)
        x = with_numbers(after, number)
        t = clock[:, :1] + (number + after[..., s]) * clock[:, 1:]
        known = {name: after[..., layout.place(name)] for name in ("q", "p")}
        if CLOCK in layout:
            known |= {name: after[..., layout.place(name)][..., 0] for name in (STEP_DENSITY, CLOCK)} | {PART: after[..., s]}
            t = known[CLOCK]
        if others := fields_beside(self.problem):
            x = x.at[..., s + 1].set(t)
            beside = self._fields(self._of_entries(self.as_it_is, jnp.where(hit, 1.0, jnp.nan), told.leaving, x))
            known |= {name: beside[name] for name in others}
        which = jnp.asarray(self.numbers, float)[walls.astype(int)]
        impacts = jax.tree.map(lambda a: _where(hit, a), (t, which, known))
        last = jnp.take_along_axis(first, done[:, None, None].astype(int), axis=1)[:, 0, :s]
        outcome = Outcome(
            fields=fields,
            closing={},
            completed=done.astype(int),
            status=told.table[:, 1].astype(int),
            iterations=told.table[:, 2].astype(int),
            max_residual=told.table[:, 3],
            last_state=last,
            last_unknowns=told.closing,
            engine="native",
        )
        return outcome, impacts

    def _fields(self, rows: Any) -> dict[str, Any]:
        """The fields of rows (B, R, ·)."""
        sizes = [math.prod(field.shape) for field in self.problem.fields.values()]
        parts = jnp.split(rows, np.cumsum(sizes)[:-1].tolist(), axis=-1)
        named = zip(self.problem.fields.items(), parts, strict=True)
        return {name: part.reshape(*part.shape[:2], *field.shape) for (name, field), part in named}

    def _states(self, told: Flown, begun: Any, others: Any) -> Any:
        """The states (B, P + 1, ·) that parts lead to, with their derivatives by the first one (B, ·), and by the `others` that
        parts depend on (B, P, ·)."""
        known = told.marks, told.known

        def tangent(states, operands, along):
            marks, known, _, others = operands[1:]
            after = lambda x: self._parts(marks, known, x)[0]
            x = jnp.concatenate([states[:, :-1], others], axis=-1)
            size, width = states.shape[-1], x.shape[-1]
            moved = lambda by: jax.jvp(after, (x,), (by,))[1]
            slopes = jax.vmap(lambda unit: moved(jnp.broadcast_to(unit, x.shape)))(jnp.eye(size, width))
            of_begun, of_others = along[-2:]
            first = jnp.zeros_like(states[:, 0]) if of_begun is None else of_begun
            added = jnp.zeros_like(states[:, :-1])
            if of_others is not None:
                added = moved(jnp.concatenate([jnp.zeros_like(states[:, :-1]), of_others], axis=-1))

            def following(before, part):
                slopes, added = part
                found = jnp.einsum("jbi,bj->bi", slopes, before) + added
                return found, found

            over = jnp.moveaxis(slopes, 2, 0), jnp.moveaxis(added, 1, 0)
            return jnp.concatenate([first[:, None], jnp.moveaxis(jax.lax.scan(following, first, over)[1], 0, 1)], axis=1)

        fixed = jax.lax.stop_gradient((told.states, *known))
        return with_tangent(lambda states, *_: states, tangent, *fixed, begun, others)
