"""A scheme whose steps say too what the functions of events are inside them: the engine computes these as it computes rows."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from dirax.run.event import Event, evaluated
from dirax.schemes.step import AbstractScheme, Field, Shape, StepEquation, StepSequence, make_step_equation
from dirax.solution.solution import Solution

VALUES = "event_values"
"""The field of a step in which they are saved, (events, points)."""

FEWEST_POINTS = 4
"""Points of a step at which a function is looked at, its beginning among them."""


def points_of(equation: Any) -> int:
    """At how many points of a step functions are looked at: more than the degree of its polynomial."""
    tableau = getattr(getattr(equation.stages[0][0], "collocation", None), "tableau", None)
    return max(FEWEST_POINTS, 0 if tableau is None else tableau.stages + 1)


class Watched(AbstractScheme):
    """A scheme with events that ask for what its polynomial says: not for the velocity. Others are as they were."""

    scheme: AbstractScheme
    events: tuple[tuple[int, Event], ...] = eqx.field(static=True)
    """The events with their numbers."""

    def step_equation(self, system: Any, shape: Shape) -> StepEquation | StepSequence:
        equation = make_step_equation(self.scheme, system, shape)
        if isinstance(equation, StepSequence) or equation.interpolate is None or not self.events:
            return equation
        about = Field((len(self.events), points_of(equation)), "step", ("event", "point"), "functions of events inside the step")
        unpack = Unpacked(equation, equation.interpolate, self.events)
        return replace(equation, unpack=unpack, fields={**equation.fields, VALUES: about})


class Unpacked:
    """`unpack` of an equation, with the values of events inside the step."""

    def __init__(self, equation: StepEquation, interpolate: Callable, events: tuple[tuple[int, Event], ...]):
        self.equation, self.interpolate, self.events = equation, interpolate, events

    def __call__(self, state, u, t, h, params) -> dict[str, Any]:
        row, points = self.equation.unpack(state, u, t, h, params), points_of(self.equation)
        places = [row, *(self.interpolate(k / points, u, state, t, h, params) for k in range(1, points))]
        values = [
            [evaluated(event, number, {**place, "t": t + k / points * h}, params) for k, place in enumerate(places)]
            for number, event in self.events
        ]
        return {**row, VALUES: jnp.stack([jnp.stack(row) for row in values])}


def without_values(sol: Solution, scheme: AbstractScheme) -> Solution:
    """The solution of a watched run as that of the scheme itself."""
    if VALUES not in sol.fields:
        return sol.replace(scheme=scheme)
    fields, about = ({name: a for name, a in of.items() if name != VALUES} for of in (sol.fields, sol.field_info))
    return sol.replace(fields=fields, field_info=about, scheme=scheme, equation=sol.equation.unpack.equation)
