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

from dirax.engines.contract import Outcome
from dirax.engines.policy import engine_of
from dirax.program.given_tangents import with_tangent
from dirax.program.interpreter import UnsupportedPrimitive
from dirax.program.on_host import called_on_host
from dirax.run.flight import fields_beside
from dirax.run.flights import Flights
from dirax.run.flown_parts import Flown, flown, recording
from dirax.run.step_parts import StepParts
from dirax.schemes.step import CLOCK, PART, STEP_DENSITY


class FlightsOnHost:
    """Finds the trajectories of problems that differ in numbers alone from that of the `parts`; `numbers` are the places of its
    walls in `events=`."""

    def __init__(self, parts: StepParts, numbers: tuple[int, ...]):
        self.parts, self.numbers = parts, numbers
        p, stage, self.native = parts.problem, parts.stage, engine_of("native")
        self.example = replace(
            p, equation=recording(stage), state=np.zeros(stage.state_size), guess=(np.zeros(stage.unknowns),),
            params=parts.leaves.split(np.ones(parts.leaves.size)), t0=0.0, h=1.0, batch=None, batch_params=False,
        )  # fmt: skip

    @cached_property
    def flights(self) -> Flights:
        """By the native engine. Raises `UnsupportedPrimitive` for what is no scalar program."""
        example, parts = self.example, self.parts
        made = Flights(self.native, self.native.prepared(example), parts.system, example, parts.walls, self.numbers)
        if not made.by_programs:
            raise UnsupportedPrimitive("the gap of a wall", "has no scalar program", "")
        return made

    def _flown(self, given: np.ndarray) -> list[np.ndarray]:
        """The arrays of `Flown`, one row for each of several trajectories: their states, guesses, params, t0 and h."""
        leaves, stage = self.parts.leaves, self.parts.stage
        found: list[list[np.ndarray]] = []
        for numbers in np.asarray(given):
            state, u, c, (t0, h) = np.split(numbers, np.cumsum([stage.state_size, stage.unknowns, leaves.size]))
            own = self.example.with_numbers(state=state, guess=(u,), params=leaves.split(c), t0=float(t0), h=float(h))
            found.append([a.ravel() for a in flown(self.flights, own)])
        return [np.stack(a) for a in zip(*found, strict=True)]

    def __call__(self, state: Any, guess: Any, c: Any, t0: Any, h: Any) -> tuple[Outcome, tuple] | None:
        """Outcome and impacts, (times, numbers, fields), of arrays (B, …), `c` the numbers of params; of impacts there are MOST
        places a step, in the order of time and NaN where there are none. None where the steps, or what is differentiated, have no
        scalar program."""
        try:
            if not (self.parts.have_programs and self.flights):
                return None
        except UnsupportedPrimitive:
            return None
        batch = len(state)
        clock = jnp.broadcast_to(jnp.stack([jnp.asarray(t0, float), jnp.asarray(h, float)]), (batch, 2))
        shapes = Flown.shapes(self.parts.stage, self.example.steps)
        found = called_on_host(self._flown, [*map(math.prod, shapes)], jnp.concatenate([state, guess, c, clock], axis=1))
        told = Flown(*(a.reshape(batch, *shape) for a, shape in zip(found, shapes, strict=True)))
        run = Trajectories(self.parts, told, state, clock, c)
        t, walls, known = run.impacts()
        return run.outcome(), (t, jnp.asarray(self.numbers, float)[walls], known)


