"""The derivative of one step of a scheme at a relative equilibrium."""

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from dirax.diagnostics.equations_of_motion import equations_of
from dirax.diagnostics.linearized_field import FieldAt, filled, scaled_matrix
from dirax.engines.lifted import lifted
from dirax.engines.steps_in_numbers import StepsInNumbers
from dirax.numerics.equilibration import balanced_inverse
from dirax.numerics.newton import AT_FLOOR, sizes_of_unknowns
from dirax.numerics.tolerances import EPSILON
from dirax.program.memo import Memo, Same
from dirax.program.tracing import jacobian
from dirax.program.user_functions import evaluated
from dirax.run.redundancy import redundant_constraints
from dirax.run.start import begun, completed
from dirax.run.validate import Case, validated_case
from dirax.schemes.collision_step import SUMS
from dirax.schemes.layout import Layout
from dirax.schemes.step import CLOCK, AbstractScheme, make_step_equation
from dirax.schemes.work_of_forces import BEYOND
from dirax.systems.shape import Shape
from dirax.systems.system import AbstractSystem

INVARIANT = 1e-8
"""How far, relative to its entries, the derivative of a step may lead out of the tangent space of the discrete constraints."""

RANK = 1e-12
"""Singular values of linear equations, relative to the largest one, that count as zero."""

OF_MULTIPLIERS = 2e-14
"""Error of a step's derivative where there are constraints, times the step: roundoff of multipliers grows as 1/h, as measured."""

TRIES = 8
STEPS = 30


class _Stage:
    """One equation of a step, with its derivatives."""

    def __init__(self, system: AbstractSystem, equation: Any, t: float, h: float):
        self.system, self.equation, self.t, self.h = system, equation, t, h

    def lift(self, q: Any, v: Any, params: Any) -> Any:
        """The derivative by (q, v) of the state with which the scheme starts there."""

        def begun(z):
            (q, v), t = jnp.split(z, 2), jnp.asarray(self.t, float)
            complete = self.system.complete({"q": q, "v": v, "t": t}, params, False)
            return self.equation.start({**complete, "t": t}, self.h, params)[0]

        return jacobian(begun)(jnp.concatenate([q, v]))

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
    if CLOCK in equation.fields:
        raise TypeError(
            f"dx.{type(scheme).__name__} has steps of their own length, whose clock goes on at an equilibrium too: linearize a "
            "step of the scheme in it."
        )
    equation = lifted(equation, case.params, case.batch_params)
    began = begun(equation, case, initial)
    first = np.asarray(began.state)
    layout = equation.stages[0][0].state_layout
    stages, time = [], case.t0
    for stage, fraction in equation.stages:
        stages.append(_stage(system, stage, time, fraction * h))
        time += fraction * h
    lift = _lift(stages[0], layout, case)
    state, matrix = _stepped(equation, stages, first, list(map(np.asarray, began.guess)), case)
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
    error = OF_MULTIPLIERS / abs(h * field.rate) if tangent.shape[1] < field.matrix.shape[1] else 0.0
    return FieldAt(matrix, _kept(matrix, tangent), symmetric, residual, units, 1.0, error)


def _stepped(equation: Any, stages: list, state: np.ndarray, guesses: list, case: Case) -> tuple[np.ndarray, np.ndarray]:
    """The state after a step and its derivative by this one: by the scalar program of the step, where there is one."""
    if (steps := StepsInNumbers.found(equation, case.params, False)) is not None:
        t, one = np.array([case.t0]), np.zeros(1, int)
        params = steps.parameters(case.params, None, one)
        made = steps.step(state[None], [guess[None] for guess in guesses], t, case.h, params)
        if made.good[0]:
            return made.after[0], steps.differentiated(made, t, case.h, params)[0][0]
    matrix = np.eye(state.size)
    for stage, guess in zip(stages, guesses, strict=True):
        state, slope = stage.step(state, guess, case.params)
        matrix = slope @ matrix
    return state, matrix


def _kept(matrix: np.ndarray, tangent: np.ndarray) -> np.ndarray:
    """The space near the span of the columns of `tangent` that a step keeps; what is left after TRIES where there is none.

    Images come to it where what lies across it dies away. Else, as with multipliers in the state, the span T leans to it by X in
    directions Q across, M (T + Q X) = (T + Q X) B, which Newton's method finds: QᵀMQ X − X TᵀMT = −QᵀMT.
    """
    size, d = np.abs(matrix).max(), tangent.shape[1]
    best, least = tangent, np.inf
    for attempt in range(2 * TRIES + 1):
        if attempt == TRIES:
            tangent = best
        whole = np.linalg.qr(tangent, mode="complete")[0]
        tangent, across = whole[:, :d], whole[:, d:]
        image = matrix @ tangent
        outside = across.T @ image
        off = np.abs(across @ outside).max(initial=0.0)
        nearer = off < least
        if nearer:
            best, least = tangent, off
        if off <= EPSILON * size or (attempt > TRIES and not nearer and least <= INVARIANT * size):
            break
        if attempt < TRIES:
            tangent = image
            continue
        equations = np.kron(across.T @ matrix @ across, np.eye(d)) - np.kron(np.eye(len(outside)), (tangent.T @ image).T)
        lean = np.linalg.lstsq(equations, -outside.ravel(), rcond=RANK)[0]
        tangent = tangent + across @ lean.reshape(outside.shape)
    return best


def _stage(system: AbstractSystem, equation: Any, t: float, h: float) -> _Stage:
    """The same object for an equation that is one of those kept, so that it is traced once."""
    return _stages.get((system, Same(equation), t, h), lambda: _Stage(system, equation, t, h))


def _lift(stage: _Stage, layout: Layout, case: Case) -> np.ndarray:
    """The derivative of the scheme's state by (q, v): q, p = ∂L/∂v, and the rest, but for what no step reads, as where it
    starts. Raises `TypeError` for a state without q and p."""
    q, v = case.data["q"], case.data["v"]
    if not {"q", "p"} <= layout.keys():
        raise TypeError(f"the state of this scheme is {layout!r}, but a linearization needs one of q and p.")
    equations = equations_of(stage.system.lagrangian_form(), case.t0)
    lift = np.zeros((layout.size, 2 * q.size))
    if any(np.prod(layout[name]) for name in layout.keys() - {"q", "p", BEYOND, *SUMS}):
        lift[:] = evaluated(stage.lift, q, v, case.params)
    lift[layout.place("q")] = np.eye(q.size, 2 * q.size)
    lift[layout.place("p")] = np.concatenate(evaluated(equations.momentum, q, v, case.params), axis=1)
    return lift
