"""The premise of compositions: a step is a map of the final manifold, or of the constraints, to itself."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dirax.engines.steps_in_numbers import StepsInNumbers
from dirax.numerics.tolerances import TINY
from dirax.program.graph import GraphTooLarge
from dirax.program.interpreter import UnsupportedPrimitive
from dirax.program.rounding import rounding
from dirax.program.user_functions import evaluated
from dirax.run.final_manifold import chain_at, on_chain, slope_of
from dirax.run.start import Initial, Start
from dirax.run.validate import Case
from dirax.schemes.step import first_of_each
from dirax.systems.shape import Shape
from dirax.systems.system import AbstractSystem

KEPT = 1e-9
"""How far off the manifold a step may take a point on it, relative to the state, where it keeps it."""


def refuse_leaving_final_manifold(
    system: AbstractSystem, equation: Any, shape: Shape, case: Case, initial: Initial, start: Start, singular: bool
) -> None:
    """Raise `ValueError` for a composition of steps that leave the final manifold of a singular Lagrangian, or the constraints of
    a system in x: the order of a composition is that of maps of the manifold to itself."""
    stages = equation.stages
    if len(stages) < 2 or case.two_points:
        return
    first = lambda a: np.asarray(a)[0] if case.batch is not None else np.asarray(a)
    state, guesses = first(start.state), [first(u) for u in start.guess]
    params = jax.tree.map(first, case.params) if case.batch_params else case.params
    if system.lagrangian_form() is None and system.manifold_form() is None and system.final_relation(shape) is None:
        if np.size(initial.defect) and (missed := _off_constraints(system, stages, state, guesses, case, params)):
            raise ValueError(
                "a composition raises the order of maps of the constraints to themselves, and a step of this scheme leaves those "
                f"of this {type(system).__name__}, by {missed:.2g} of their terms, which the next step turns into its opposite: "
                'compose dx.DiscreteDirac(constraints="resolve"), of dx.constraint_algorithm(…).resolved() where it asks for '
                "that, or pass check_initial=False to run this with the order that it has."
            )
        return
    if (not singular and system.final_relation(shape) is None) or "p" not in stages[0][0].fields:
        return
    q, v = first(initial.data["q"]), first(initial.data["v"])
    (stage, fraction), t = stages[0], case.t0 + stages[0][1] * case.h
    try:
        end, _ = _end_of(stage, state[None], guesses[0], case.t0, fraction * case.h, params)
        row = {name: a[0] for name, a in _end_of(stage, end, guesses[0], t, fraction * case.h, params)[1].items()}
    except (UnsupportedPrimitive, GraphTooLarge, ArithmeticError):  # no program of the step, or no solution
        return
    missed = _off(system, row, q, v, case.t0, t, params, singular)
    if missed > KEPT:
        raise ValueError(
            f"a composition raises the order of maps of the final manifold to itself, and a step of this scheme leaves that of "
            f"this {type(system).__name__}, by {missed:.2g} relative to the state (p = α(q) is kept for one-forms α "
            'that are linear): take constraints="resolve", or check_initial=False to run it at the order that it has.'
        )


TRIED = 4
"""Steps that are tried from the initial data."""

PUSHED, SHORT = 2.0**-17, 2.0**-4
"""How far a state is moved off the constraints, relative to its largest number, and by what part of a step, to see whether the
step turns what it is off into its opposite."""


def _off_constraints(system: AbstractSystem, stages: tuple, state: np.ndarray, guesses: list, case: Case, params: Any) -> float:
    """By how much of its terms a step leaves a constraint to which the next one comes back; 0 for none."""
    parts = [(stages[i][0], guesses[i]) for i in first_of_each(stages)]

    def after(states: np.ndarray, t: float, h: float) -> np.ndarray:
        for stage, u in parts:
            states, t = _end_of(stage, states, u, t, h / len(parts), params)[0], t + h / len(parts)
        return states

    def constraints(states: np.ndarray, t: float) -> np.ndarray:
        """The constraints at rows and the sizes of their terms, (2, states, k)."""
        rows = _end_of(parts[0][0], states, parts[0][1], t, SHORT * case.h, params)[1]
        one = lambda i: evaluated(_ConstraintTerms(system).at, {n: a[i] for n, a in rows.items()} | {"t": np.asarray(t)}, params)
        return np.stack([np.asarray(one(i)) for i in range(len(states))], axis=1)

    worst, t, short = 0.0, case.t0, case.t0 + SHORT * case.h
    push = PUSHED * np.where(state != 0, np.abs(state), np.max(np.abs(state), initial=0.0) or 1.0)
    try:
        (here, *near), _ = constraints(state + np.vstack([np.zeros(len(state)), np.diag(push)]), t)
        off = np.linalg.pinv((np.array(near) - here).T).T  # by rows, each off one of the constraints alone
        off *= push / np.max(np.abs(off), axis=1, keepdims=True, initial=TINY)
        starts = np.vstack([state, state + off])
        before, there = (a[1:] - a[0] for a in (constraints(starts, t)[0], constraints(after(starts, t, short - t), short)[0]))
        before, there = np.diag(before), np.diag(there)
        turned = np.abs(there + before) < 0.2 * np.abs(before)
        for _ in range(TRIED if np.any(turned) else 0):
            state, t = after(state[None], t, case.h)[0], t + case.h
            missed, terms = np.abs(constraints(state[None], t)[:, 0])
            worst = max(worst, float(np.max((missed / np.where(terms > 0, terms, 1.0))[turned])))
    except (UnsupportedPrimitive, GraphTooLarge, ArithmeticError, np.linalg.LinAlgError):  # no program of it, or no solution
        return 0.0
    return worst if worst > KEPT else 0.0


class _ConstraintTerms(eqx.Module):
    """The constraints of a system at a row (its node fields and the time), and the sizes of their terms."""

    system: AbstractSystem

    def at(self, row: dict, params: Any) -> Any:
        """(2, k)."""
        value = lambda *numbers: jnp.asarray(self.system.constraint_at(dict(zip(row, numbers, strict=True)), params))
        numbers = [jnp.asarray(a, float) for a in row.values()]
        return jnp.stack([value(*numbers), rounding(value, *numbers)])


def _off(system: AbstractSystem, row: dict, q, v, t0: float, t: float, params: Any, singular: bool) -> float:
    """How far a row is off the final manifold, relative to the row."""
    if not singular:
        value = np.asarray(evaluated(system.initial_defect, {**row, "t": np.asarray(t)}, params))
        return float(np.max(np.abs(value), initial=0.0) / (np.max(np.abs(row["p"])) or 1.0))
    chain = chain_at(system, q, v, t0, params)
    if chain is None or chain.empty:
        return 0.0
    x = on_chain(chain, row["q"], row["p"], v, t, params)
    value, slope = np.abs(np.asarray(chain.constraints(x, params))), np.asarray(evaluated(slope_of(chain), x, params))
    scale = np.max(np.abs(slope * chain.units), axis=1) * np.max(np.abs(x / chain.units))
    return float(np.max(value / np.where(scale > 0, scale, 1.0), initial=0.0))


def _end_of(
    stage: Any, states: np.ndarray, u: np.ndarray, t: float, h: float, params: Any
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The states (B, s) after one step of a stage, and the fields of nodes at the rows that the step leaves. Raises
    `UnsupportedPrimitive`, `GraphTooLarge`, and `ArithmeticError` where there is no solution."""
    steps, lanes = StepsInNumbers.of(stage, params, False), np.zeros(len(states), int)
    numbers, times = steps.parameters(params, None, lanes), np.full(len(states), t)
    made = steps.step(states, [np.tile(u, (len(states), 1))], times, h, numbers)
    if not np.all(made.good):
        raise ArithmeticError
    rows = steps.rows(made, times, h, numbers)
    return made.after, {name: rows[name] for name, about in stage.fields.items() if about.place == "node"}
