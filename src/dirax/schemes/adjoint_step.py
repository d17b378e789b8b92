"""One step of the adjoint Φ*_h = (Φ_{−h})⁻¹ of a method: the inverse of its step back."""

from dataclasses import dataclass

import jax.numpy as jnp

from dirax.schemes.abstract_step import AbstractStep
from dirax.schemes.growth_premise import NothingGrows
from dirax.schemes.layout import Layout
from dirax.schemes.step import Field, StepEquation

ADJOINT = "adjoint: "


@dataclass(frozen=True, eq=False)
class AdjointStep(AbstractStep):
    """The step of Φ*_h: unknowns (w, u) with x1 = x0 + h w, Φ_{−h}(x1) = x0 by the unknowns u of `inner`."""

    inner: StepEquation

    @property
    def state(self) -> Layout:
        return self.inner.state_layout

    @property
    def unknowns(self) -> Layout:
        return Layout(increment=self.inner.state_size, inner=self.inner.unknowns)

    @property
    def fields(self) -> dict[str, Field]:
        return self.inner.fields

    @property
    def labels(self) -> tuple[str, ...]:
        return (*(f"{ADJOINT}component {i} of the state" for i in range(self.inner.state_size)), *self.inner.labels)

    @property
    def canonical(self) -> bool:
        return self.inner.canonical

    def residual(self, u, state, t, h, params):
        increment, inner = self.unknowns.split(u)
        end = state + h * increment
        back = self.inner.advance(inner, end, t + h, -h, params)
        return jnp.concatenate([(back - state) / h, self.inner.residual(inner, end, t + h, -h, params)])

    def advance(self, u, state, t, h, params):
        return state + h * self.unknowns.split(u).increment

    def unpack(self, state, u, t, h, params):
        """Arrays of nodes are those of the point that the step leaves, those of steps are of the step back to it: impulses of
        that one have the opposite sign."""
        increment, inner = self.unknowns.split(u)
        here = self.inner.unpack(state, inner, t, h, params)
        back = self.inner.unpack(state + h * increment, inner, t + h, -h, params)
        sign = lambda field: -1.0 if field.rule == "sum" else 1.0
        of_step = {name: sign(field) * back[name] for name, field in self.fields.items() if field.place == "step"}
        return here | of_step

    def start(self, data, h, params):
        return self.before(data, h, params, *self.inner.start(data, -h, params))

    def resume(self, data, h, params):
        return self.before(data, h, params, *self.inner.resume(data, -h, params))

    def before(self, data, h, params, state, u):
        """The state and a first guess, of those of the step back."""
        back = self.inner.advance(u, state, data.get("t", 0.0), -h, params)
        return state, self.unknowns.join(increment=(state - back) / h, inner=u)

    def guess(self, state, previous, h, params):
        """Where the inner step starts, from the state that the increment of the steps before leads to."""
        increment, inner = self.unknowns.split(previous)
        return self.unknowns.replace(previous, inner=self.inner.guess(state + h * increment, inner, -h, params))

    def check(self, data, h, params):
        check = self.inner.check
        (check.of_adjoint if isinstance(check, NothingGrows) else check)(data, -h, params)
