"""The functions of a stage in numbers for one trajectory, for those who ask a few times: nothing is compiled for them."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.engines.step_program import StepProgram, step_program
from dirax.program.evaluation.in_numpy import Values
from dirax.program.interpreter import UnsupportedPrimitive


class InNumbers:
    """By the scalar program of the step; `params` are those of one trajectory."""

    def __init__(self, step: StepProgram, params: Any):
        self.step, (self.index, _) = step, step.stages[0]
        self.equation = step.equations[self.index]
        self.params = step.parameters.flatten(params, None)

    def _known(self, u: np.ndarray | None, previous: np.ndarray | None, state: np.ndarray, t: float, h: float) -> Values:
        known, shared, e = Values(self.step.graph, 1), self.step.shared, self.equation
        node = lambda nodes: np.asarray(nodes, dtype=np.int64)
        for nodes, array in (
            (e.unknowns, u), (e.previous, previous), (e.state, state), (shared.t, t), (shared.h, h), (shared.params, self.params)
        ):  # fmt: skip
            if array is not None:
                known.bind(node(nodes), np.asarray(array, float)[None])
        return known

    def guess(self, state, previous, h) -> np.ndarray:
        """Where Newton's method starts."""
        return self._known(None, previous, state, 0.0, h).read(np.asarray(self.equation.guess, np.int64))[0]

    def advance(self, u, state, t, h) -> np.ndarray:
        """The next state."""
        return self._known(u, None, state, t, h).read(np.asarray(self.equation.advance, np.int64))[0]

    def linearized(self, u, state, t, h) -> tuple[np.ndarray, np.ndarray]:
        """(residual, ∂residual/∂u)."""
        e, k = self.equation, len(u)
        try:
            found = np.array(self.step.first_in_floats((*u.tolist(), *state.tolist(), float(t), float(h), *self.params.tolist())))
            return found[:k], found[k:].reshape(k, k)
        except (ArithmeticError, ValueError):  # where Python's floats have no such operation, NumPy's have a NaN
            known = self._known(u, None, state, t, h)
            return known.read(np.asarray(e.residual, np.int64))[0], known.slopes(e.residual, e.unknowns)[0]

    def slopes(self, u, state, t, h) -> tuple[np.ndarray, np.ndarray]:
        """The derivatives of the residual by u and by the state."""
        e = self.equation
        slopes = self._known(u, None, state, t, h).slopes(e.residual, [*e.unknowns, *e.state])[0]
        return slopes[:, : len(u)], slopes[:, len(u) :]


class InJax:
    """By JAX, for a stage that is no scalar program."""

    def __init__(self, stage: Any, params: Any):
        self.stage, self.params = stage, jax.tree.map(jnp.asarray, params)
        self._linearized = jax.jit(lambda u, *args: (stage.residual(u, *args), jax.jacfwd(stage.residual)(u, *args)))

    def guess(self, state, previous, h) -> np.ndarray:
        """Where Newton's method starts."""
        return np.asarray(self.stage.guess(jnp.asarray(state), jnp.asarray(previous), h, self.params))

    def advance(self, u, state, t, h) -> np.ndarray:
        """The next state."""
        return np.asarray(self.stage.advance(jnp.asarray(u), jnp.asarray(state), jnp.asarray(t), h, self.params))

    def linearized(self, u, state, t, h) -> tuple[np.ndarray, np.ndarray]:
        """(residual, ∂residual/∂u)."""
        residual, jacobian = self._linearized(u, state, jnp.asarray(t), h, self.params)
        return np.asarray(residual), np.asarray(jacobian)

    def slopes(self, u, state, t, h) -> tuple[np.ndarray, np.ndarray]:
        """The derivatives of the residual by u and by the state."""
        by_both = jax.jacfwd(self.stage.residual, argnums=(0, 1))
        by_u, by_state = by_both(jnp.asarray(u), jnp.asarray(state), jnp.asarray(t), h, self.params)
        return np.asarray(by_u), np.asarray(by_state)


def in_numbers(stage: Any, params: Any) -> InNumbers | InJax:
    """The functions of a StepEquation."""
    try:
        return InNumbers(step_program(stage, params, False), params)
    except UnsupportedPrimitive:
        return InJax(stage, params)
