"""StepEquation: the hub. One step of size h as an equation between two states; schemes make it, engines solve it."""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.program.memo import Memo
from dirax.systems.shape import Shape
from dirax.text.representation import counted, fields_html, module_html, module_text


class Field(eqx.Module):
    """One named array of a trajectory: its shape in a row and whether it belongs to nodes or to steps.

    `place="node"` has steps + 1 rows (q, p, x), `place="step"` has steps rows (multipliers). `dims` names the axes.
    """

    shape: tuple[int, ...] = eqx.field(static=True)
    place: str = eqx.field(static=True, default="node")
    dims: tuple[str, ...] = eqx.field(static=True, default=("coordinate",))
    description: str = eqx.field(static=True, default="")


class StepEquation(eqx.Module):
    """One step of size h of a method, as pure JAX functions on flat float64 vectors.

    - `start(data, h, params) -> (state, u)`: initial state (s,) and first guess (k,) from the initial data, a dict that
      holds one of the pairs `q, v` · `q, p` · `q0, q1` or a single `x`, and the time `t`;
    - `guess(state, previous, h, params) -> u`: where Newton starts; `previous` (k,) are the unknowns extrapolated from
      the steps before;
    - `residual(u, state, t, h, params) -> r`: (k,), zero at the step;
    - `advance(u, state, t, h, params) -> state`: the next state (s,);
    - `unpack(state, u, t, h, params) -> dict`: the named arrays to be saved for the row that `state` is at; `u` is the
      step leaving it.

    An explicit method has `unknowns = 0`. `scale` (k,) is the unit of each unknown, for the stopping test of Newton's
    method only. `labels` names each row of the residual for messages. With `needs_leaving_step` the node fields depend on
    `u`, and an engine solves one more step to fill the last row. `check(data, h, params)` raises `ValueError` for initial
    data, concrete ones, at which a premise of the method does not hold.
    """

    start: Callable = eqx.field(static=True)
    residual: Callable = eqx.field(static=True)
    advance: Callable = eqx.field(static=True)
    unpack: Callable = eqx.field(static=True)
    state_size: int = eqx.field(static=True)
    unknowns: int = eqx.field(static=True)
    fields: dict[str, Field]
    guess: Callable = eqx.field(static=True)
    scale: tuple[float, ...] = eqx.field(static=True)
    labels: tuple[str, ...] = eqx.field(static=True)
    needs_leaving_step: bool = eqx.field(static=True)
    canonical: bool = eqx.field(static=True)
    check: Callable = eqx.field(static=True)

    def __init__(
        self,
        *,
        start: Callable,
        residual: Callable,
        advance: Callable,
        unpack: Callable,
        state_size: int,
        unknowns: int,
        fields: dict[str, Field],
        guess: Callable | None = None,
        scale: tuple[float, ...] | None = None,
        labels: tuple[str, ...] | None = None,
        needs_leaving_step: bool = False,
        canonical: bool = False,
        check: Callable | None = None,
    ):
        """`canonical` says that the state is (q, p) of T*Q, so that its symplecticity can be measured."""
        self.start, self.residual, self.advance, self.unpack = start, residual, advance, unpack
        self.state_size, self.unknowns, self.fields = state_size, unknowns, dict(fields)
        self.guess = guess or previous_unknowns
        self.scale = (1.0,) * unknowns if scale is None else tuple(float(s) for s in scale)
        self.labels = labels or tuple(f"equation {i}" for i in range(unknowns))
        self.needs_leaving_step, self.canonical = needs_leaving_step, canonical
        self.check = check or nothing_to_check
        if not len(self.scale) == len(self.labels) == unknowns:
            raise ValueError(
                f"scale and labels need one entry per unknown ({unknowns}), but {len(self.scale)} and {len(self.labels)} "
                "were given."
            )

    @property
    def stages(self) -> tuple[tuple["StepEquation", float], ...]:
        """The equations solved one after the other in a step, each with its fraction of h (here: one, the whole)."""
        return ((self, 1.0),)

    def _summary(self) -> dict[str, str]:
        saved = (f"{name}{list(field.shape)}" + " per step" * (field.place == "step") for name, field in self.fields.items())
        return {
            "solves": counted(self.unknowns, "unknown") if self.unknowns else "nothing (explicit)",
            "state": counted(self.state_size, "number") + ", (q, p) on T*Q" * self.canonical,
            "saves": ", ".join(saved),
        }

    def __repr__(self) -> str:
        return f"StepEquation({'; '.join(f'{name} {text}' for name, text in self._summary().items())})"

    def _repr_html_(self) -> str:
        return fields_html("StepEquation", self._summary() | {"equations": ", ".join(self.labels)})


class StepSequence(eqx.Module):
    """Several StepEquations solved one after the other, each with its own fraction of h: a composition."""

    stages: tuple[tuple[StepEquation, float], ...]

    @property
    def first(self) -> StepEquation:
        return self.stages[0][0]

    def __repr__(self) -> str:
        fractions = ", ".join(f"{fraction:.6g}" for _, fraction in self.stages)
        return f"StepSequence({counted(len(self.stages), 'stage')} of h·({fractions}); first {self.first!r})"


class AbstractScheme(eqx.Module):
    """How time is cut: turns a system of known sizes into a StepEquation."""

    def __repr__(self) -> str:
        return module_text(self)

    def _repr_html_(self) -> str:
        return module_html(self)

    @abstractmethod
    def step_equation(self, system: Any, shape: Shape) -> StepEquation | StepSequence:
        """The equation of one step; raises `TypeError` for a system that the scheme does not discretize."""


def previous_unknowns(state, previous, h, params):
    """The default guess: the unknowns extrapolated from the steps before."""
    return previous


def nothing_to_check(data, h, params) -> None:
    """The default check of initial data."""


def explicit_step(u, state, t, h, params) -> Float[Array, "0"]:
    """The residual of an explicit method: nothing to solve."""
    return jnp.zeros((0,))


_equations: Memo[StepEquation | StepSequence] = Memo(256)


def make_step_equation(scheme: AbstractScheme, system: Any, shape: Shape) -> StepEquation | StepSequence:
    """`scheme.step_equation(system, shape)`, the same object for equal arguments, so that compiled code is reused."""
    return _equations.get((scheme, system, shape), lambda: scheme.step_equation(system, shape))
