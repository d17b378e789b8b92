"""The derivative of one step of a scheme at a relative equilibrium."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from dirax.diagnostics.linearized_field import FieldAt, equations_of, filled, scaled_matrix
from dirax.numerics.equilibration import balanced_inverse
from dirax.numerics.newton import AT_FLOOR, sizes_of_unknowns
from dirax.program.memo import Memo
from dirax.program.tracing import jacobian
from dirax.program.user_functions import evaluated
from dirax.run.redundancy import redundant_constraints
from dirax.run.start import begun, completed
from dirax.run.validate import Case, validated_case
from dirax.schemes.collision_step import SUMS
from dirax.schemes.layout import Layout
from dirax.schemes.step import AbstractScheme, make_step_equation
from dirax.systems.shape import Shape
from dirax.systems.system import AbstractSystem

INVARIANT = 1e-8
"""How far, relative to the step's derivative, it may lead out of the tangent space of the discrete constraints."""

RANK = 1e-12
"""Singular values of the motions along symmetries in a step, relative to the largest one, that count as zero."""

TRIES = 8
STEPS = 30


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
                inverse = balanced_inverse(by_u)
                change, sizes = inverse @ missed, sizes_of_unknowns(by_u, inverse, u, missed)
                u = u - change
                if np.all(np.abs(change) <= AT_FLOOR * sizes):
                    break
            _, by_u, by_state = (np.asarray(x) for x in evaluated(self.residual, u, state, params))
            by_state = -balanced_inverse(by_u) @ by_state
        following, along_u, along_state = (np.asarray(x) for x in evaluated(self.advance, u, state, params))
        return following, along_state + along_u @ by_state


_stages: Memo[_Stage] = Memo(64)


def linearized_step(
    system: AbstractSystem, scheme: AbstractScheme, h: Any, at: Mapping[str, Any], field: FieldAt, params: Any
) -> FieldAt:
    """The derivative of a step about the relative equilibrium `at`, where the linearization of the system is `field`, in the
    coordinates of the scheme's state.

    Raises `ValueError` where the scheme's own relative equilibrium is another one.
    """
    case = validated_case({"q": at["q"], "v": at["v"]}, params, False, h, at.get("t", 0.0))
    initial = completed(system, case, False)
    shape = Shape(*system.sizes(dict(case.data), case.params))
    redundant = redundant_constraints(system, initial.constraints, dict(case.data), case.params, case.t0)
    equation = make_step_equation(scheme, system, Shape(shape.n, shape.m, shape.c, redundant=redundant))
    began = begun(equation, case, initial)
    first = np.asarray(began.state)
    layout = equation.stages[0][0].state_layout
    lift = _lift(system, layout, case)
    state, matrix, time = first, np.eye(first.size), case.t0
    for (stage, fraction), guess in zip(equation.stages, began.guess, strict=True):
        state, slope = _stage(stage, time, fraction * h).step(state, np.asarray(guess), case.params)
        matrix, time = slope @ matrix, time + fraction * h
    # lifts are tangent to the discrete constraints up to the forces of constraints, of which a step takes no notice
    units = np.max(np.abs(lift) * field.units, axis=1)
    energy = np.max(units[layout.place("p")] * field.units[shape.n :])
    for name in filter(layout.__contains__, SUMS):
        units[layout.place(name)] = energy
    units = filled(units, matrix)
    matrix, lift = scaled_matrix(matrix, units), lift * field.units / units[:, None]
    first, change = first / units, (state - first) / units
    symmetric, tangent = matrix @ lift @ field.symmetric, matrix @ lift @ field.tangent
    straight = np.concatenate([case.data["v"], np.zeros(shape.n)]) / field.units / field.rate
    moved = symmetric if symmetric.size else matrix @ lift @ straight[:, None]
    shares = np.linalg.lstsq(moved, change, rcond=RANK)[0]
    residual = np.abs(change - moved @ shares).max() / (1.0 + np.abs(first).max() + np.abs(change).max())
    for _ in range(TRIES):
        tangent = np.linalg.qr(tangent)[0]
        image = matrix @ tangent
        if np.abs(image - tangent @ (tangent.T @ image)).max(initial=0.0) <= INVARIANT * np.abs(matrix).max():
            break
        tangent = image
    return FieldAt(matrix, tangent, symmetric, residual, units, 1.0)


def _stage(equation: Any, t: float, h: float) -> _Stage:
    """The same object for equal equations, so that they are traced once."""
    return _stages.get((equation, t, h), lambda: _Stage(equation, t, h))


def _lift(system: AbstractSystem, layout: Layout, case: Case) -> np.ndarray:
    """The derivative of the scheme's state by (q, v): q, and p = ∂L/∂v. Raises `TypeError` for a state without them."""
    q, v = case.data["q"], case.data["v"]
    if not {"q", "p"} <= layout.keys():
        raise TypeError(f"the state of this scheme is {layout!r}, but a linearization needs one of q and p.")
    equations = equations_of(system.lagrangian_form(), case.t0)
    by_q, by_v = (np.asarray(x) for x in evaluated(equations.momentum, q, v, case.params))
    lift = np.zeros((layout.size, 2 * q.size))
    lift[layout.place("q"), : q.size] = np.eye(q.size)
    lift[layout.place("p")] = np.concatenate([by_q, by_v], axis=1)
    return lift
