"""One step of a length of its own: another scheme's, with the step density and the time in its state."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from dirax.program.legendre import moves
from dirax.program.tracing import along, once
from dirax.program.user_functions import evaluated
from dirax.schemes.abstract_step import AbstractStep
from dirax.schemes.layout import Layout
from dirax.schemes.step import CLOCK, STEP_DENSITY, STEP_LENGTH, Field, StepEquation

SAME_RATE = 1e-6
"""Relative distance of two ẋ, the smallest and that of an elimination, that are the same unless there are many."""


class Place(NamedTuple):
    """What a state of variable steps says: that of the scheme, the step density and the time at it, the density in the middle of
    the step of ε that leaves it, and the length h = ε/z of that step, NaN where z is not positive."""

    state: Any
    density: Any
    time: Any
    middle: Any
    length: Any


@dataclass(frozen=True, eq=False)
class VariableStep(AbstractStep):
    """The step of `inner` of length h = ε/z, where the engine's h is ε and its time is not looked at."""

    inner: StepEquation
    system: Any
    density: Callable
    """(t, q or x, params) ↦ ρ."""

    @property
    def state(self) -> Layout:
        return Layout(**self.inner.state_layout, **{STEP_DENSITY: (), CLOCK: ()})

    @property
    def unknowns(self) -> Layout:
        return self.inner.unknown_layout

    @property
    def fields(self) -> dict[str, Field]:
        density = Field((), "node", (), "step density z: the step that leaves the row is about step/z long")
        own = {STEP_DENSITY: density, CLOCK: Field((), "node", (), "time")}
        if any(field.rule == "sum" for field in self.inner.fields.values()):
            own[STEP_LENGTH] = Field((), "step", (), "length of the step, over which impulses are forces", "sum")
        return self.inner.fields | own

    @property
    def labels(self):
        return self.inner.labels

    # ------------------------------------------------------------------------------------------ the length of a step

    @once
    def place(self, state, h, params) -> Place:
        """What there is to know of a state."""
        own, density, time = state[:-2], state[-2], state[-1]
        middle = density + 0.5 * h * self.growth(own, time, params)
        return Place(own, density, time, middle, jnp.where(middle > 0.0, h / middle, jnp.nan))

    def row(self, own, time, params, step=None) -> dict[str, Any]:
        """The fields of nodes at a state of the scheme: `check` has found that they do not depend on the step (u, h) from it."""
        step = jnp.full(self.inner.unknowns + 1, jnp.nan) if step is None else step
        row = self.inner.unpack(own, step[:-1], time, step[-1], params)
        return {name: row[name] for name in ("q", "p", "x") if name in row}

    @once
    def growth(self, own, time, params):
        """G = d ln ρ/dt along the motion."""
        row = self.row(own, time, params)
        at = lambda t, place: jnp.log(self.density(t, place, params))
        place = row["q" if "q" in row else "x"]
        return along(at, (jnp.asarray(time, float), place), (jnp.ones(()), self.system.velocity_at({**row, "t": time}, params)))

    # ------------------------------------------------------------------------------------------ the step

    def residual(self, u, state, t, h, params):
        at = self.place(state, h, params)
        return self.inner.residual(u, at.state, at.time, at.length, params)

    def advance(self, u, state, t, h, params):
        at = self.place(state, h, params)
        after = self.inner.advance(u, at.state, at.time, at.length, params)
        time = at.time + at.length
        density = at.middle + 0.5 * h * self.growth(after, time, params)
        return jnp.concatenate([after, density[None], time[None]])

    def unpack(self, state, u, t, h, params):
        own, density, time = state[:-2], state[-2], state[-1]
        only_nodes = all(field.place == "node" for field in self.inner.fields.values())
        length = jnp.asarray(jnp.nan) if only_nodes else self.place(state, h, params).length
        own_fields = {STEP_DENSITY: density, CLOCK: time, STEP_LENGTH: length}
        row = self.inner.unpack(own, u, time, length, params) | own_fields
        return {name: row[name] for name in self.fields}

    def guess(self, state, previous, h, params):
        at = self.place(state, h, params)
        return self.inner.guess(at.state, previous, at.length, params)

    # ------------------------------------------------------------------------------------------ where it begins

    def start(self, data, h, params):
        if "q0" in data:
            raise ValueError("dx.VariableSteps starts from q= with v= or p=, or from x=, not from two points.")
        return self._begun(self.inner.start, data, self._first_density(data, params), data["t"], h, params)

    def resume(self, data, h, params):
        return self._begun(self.inner.resume, data, data[STEP_DENSITY], data[CLOCK], h, params)

    def _begun(self, start, data, density, time, h, params):
        own, _ = start({**data, "t": time}, h / density, params)
        number = lambda a: jnp.reshape(jnp.asarray(a, float), (1,))
        state = jnp.concatenate([own, number(density), number(time)])
        return state, start({**data, "t": time}, self.place(state, h, params).length, params)[1]

    def _first_density(self, data, params):
        return self.density(jnp.asarray(data["t"], float), data["q" if "q" in self.inner.fields else "x"], params)

    def _completed(self, data, params):
        """Completed initial data with the time, and q̇ or ẋ there as steps find it."""
        complete = {**self.system.complete(data, params, False), "t": data["t"]}
        row = {name: complete[name] for name in ("q", "p", "x") if name in self.inner.fields and name in complete}
        return complete, self.system.velocity_at({**row, "t": data["t"]}, params)

    def check(self, data, h, params):
        complete, rate = evaluated(self._completed, {**data, "t": data.get("t", 0.0)}, params)
        density = evaluated(self._first_density, complete, params)
        if not (np.isfinite(density) and density > 0.0):
            raise ValueError(
                f"density must be positive and finite along the motion, but it is {float(density):.6g} where the run begins: "
                "give another one, dx.VariableSteps(scheme, density=lambda q: …)."
            )
        self.inner.check(data, h / float(density), params)
        known = complete.get("velocity", rate)
        if rate.shape == known.shape and not np.max(np.abs(rate - known)) <= SAME_RATE * np.max(np.abs(known)):
            raise ValueError(
                "dx.VariableSteps takes two-forms that determine ẋ, but that of the system is degenerate where the run begins: "
                "state it by dx.DiracStructure.from_kernel(F, E) with F = ωᵀ and E = −1, of which the smallest ẋ is taken."
            )
        own, u = evaluated(self.inner.start, complete, h / density, params)
        if moves(lambda step: tuple(self.row(own, 0.0, params, step).values()), jnp.append(u, h)):
            raise TypeError(
                "dx.VariableSteps takes schemes whose q and p at a row do not depend on the step that leaves it, such as "
                "dx.Collocation(4) and dx.DiscreteDirac(): this one is no such scheme on this system."
            )

    # ------------------------------------------------------------------------------------------ between the rows, and words

    @property
    def interpolation(self):
        return self.interpolate if self.inner.interpolate is not None else None

    def interpolate(self, theta, u, state, t, h, params):
        """By the scheme's polynomial, the density by a line."""
        at, interpolate = self.place(state, h, params), self.inner.interpolate
        assert interpolate is not None
        found = interpolate(theta, u, at.state, at.time, at.length, params)
        after = once(self.advance)(u, state, t, h, params)
        density = at.density + theta * (after[-2] - at.density)
        return {**found, STEP_DENSITY: density, CLOCK: at.time + theta * at.length}

    @property
    def hermite(self):
        return self.between if self.inner.between is not None else None

    def between(self, theta, row, after, h, params):
        between = self.inner.between
        assert between is not None
        found = between(theta, row, after, after[CLOCK] - row[CLOCK], params)
        return found | {name: row[name] + theta * (after[name] - row[name]) for name in (STEP_DENSITY, CLOCK)}

    def remark(self, state, t, h, params):
        at = self.place(state, h, params)
        if not at.middle > 0.0:
            return f"the step density has come down to {float(at.middle):.6g}, and must stay positive: give another density="
        return self.inner.remark(at.state, at.time, at.length, params)

    def review(self, fields):
        return self.inner.review(fields)
