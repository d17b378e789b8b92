"""A flight as arrays of numbers: the parts of its steps, which have derivatives, and where rows and impacts are among them."""

from dataclasses import replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from dirax.engines.contract import Problem
from dirax.program.memo import Memo, Same
from dirax.run.flight import Flight, Part
from dirax.run.flights import Flights, behind
from dirax.schemes.step import Field, RowAtState, StepEquation
from dirax.schemes.watched_step import NONE

MOST = 4
"""Impacts a step, of all steps together: with more of them a trajectory ends."""

SHORTEST, SHORTEST_CONSTRAINED = 1e-14, 1e-8
"""Parts of a step: what is shorter is differentiated as if it were as long, up to so much of the derivative. Forces of
constraints are lost in a step like ε over its length."""

LONGER = 1e-6, 1e-4, 1e-2, 1.0
"""What is taken where that has no solution."""

_recordings: Memo[StepEquation] = Memo(64)


def recording(equation: StepEquation) -> StepEquation:
    """The equation with its state, its unknowns and its length for rows; the same object for the same equation."""
    fields = {
        "state": Field((equation.state_size,)),
        "unknowns": Field((equation.unknowns,), "step"),
        "length": Field((), "step"),
    }
    unpack = lambda state, u, t, h, params: {"state": state, "unknowns": u, "length": jnp.asarray(h, float)}

    def resume(data, h, params):
        row = lambda: equation.unpack(data["state"], jnp.zeros(equation.unknowns), data["t"], h, params)
        return equation.resume(RowAtState(data, row), h, params)

    return _recordings.get(Same(equation), lambda: replace(equation, unpack=unpack, fields=fields, resume=resume))


class Flown(NamedTuple):
    """A trajectory of so many `steps`, a state of s numbers and k unknowns: P parts, (1 + MOST) × steps, of which the first ones
    are there; rows, steps + 1; and H impacts, MOST × steps.

    A mark is a number where a part or a row is one of a free flight, in the first column, or of a flight onto a wall, in the
    second, then the length of it; else NaN. What is `known` are its unknowns, the number of the wall, and by how much it is
    longer than the rest of the step that it stands for.
    """

    states: Any
    """(P + 1, s + 1): that a part leaves, and how much of the step is over there."""
    number: Any
    """(P,): of the step of each part."""
    marks: Any
    known: Any
    """(P, 2), (P, k + 2)."""
    first: Any
    """(steps + 1,): which part leaves a row; NaN after the last row."""
    row_marks: Any
    row_known: Any
    """(steps + 1, …): of the step that says what the rest of a row is. The last row has no mark where it has no solution."""
    hit: Any
    """(H,): which parts end on a wall, in order, then NaN."""
    leaving: Any
    """(H, k): guesses of the unknowns after an impact."""
    closing: Any
    """(k,): and after the last good step."""
    table: Any
    """(4,): good steps, status, updates of Newton's method, the largest residual that was left."""

    @staticmethod
    def shapes(equation: StepEquation, steps: int) -> list[tuple[int, ...]]:
        """Those of its arrays."""
        s, k, parts, rows, hits = equation.state_size, equation.unknowns, (1 + MOST) * steps, steps + 1, MOST * steps
        of_parts = [(parts + 1, s + 1), (parts,), (parts, 2), (parts, k + 2)]
        return [*of_parts, (rows,), (rows, 2), (rows, k + 2), (hits,), (hits, k), (k,), (4,)]


def flown(flights: Flights, p: Problem) -> Flown:
    """The trajectory of a problem whose equation is a `recording`."""
    flight = flights(p, most=MOST * p.steps)
    if refused := behind(flight):
        flight.refuse(refused)
    else:
        flight.fly()
    if flight.interrupted:
        raise KeyboardInterrupt
    return _as_arrays(flight, p, SHORTEST_CONSTRAINED if flights.constrained else SHORTEST)


def _as_arrays(flight: Flight, p: Problem, shortest: float) -> Flown:
    stage, done = p.equation.stages[0][0], flight.done
    found = Flown(*(np.full(shape, np.nan) for shape in Flown.shapes(stage, p.steps)))
    found.states[:], found.number[:], found.known[:], found.row_known[:] = 0.0, 0.0, 0.0, 0.0
    found.leaving[:] = 0.0
    parts: dict[int, list[Part]] = {}
    for part in flight.parts:
        parts.setdefault(part.step, []).append(part)
    counts = np.ones(done + 1, int)
    counts[done] = 0
    for step, own in parts.items():
        counts[step] = len(own)
    ends = np.cumsum(counts)
    first, used = ends - counts, int(ends[-1])
    found.first[: done + 1] = first
    # steps that are not divided, and the rows
    state, unknowns = flight.rows["state"], flight.rows["unknowns"]
    found.states[first[:done], :-1] = state[:done]
    found.number[first[:done]], found.marks[first[:done], 0] = np.arange(done), 1.0
    found.known[first[:done], :-2], found.row_known[:done, :-2] = unknowns[:done], unknowns[:done]
    length = flight.rows["length"][:done] / p.h
    found.row_marks[:done, 0], found.row_known[:done, -1] = 1.0, length - 1.0
    # the others
    after, at = flight.state, 0.0
    for step, own in parts.items():
        for place, part in enumerate(own, start=int(first[step])):
            found.states[place, :-1], found.states[place, -1], found.number[place] = part.state, part.at, step
            u, taken = _solved(flight, part, shortest)
            found.marks[place] = (1.0, np.nan) if part.wall == NONE else (np.nan, taken)
            found.known[place] = (*u, part.wall, 0.0 if taken == part.length else taken - part.length)
        begins = own[0]
        if step < done and begins.wall != NONE and abs(length[step] - begins.length) < 1e-12 * begins.length:
            found.row_marks[step], found.row_known[step, -2:] = (np.nan, begins.length), (begins.wall, 0.0)
        if step == done:  # which does not end
            after, at = own[-1].after, own[-1].at + own[-1].length
    found.states[used, :-1], found.states[used, -1] = after, at
    if flight.leaving is not None:
        found.row_marks[done, 0], found.row_known[done, :-2] = 1.0, flight.leaving
    hits = [part for part in flight.parts if part.wall != NONE]
    found.hit[: len(hits)] = np.flatnonzero(np.isfinite(found.marks[:, 1]))
    if hits:
        found.leaving[: len(hits)] = [part.leaving for part in hits]
    found.closing[:] = flight.unknowns
    found.table[:] = done, flight.status, flight.iterations, flight.max_residual
    return found


def _solved(flight: Flight, part: Part, shortest: float) -> tuple[np.ndarray, float]:
    """The unknowns of a part that is long enough, and how long that is."""
    if part.length >= shortest:
        return part.unknowns, part.length
    for length in (shortest, *LONGER):
        out = flight.search.steps(part.state, part.unknowns, part.step + part.at, length)
        if int(out.completed[0]):
            return out.last_unknowns[0], length
    return part.unknowns, part.length
