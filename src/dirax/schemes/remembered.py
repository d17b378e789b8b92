"""A scheme that saves the state and the unknowns of every step, for those who look inside the steps later."""

from dataclasses import replace
from typing import Any

from dirax.schemes.step import AbstractScheme, Field, Shape, StepEquation, StepSequence, make_step_equation

STATE, UNKNOWNS = "state_of_step", "unknowns_of_step"
"""The fields of steps with the state that each leaves and its unknowns."""


class Remembered(AbstractScheme):
    """The steps of another scheme, with STATE and UNKNOWNS among their fields where a polynomial needs them inside a step."""

    scheme: AbstractScheme

    def step_equation(self, system: Any, shape: Shape) -> StepEquation | StepSequence:
        inner = make_step_equation(self.scheme, system, shape)
        if not isinstance(inner, StepEquation) or inner.interpolate is None:
            return inner
        more = {STATE: Field((inner.state_size,), "step", ("entry",)), UNKNOWNS: Field((inner.unknowns,), "step", ("unknown",))}
        return replace(inner, unpack=_WithStep(inner), fields=inner.fields | more)


class _WithStep:
    """`unpack` of a remembered step."""

    def __init__(self, inner: StepEquation):
        self.inner = inner

    def __call__(self, state, u, t, h, params):
        return {**self.inner.unpack(state, u, t, h, params), STATE: state, UNKNOWNS: u}


def forgotten(scheme: AbstractScheme, equation: Any) -> tuple[AbstractScheme, Any]:
    """The scheme and its equation without what is remembered."""
    plain = scheme.scheme if isinstance(scheme, Remembered) else scheme
    unpack = getattr(equation, "unpack", None)
    return plain, unpack.inner if isinstance(unpack, _WithStep) else equation
