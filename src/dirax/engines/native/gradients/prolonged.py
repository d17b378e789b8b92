"""A recorded run with the tangent of its inputs carried along: first derivatives of it are second ones of the run.

With r(u, x, t, h, c) = 0 and x' = a(u, x, t, h, c) the states are (x, ẋ, ṫ), the unknowns (u, u̇) and the parameters (c, ċ, ḣ/h):
r = 0 and Dr(u̇, ẋ, ṫ, ḣ, ċ) = 0. Of this run, too, the derivatives are those of a recorded one, and so on.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.engines.native.gradients.recording import KEPT, Recorded
from dirax.engines.native.kernels import kernels
from dirax.program.interpreter import UnsupportedPrimitive
from dirax.program.memo import Memo, Same
from dirax.schemes.step import StepEquation, StepSequence


class Prolonged(Recorded):
    """A recorded run with a tangent. Raises `UnsupportedPrimitive` where it is too large."""

    def __init__(self, task: Recorded, parameters: int):
        self.task, self.parts = task, task.parts
        self.state_size = 2 * task.state_size + 1
        self.unknowns = max(1, *(2 * stage.unknowns for stage, _ in task.equation.stages))  # as a recorded run has at least one
        self.equation, self.every_stage = (prolonged(e, self.unknowns) for e in (task.equation, task.every_stage))
        self.rows, self.steps, self.numbers = task.rows, task.steps, task.numbers
        made = kernels(self.every_stage, np.zeros((1, 2 * parameters + 1)), True, self.numbers["compensated"])
        made.check()
        _ = made.step.differentiable

    @classmethod
    def of(cls, task: Recorded, parameters: int) -> "Prolonged | None":
        """None for a run that is too large, or has functions that are no scalars then."""
        try:
            return cls(task, parameters)
        except UnsupportedPrimitive:
            return None

    def inputs(self, inputs: Any, tangent: Any) -> tuple:
        """The five inputs of it from those of the run and the tangent (ẋ, ċ, ṫ0, ḣ) of these."""
        state, guess, c, t0, h = inputs
        along, of_c, of_t, of_h = tangent
        padded = []
        for i, (stage, _) in enumerate(self.task.equation.stages):
            k = stage.unknowns
            padded.append(jnp.pad(guess[:, i, :k], ((0, 0), (0, self.unknowns - k))))
        whole = jnp.concatenate([state, along, of_t[:, None]], axis=1)
        return whole, jnp.stack(padded, axis=1), jnp.concatenate([c, of_c, (of_h / h)[:, None]], axis=1), t0, h

    def tangents(self, inputs: Any, tangent: Any, moved: Any, moved_tangent: Any) -> tuple:
        """The tangents of `inputs(inputs, tangent)` along those (x', c', t0', h') of the inputs and those of the tangent."""
        h, of_h = inputs[-1], tangent[-1]
        (state, c, t0, of_step), (along, of_c, of_t, turned) = moved, moved_tangent
        rate = turned / h - of_h * of_step / h**2
        return (
            jnp.concatenate([state, along, of_t[:, None]], axis=1),
            jnp.concatenate([c, of_c, rate[:, None]], axis=1),
            t0,
            of_step,
        )

    def tangent_of_rows(self, states: Any, unknowns: Any) -> list:
        """The tangents of states and unknowns at the rows of the run, from its own ones."""
        task, lead = self.task, states.shape[:2]
        s = task.state_size
        of_states = states.reshape(*lead, self.parts, -1)[..., s : 2 * s].reshape(*lead, -1)
        return [of_states, unknowns[..., self._places]]

    def cotangents(self, states: Any, unknowns: Any) -> list:
        """The cotangents of its own rows of which those of the tangents of the run's rows are these."""
        task, lead = self.task, states.shape[:2]
        s = task.state_size
        whole = jnp.pad(states.reshape(*lead, self.parts, s), ((0, 0),) * 3 + ((s, 1),)).reshape(*lead, -1)
        known = self._places < self.parts * self.unknowns
        placed = jnp.zeros((*lead, self.parts * self.unknowns)).at[..., self._places[known]].set(unknowns[..., known])
        return [whole, placed]

    @property
    def _places(self) -> np.ndarray:
        """Where the tangent of each unknown of the run's rows stands among its own; beyond all of them where there is none."""
        size, found = self.task.unknowns, []
        for i in range(self.parts):
            k = self.task.equation.stages[i][0].unknowns
            own = i * self.unknowns + k + np.arange(k)
            found.append(np.append(own, np.full(size - k, self.parts * self.unknowns)))
        return np.concatenate(found).astype(int)


_prolonged: Memo[StepSequence] = Memo(KEPT)


def prolonged(equation: StepSequence, size: int) -> StepSequence:
    """The equation of the tangent, whose rows have `size` unknowns and tangents; the same object for the same arguments."""
    return _prolonged.get((Same(equation), size), lambda: _made(equation, size))


def _made(equation: StepSequence, size: int) -> StepSequence:
    def one(stage: StepEquation) -> StepEquation:
        s, k = stage.state_size, stage.unknowns

        def given(state, c, h):
            """(x, c), and (ẋ, ċ, ṫ, ḣ)."""
            m = (c.shape[0] - 1) // 2
            return (state[:s], c[:m]), (state[s : 2 * s], c[m : 2 * m], state[-1], c[-1] * h)

        def along(function, u, state, t, h, c):
            (x, own), (of_x, of_c, of_t, of_h) = given(state, c, h)
            return jax.jvp(function, (u[:k], x, t, h, own), (u[k:], of_x, of_t, of_h, of_c))

        def advance(u, state, t, h, c):
            return jnp.concatenate([*along(stage.advance, u, state, t, h, c), state[-1:] + c[-1] * h])

        def guess(state, previous, h, c):
            x, own = given(state, c, h)[0]
            return jnp.concatenate([stage.guess(x, previous[:k], h, own), previous[k:]])

        def unpack(state, u, t, h, c):
            return {"state": state, "unknowns": jnp.concatenate([u, jnp.zeros(size - 2 * k)])}

        shapes = {"state": (2 * s + 1,), "unknowns": (size,)}
        fields = {name: dataclasses.replace(stage.fields[name], shape=shape) for name, shape in shapes.items()}
        return StepEquation(
            start=lambda data, h, c: (jnp.zeros(2 * s + 1), jnp.zeros(2 * k)),
            residual=lambda u, state, t, h, c: jnp.concatenate(along(stage.residual, u, state, t, h, c)),
            advance=advance,
            guess=guess,
            unpack=unpack,
            fields=fields,
            state_size=2 * s + 1,
            unknowns=2 * k,
        )

    made = {id(stage): one(stage) for stage, _ in equation.stages}
    return StepSequence(tuple((made[id(stage)], fraction) for stage, fraction in equation.stages))