@dataclass(frozen=True, eq=False)
class Trajectories:
    """Trajectories that are known as numbers, with their derivatives by the first states (B, s), the `clock` (B, 2) of t0 and h,
    and the numbers of params (B, ·)."""

    parts: StepParts
    told: Flown
    begun: Any
    clock: Any
    c: Any

    @cached_property
    def states(self) -> Any:
        """That each part leaves and how much of the step is over there (B, P + 1, s + 1)."""
        parts, told = self.parts, self.told

        def tangent(states, operands, along):
            marks, known, _, others = operands[1:]
            after = lambda x: parts(marks, known, x)[0]
            x = jnp.concatenate([states[:, :-1], others], axis=-1)
            size, width = states.shape[-1], x.shape[-1]
            moved = lambda by: jax.jvp(after, (x,), (by,))[1]
            slopes = jax.vmap(lambda unit: moved(jnp.broadcast_to(unit, x.shape)))(jnp.eye(size, width))
            of_begun, of_others = along[-2:]
            first, added = jnp.zeros_like(states[:, 0]) if of_begun is None else of_begun, jnp.zeros_like(states[:, :-1])
            if of_others is not None:
                added = moved(jnp.concatenate([added, of_others], axis=-1))

            def following(before, part):
                slopes, added = part
                found = jnp.einsum("jbi,bj->bi", slopes, before) + added
                return found, found

            over = jnp.moveaxis(slopes, 2, 0), jnp.moveaxis(added, 1, 0)
            return jnp.concatenate([first[:, None], jnp.moveaxis(jax.lax.scan(following, first, over)[1], 0, 1)], axis=1)

        fixed = jax.lax.stop_gradient((told.states, told.marks, told.known))
        begun, others = jnp.pad(self.begun, ((0, 0), (0, 1))), self._at(told.number)
        return with_tangent(lambda states, *_: states, tangent, *fixed, begun, others)

    def _at(self, number: Any) -> Any:
        """What steps of these numbers (B, R) depend on besides their states: t, h and params (B, R, ·)."""
        t0, h = self.clock[:, :1], self.clock[:, 1:]
        times = jnp.stack([t0 + number * h, jnp.broadcast_to(h, number.shape)], axis=-1)
        return jnp.concatenate([times, jnp.broadcast_to(self.c[:, None], (*number.shape, self.c.shape[1]))], axis=-1)

    def outcome(self) -> Outcome:
        """With the fields of all rows."""
        told, parts, steps = self.told, self.parts, self.parts.problem.steps
        first = _pick(self.states, jnp.nan_to_num(told.first)).at[..., -1].set(0.0)  # a step that does not end begins there too
        numbers = jnp.broadcast_to(jnp.arange(steps + 1.0), told.first.shape)
        x, there = jnp.concatenate([first, self._at(numbers)], axis=-1), jnp.isfinite(told.first)
        rows = parts(told.row_marks, told.row_known, x)[1]
        unsolved = there & jnp.all(jnp.isnan(told.row_marks), axis=-1)
        u = jnp.broadcast_to(told.closing[:, None], (*there.shape, told.closing.shape[1]))
        rows = jnp.where(unsolved[..., None], parts.rows_at(jnp.where(unsolved, 1.0, jnp.nan), u, x), rows)
        done, fields = told.table[:, 0], parts.fields(rows)
        for name, values in fields.items():
            if not parts.problem.is_node(name):
                fields[name] = _where(numbers[:, :-1] < done[:, None], values[:, :-1])
        return Outcome(
            fields=fields,
            closing={},
            completed=done.astype(int),
            status=told.table[:, 1].astype(int),
            iterations=told.table[:, 2].astype(int),
            max_residual=told.table[:, 3],
            last_state=_pick(first, done[:, None])[:, 0, :-1],
            last_unknowns=told.closing,
            engine="native",
        )

    def impacts(self) -> tuple[Any, Any, dict[str, Any]]:
        """Times, walls and fields (B, H, …), NaN where there is no impact."""
        told, parts, layout = self.told, self.parts, self.parts.stage.state_layout
        hit, index = jnp.isfinite(told.hit), jnp.nan_to_num(told.hit)
        after, number = _pick(self.states, index + 1.0), _pick(told.number[..., None], index)[..., 0]
        t = self.clock[:, :1] + (number + after[..., -1]) * self.clock[:, 1:]
        known = {name: after[..., layout.place(name)] for name in ("q", "p")}
        if CLOCK in layout:
            known |= {name: after[..., layout.place(name)][..., 0] for name in (STEP_DENSITY, CLOCK)} | {PART: after[..., -1]}
            t = known[CLOCK]
        if others := fields_beside(parts.problem):
            x = jnp.concatenate([after, self._at(number).at[..., 0].set(t)], axis=-1)
            beside = parts.fields(parts.rows_at(jnp.where(hit, 1.0, jnp.nan), told.leaving, x))
            known |= {name: beside[name] for name in others}
        walls = _pick(told.known[..., -2:-1], index)[..., 0].astype(int)
        return _where(hit, t), walls, {name: _where(hit, a) for name, a in known.items()}


def _pick(a: Any, index: Any) -> Any:
    """The entries of an array (B, P, …) of these numbers (B, R)."""
    return jnp.take_along_axis(a, index[..., None].astype(int), axis=1)


def _where(there: Any, a: Any) -> Any:
    """Arrays (B, R, …), NaN in the rows that are not there."""
    return jnp.where(there.reshape(*there.shape, *(1,) * (a.ndim - 2)), a, jnp.nan)
