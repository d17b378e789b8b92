"""The derivative of one step of a scheme at a relative equilibrium."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from dirax.diagnostics.linearized_field import FieldAt
from dirax.program.tracing import jacobian
from dirax.program.user_functions import evaluated
from dirax.schemes.step import AbstractScheme, make_step_equation
from dirax.systems.shape import Shape
from dirax.systems.system import AbstractSystem

INVARIANT = 1e-8
"""How far, relative to the step's derivative, it may lead out of the tangent space of the discrete constraints."""

TRIES = 8
STEPS = 30


class StepAt(NamedTuple):
    """As `FieldAt`, of a step in the coordinates of the scheme's state."""

    matrix: np.ndarray
    tangent: np.ndarray
    symmetric: np.ndarray
    residual: float


class _Stage:
    """One equation of a step, with its derivatives."""

    def __init__(self, equation: Any, t: float, h: float):
        self.equation, self.t, self.h = equation, t, h

    def residual(self, u: Any, state: Any, params: Any) -> tuple[Any, Any, Any]:
        """r(u, state), with its derivatives by both."""
        at = lambda u, state: self.equation.residual(u, state, self.t, self.h, params)
        return at(u, state), jacobian(lambda u: at(u, state))(u), jacobian(lambda s: at(u, s))(state)

    def advance(self, u: Any, state: Any, params: Any) -> tuple[Any, Any, Any]:
        """The next state, with its derivatives by both."""
        at = lambda u, state: self.equation.advance(u, state, self.t, self.h, params)
        return at(u, state), jacobian(lambda u: at(u, state))(u), jacobian(lambda s: at(u, s))(state)

    def step(self, state: np.ndarray, u: np.ndarray, params: Any) -> tuple[np.ndarray, np.ndarray]:
        """The next state and its derivative by this one."""
        by_state = np.zeros((u.size, state.size))
        if u.size:
            for _ in range(STEPS):
                missed, by_u, by_state = (np.asarray(x) for x in evaluated(self.residual, u, state, params))
                change = np.linalg.solve(by_u, missed)
                u = u - change
                if np.abs(change).max() <= 1e-14 * (1.0 + np.abs(u).max()):
                    break
            _, by_u, by_state = (np.asarray(x) for x in evaluated(self.residual, u, state, params))
            by_state = -np.linalg.solve(by_u, by_state)
        following, along_u, along_state = (np.asarray(x) for x in evaluated(self.advance, u, state, params))
        return following, along_state + along_u @ by_state


def linearized_step(
    system: AbstractSystem, scheme: AbstractScheme, h: Any, at: Mapping[str, Any], field: FieldAt, params: Any
) -> StepAt:
    """The derivative of a step about the relative equilibrium `at`, where the linearization of the system is `field`.

    Raises `ValueError` where the scheme's own relative equilibrium is another one.
    """
    q, v = (np.asarray(at[name], float) for name in ("q", "v"))
    t, n = float(at.get("t", 0.0)), q.size
    equation = make_step_equation(scheme, system, Shape(*system.sizes({"q": q, "v": v}, params)))

    def start(z, params):
        complete = system.complete({"q": z[:n], "v": z[n:], "t": jnp.asarray(t)}, params, False)
        return equation.stages[0][0].start({**complete, "t": jnp.asarray(t)}, h * equation.stages[0][1], params)[0]

    z = np.concatenate([q, v])
    begun = lambda z, params: (start(z, params), jacobian(lambda z: start(z, params))(z))
    first, lift = (np.asarray(x) for x in evaluated(begun, z, params))
    state, matrix, time = first, np.eye(first.size), t
    for stage, fraction in equation.stages:
        data = {name: np.asarray(x) for name, x in _completed(system, stage, state, q, v, time, params).items()}
        guess = np.asarray(stage.start(data, fraction * h, params)[1])
        state, slope = _Stage(stage, time, fraction * h).step(state, guess, params)
        matrix, time = slope @ matrix, time + fraction * h
    moved = lift @ np.concatenate([v, np.zeros(n)]) * h
    change = state - first
    if field.symmetric.size:
        moved = lift @ field.symmetric
        moved = moved @ np.linalg.lstsq(moved, change, rcond=1e-12)[0]
    residual = np.abs(change - moved).max() / (1.0 + np.abs(first).max() + np.abs(change).max())
    tangent = np.linalg.qr(lift @ field.tangent)[0]
    for _ in range(TRIES):
        image = matrix @ tangent
        outside = np.abs(image - tangent @ (tangent.T @ image)).max(initial=0.0)
        if outside <= INVARIANT * np.abs(matrix).max():
            break
        tangent = np.linalg.qr(image)[0]
    return StepAt(matrix, tangent, lift @ field.symmetric, residual)


def _completed(system: Any, stage: Any, state: np.ndarray, q: np.ndarray, v: np.ndarray, t: float, params: Any) -> dict:
    """Initial data near the state, for a first guess of the unknowns: those of the motion at that time."""
    complete = system.complete({"q": q, "v": v, "t": t}, params, False)
    return {**complete, "t": t}
