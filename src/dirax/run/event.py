"""Event: a function of the motion whose zeros are looked for along a run."""

import inspect
from collections.abc import Callable, Collection, Sequence
from copy import copy
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import Tracer

from dirax.program.hoisted import hoisted, split
from dirax.program.memo import OfKey
from dirax.program.signatures import signature
from dirax.program.stated import as_stated
from dirax.program.user_functions import reads_outside
from dirax.text.representation import error_text, value_text

KNOWN = ("t", "q", "v", "p", "x", "params")
"""What a function of an event may be given, by the names of its arguments."""

TRACED = (
    "dx.Event is not looked for beside dx.Impact under jax.grad, jit and vmap, between the rows of steps that walls divide: give "
    "one kind of them."
)


class OfMotion(OfKey):
    """A user's function that is given what it asks for by the names of its arguments; `settings` are compared with it."""

    places: tuple[int, ...] | None = None
    """Where the traced values that it closes over are, once they are taken out (`hoisted`)."""

    def __init__(self, function: Callable, what: str, known: tuple[str, ...], *settings: Any):
        self.arguments = names_of(function, what, known)
        self.captured, _, self.function = as_stated(function)
        self.key = self.function, self.arguments, *settings

    def of(self, known: dict[str, Any]) -> Any:
        """The function of what is known of one moment, by name."""
        params, first = split(known.get("params"), self.function, self.places)
        return self.function(*first, **{name: params if name == "params" else known[name] for name in self.arguments})

    def hoisted(self, values: list[Tracer]) -> Any:
        """The same of params that hold what it closes over and JAX traces, which is added to `values`."""
        if (found := hoisted(self.function, values)) is None:
            return self
        other = copy(self)
        other.function, other.places = found
        other.captured, other.key = other.function.outside, (other.function, *self.key[1:])
        return other

    @property
    def signature(self) -> str:
        """The function's own name with its arguments."""
        return signature(self.function, self.arguments)


class Event(OfMotion):
    """Where a function of the motion goes through zero: `dx.simulate(…, events=[dx.Event(function)])`.

    `function` returns one number of what the names of its arguments say: the time `t`, `q`, `v`, `p` or `x` at that time, and
    `params`. `direction`: +1 for zeros through which it rises, −1 for those through which it falls, 0 for both. With `terminal`
    the trajectory ends at the first of them.

        section = dx.Event(lambda q, v: q[0], direction=+1)

    Zeros are found inside the steps, on what `sol.at` is there, to a float's precision of the step. The function is looked at in
    rows, at points between them, a quarter of a step apart at most, and at more where it comes near to zero. What is found is
    each change of sign: a function that touches zero and goes back, and one that dips below it for less than 10⁻⁴ of a step, may
    count as two zeros or as none, and so do zeros of one that swings to and fro between these points: take smaller steps. At the
    first row nothing is found, if the function is zero there. Where steps have neither a polynomial nor the cubic, and in runs of
    many steps, dips are looked for where a cubic through rows and velocities shows them.

    Under `jax.grad`, `jit` and `vmap` the times and places of events are differentiated. `sol.events` then has four places for
    each step and event, or one more than a polynomial has stages: in the order of time in each trajectory, NaN after the last
    event; after a terminal one rows are NaN as well. On a GPU, and for functions that are no scalar program, only those are seen
    that change the sign of the function at so many points of a step.

    Raises `TypeError` for something that is no function of such arguments, `ValueError` for another direction.
    """

    name = "the function of a dx.Event"

    def __init__(self, function: Callable, direction: int = 0, terminal: bool = False):
        if isinstance(direction, bool) or direction not in (-1, 0, 1):
            raise ValueError(f"direction must be +1 (rising), −1 (falling) or 0 (both), but {direction!r} was given.")
        self.direction, self.terminal = int(direction), bool(terminal)
        super().__init__(function, "the function of an event", KNOWN, self.direction, self.terminal)

    def __call__(self, known: dict[str, Any]) -> Any:
        """The function of what is known of one moment, by name."""
        return self.of(known)

    def __repr__(self) -> str:
        settings = f", direction={self.direction:+d}" * bool(self.direction) + ", terminal=True" * self.terminal
        return f"Event({self.signature}{settings})"


class OutsideIndex(ValueError):
    """A function reads an entry that there is not, of which JAX would make another one."""


def names_of(function: Any, what: str, known: tuple[str, ...]) -> tuple[str, ...]:
    """The arguments of a user's function that is given things by their names. Raises `TypeError`."""
    expected = f"{what} takes some of {', '.join(known)} by their names, like lambda q: q[0]"
    if not callable(function):
        raise TypeError(f"{expected}, but {value_text(function)} was given.")
    try:
        parameters = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):
        raise TypeError(f"{expected}, but the signature of {value_text(function)} is not known: wrap it in a lambda.") from None
    needed = [p for p in parameters if p.name in known or p.default is p.empty]
    wrong = [p.name for p in needed if p.name not in known or p.kind in (p.VAR_POSITIONAL, p.VAR_KEYWORD, p.POSITIONAL_ONLY)]
    if wrong or not needed:
        raise TypeError(f"{expected}, but it takes {', '.join(wrong) or 'no argument'}.")
    return tuple(p.name for p in needed)


def checked_events(events: Any, kinds: tuple[type, ...]) -> tuple[Any, ...]:
    """The events of a run, each of one of these kinds. Raises `TypeError`."""
    if isinstance(events, kinds):
        events = [events]
    if not isinstance(events, Sequence) or isinstance(events, str):
        raise TypeError(f"events must be a list of dx.Event(function, …) and dx.Impact(gap), but {value_text(events)} was given.")
    for event in events:
        if not isinstance(event, kinds):
            hint = ": write dx.Event(function)" if callable(event) else ""
            raise TypeError(
                f"events must be a list of dx.Event(function, …) and dx.Impact(gap), but it holds {value_text(event)}{hint}."
            )
    return tuple(events)


def refuse_unknown(event: Event, number: int, fields: Collection[str]) -> None:
    """Raise `TypeError` for an event that asks for what no row says, of which the fields are these."""
    names = ["t", *(name for name in ("q", "p", "x") if name in fields), *["v"] * ({"q", "p"} <= set(fields)), "params"]
    missing = [name for name in event.arguments if name not in names]
    if missing:
        raise TypeError(
            f"events[{number}] asks for {', '.join(missing)}, but a run of this system and scheme knows {', '.join(names)}."
        )


def evaluated(event: Event, number: int, known: dict[str, Any], params: Any) -> Any:
    """The function of an event of what is known of one moment. Raises `TypeError` and `ValueError` for one that cannot be traced,
    or that returns no number."""
    try:
        found = event({**known, "params": params})
    except Exception as error:
        raise TypeError(f"events[{number}] could not be traced by JAX: {error_text(error)}") from error
    refuse_no_number(f"the function of events[{number}]", found)
    return found


def refuse_no_number(what: str, found: Any) -> None:
    """Raise `TypeError` and `ValueError` for what a user's function returned, if it is no real number."""
    if not hasattr(found, "shape") or found.shape != ():
        came = f"shape {found.shape}: index or sum its result" if hasattr(found, "shape") else type(found).__name__
        raise ValueError(f"{what} must return one number, but it returned {came}.")
    if not jnp.issubdtype(found.dtype, jnp.floating):
        raise TypeError(f"{what} must return a real number (float64), but its dtype is {found.dtype}.")


def captures_traced(what: str, function: Callable, *arguments: Any) -> tuple[Any, bool]:
    """The shape of what a function returns, and whether it closes over values that JAX traces. Raises `OutsideIndex`."""
    closed, shape = jax.make_jaxpr(function, return_shape=True)(*arguments)
    traced = any(isinstance(value, Tracer) for value in closed.consts)
    if not traced and reads_outside(closed):
        raise OutsideIndex(f"{what} reads an entry that its arguments do not have: check its indices.")
    return shape, traced
