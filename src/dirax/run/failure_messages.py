"""Why a trajectory ended early, in words: which step, which equation, how near to singular."""

from collections.abc import Callable
from contextvars import ContextVar
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.engines.contract import NOT_FINITE, OK, TOO_LARGE, Outcome, Problem
from dirax.engines.following import FOLLOWED
from dirax.engines.sizes import Sizes
from dirax.engines.stage_in_numbers import InJax, InNumbers, in_numbers
from dirax.engines.steps_in_numbers import StepsInNumbers
from dirax.engines.stopping import STALLED
from dirax.numerics.equilibration import balanced_inverse, condition_number
from dirax.numerics.tolerances import EPSILON, LARGEST_CONDITION
from dirax.program.graph import GraphTooLarge
from dirax.program.roots import FEWEST_SPARSE, sparse_equations
from dirax.schemes.step import CLOCK
from dirax.systems.circuit import POTENTIAL

BACK = (
    ", in a part of the composition that goes back in time, in which what dissipates grows: take smaller steps, or a scheme of "
    "high order without such parts, dx.Collocation or dx.EnergyCollocation"
)
"""Of parts of negative length."""

SMALLER = "a smaller step may help"

COUNTS, NAMED = 0.1, 8
"""Part that an equation has in a direction for it to be named, and how many are named at most."""

NEARLY = 1e-9
"""Singular values that say no more of an unknown than that it floats."""

BOUNDLESS = 1e12
"""Changes by rounding, relative to the unknowns, that are those of a state which has grown beyond all bounds."""

INTERRUPTED = "interrupted by the user"
"""How the message of a run begins that Ctrl-C has ended."""

brief: ContextVar[bool] = ContextVar("brief", default=False)
"""Whether the failed step is not computed again to see where it breaks: of a million trajectories many may fail."""


def explain(problem: Problem, outcome: Outcome, lane: int, kept: int, sizes: Callable[[], Sizes]) -> str:
    """One or two sentences on the step at which trajectory `lane` failed, or on the interruption.

    `kept` counts the steps up to the last row that was kept; `sizes` gives those of the unknowns where the trajectories begin.
    """
    p, completed = problem, int(outcome.completed[lane])
    time_of = lambda steps: p.t0 + (p.first_step + steps) * p.h
    if CLOCK in (layout := p.equation.stages[0][0].state_layout):  # steps have lengths of their own
        reached = float(np.asarray(outcome.last_state[lane])[layout.place(CLOCK)][0])
        time_of = lambda steps: reached if steps == completed else np.nan
    rows = f"kept up to step {p.first_step + kept}" + f" (t = {time_of(kept):.6g})" * bool(np.isfinite(time_of(kept)))
    if int(outcome.status[lane]) == OK:
        return f"{INTERRUPTED}; {rows}."
    at = time_of(completed)
    reason = _by_status(outcome, lane) if brief.get() else _reason(p, outcome, lane, at, sizes) + _remark(p, outcome, lane, at)
    if kept == completed and outcome.unsaid is not None and outcome.unsaid[lane]:
        rows += ", whose momenta and multipliers are made of the step that failed too, and not to be trusted"
    return f"step {p.first_step + completed + 1} (from t = {at:.6g}) failed: {reason}; {rows}."


def in_few_words(*of_explain: Any) -> str:
    """`explain`, without computing the step again."""
    with_few = brief.set(True)
    try:
        return explain(*of_explain)
    finally:
        brief.reset(with_few)


def _by_status(outcome: Outcome, lane: int) -> str:
    not_finite = int(outcome.status[lane]) == NOT_FINITE
    diverged = "the new state is not finite: Newton's method diverged, or left the domain of the system's functions"
    return diverged if not_finite else "Newton's method did not converge"


def _remark(p: Problem, outcome: Outcome, lane: int, t: float) -> str:
    """What the first equation says of the place, after a semicolon."""
    params = jax.tree.map(lambda a: jnp.asarray(a[lane] if p.batch_params else a), p.params)
    stage, fraction = p.equation.stages[0]
    said = stage.remark(jnp.asarray(outcome.last_state[lane]), t, fraction * p.h, params)
    return f"; {said}" if said else ""


def _reason(p: Problem, outcome: Outcome, lane: int, t: float, sizes: Callable[[], Sizes]) -> str:
    """The stages of the failing step are replayed one by one, to see where it breaks."""
    params = jax.tree.map(lambda a: np.asarray(a[lane] if p.batch_params else a), p.params)
    state, last = np.asarray(outcome.last_state[lane]), np.asarray(outcome.last_unknowns[lane])
    if TOO_LARGE in outcome.notes.get("iteration", ""):
        return (
            "the fixed-point iteration of the stages did not converge: the equations are stiff for this step. "
            f"{TOO_LARGE}: take a smaller step, another scheme, or engine='xla', which may compile it for minutes"
        )
    alone = p.batch is None and len(p.equation.stages) == 1
    solved, known, of_lane = [], {}, [a[lane if p.batch is not None else ...] for a in sizes()]
    for (stage, fraction), size in zip(p.equation.stages, of_lane, strict=True):
        if id(stage) not in known:
            known[id(stage)] = in_numbers(stage, params)
        numbers, h = known[id(stage)], fraction * p.h
        guess = numbers.guess(state, last if len(last) == stage.unknowns else np.zeros(stage.unknowns), h)
        reason, u = _replay_newton(stage, numbers, guess, (state, t, h), params, size, p.max_iterations)
        back = BACK if h < 0.0 < p.h and not reason.endswith(SMALLER) else ""
        if reason:
            return reason + back + (_where_it_ends(numbers, guess, (state, t, h)) if reason.endswith(SMALLER) and alone else "")
        if floating := _floating(stage, numbers, u, (state, t, h)):
            return f"Newton did not converge from the values extrapolated from the steps before{floating}{back}"
        solved.append((stage, numbers, guess, (state, t, h), size))
        state, t = numbers.advance(u, state, t, h), t + h
        if not np.all(np.isfinite(state)):
            return "the new state is not finite: it has left the domain of the system's functions, or overflowed"
    advice = next((found for place in solved if (found := _advice(*place)) != SMALLER), SMALLER)
    ends = _where_it_ends(*solved[0][1:4]) if alone and advice == SMALLER and solved else ""
    return f"Newton did not converge from the values extrapolated from the steps before: {advice}{ends}"


def _replay_newton(stage, numbers: InNumbers | InJax, guess, args, params, sizes, max_iterations: int):
    """(what went wrong or nothing, unknowns) of one stage, whose unknowns have these sizes."""
    u = guess
    if not stage.unknowns:
        return "", u
    linearized = _sparse(stage, (*args, params)) or _dense(numbers, args)
    update, worst, condition = np.inf, 0, np.nan
    for iteration in range(max_iterations):
        residual, broken, solve, condition = linearized(u)
        if np.any(broken):
            label = stage.labels[int(np.argmax(broken))]
            return f"{label} is not finite (outside the domain of the system's functions) in Newton iteration {iteration + 1}", u
        worst = int(np.argmax(np.abs(residual)))
        if not condition < LARGEST_CONDITION:
            named = (
                stage.unknowns < FEWEST_SPARSE and args[2] > 0.0
            )  # back in time it may be singular where nothing is undetermined
            dependent = _dependent(stage, numbers.linearized(u, *args)[1]) if named else ""
            return f"the Jacobian of the step is singular (condition number {condition:.2g}){dependent}", u
        change = solve(residual)
        u = u - change
        update = np.max(np.abs(change) / (np.abs(u) + sizes))
    if update < STALLED:
        return "", u
    return (
        f"Newton did not converge in {max_iterations} iterations (largest residual in {stage.labels[worst]}, "
        f"condition number {condition:.2g}): {_advice(stage, numbers, guess, args, sizes + np.abs(u))}"
    ), u


def _dependent(stage, jacobian: np.ndarray) -> str:
    """Which equations of a step depend on each other, and the way out for nodes of a circuit."""
    names = _in_null_space(stage, jacobian, EPSILON)
    return _of_nodes(names) or (f": nothing tells these equations apart, {', '.join(names)}" if names else "")


def _floating(stage, numbers: InNumbers | InJax, u, args) -> str:
    """Which nodes of a circuit have a potential that next to nothing determines, and the way out."""
    if stage.unknowns >= FEWEST_SPARSE or not any(label.startswith(POTENTIAL) for label in stage.labels):
        return ""
    return _of_nodes(_in_null_space(stage, numbers.linearized(u, *args)[1], NEARLY))


def _in_null_space(stage, jacobian: np.ndarray, tolerance: float) -> list[str]:
    """The labels of equations that depend on each other; none of too many to be named."""
    rows = np.abs(jacobian).max(axis=1, keepdims=True)
    left, values, _ = np.linalg.svd(jacobian / np.where(rows > 0.0, rows, 1.0))
    null = left[:, values <= len(values) * tolerance * values.max(initial=0.0)]
    names = [stage.labels[i] for i in np.flatnonzero(np.abs(null).max(axis=1, initial=0.0) > COUNTS)]
    return names if len(names) <= NAMED else []


def _of_nodes(names: list[str]) -> str:
    nodes = [name.removeprefix(POTENTIAL) for name in names if name.startswith(POTENTIAL)]
    if not nodes:
        return ""
    return (
        f": nothing determines the potential of {'nodes' if len(nodes) > 1 else 'node'} {', '.join(nodes)}, to which no current "
        "flows that depends on it; put a large resistor beside an element that blocks, or from there to the ground"
    )


def _where_it_ends(numbers: InNumbers | InJax, guess, args) -> str:
    """Whether there is a solution, found from easier equations on."""
    state, t, h = args
    if not 0 < len(guess) <= FOLLOWED or not isinstance(numbers, InNumbers):
        return ""
    one = lambda a: np.asarray(a, float)[None]
    of_step = one(t), one(h), one(numbers.params)
    try:
        part = float(StepsInNumbers.of_program(numbers.step).followed(0, one(guess), one(state), of_step, True)[1][0])
    except GraphTooLarge:
        return ""
    if part == 0.0:
        return ""
    if part == 1.0:
        return (
            " (there is a solution, to which those of easier equations lead, but not Newton's method from these values; they are "
            "followed in 16 steps and one in eight, where max_iterations is not below 8)"
        )
    return f" (the solutions of shorter steps lead to h = {part * h:.3g} and turn back there: longer ones have none near)"


def _dense(numbers: InNumbers | InJax, args) -> Callable:
    """u ↦ (residual, which rows of it or of its Jacobian are not finite, solution with the Jacobian, its condition number)."""

    def linearized(u):
        residual, jacobian = numbers.linearized(u, *args)
        broken = ~np.isfinite(residual) | ~np.all(np.isfinite(jacobian), axis=1)
        condition = np.inf if np.any(broken) else float(condition_number(jacobian))
        return residual, broken, lambda right: np.linalg.lstsq(jacobian, right)[0], condition

    return linearized


def _sparse(stage, args) -> Callable | None:
    """The same of many unknowns with a sparse Jacobian; None of others."""
    equations = sparse_equations(stage.residual, jax.ShapeDtypeStruct((stage.unknowns,), float), *args)
    if equations is None:
        return None
    from dirax.numerics.sparse.ranks import smallest_singular_value  # imported when it is used

    def both(u):
        residual = lambda u: stage.residual(u, *args)
        return residual(u), equations.values(residual, u)

    evaluate = jax.jit(both)

    def linearized(u):
        residual, values = (np.asarray(a) for a in evaluate(u))
        matrix = equations.matrix(values)
        broken = ~np.isfinite(residual) | ~np.isfinite(matrix @ np.ones(len(residual)))
        if np.any(broken):
            return residual, broken, None, np.inf
        smallest, _ = smallest_singular_value(equations, matrix)
        return residual, broken, equations.in_numpy(values), np.max(np.abs(matrix.data)) / smallest

    return linearized


def _advice(stage, numbers: InNumbers | InJax, u, args, sizes) -> str:
    """What to do about a stage without a root: a larger step where roundoff hides it, and hides less of it in a larger one."""
    state, t, h = args
    if not 0 < stage.unknowns < FEWEST_SPARSE:
        return SMALLER
    try:
        here, there = (_roundoff(numbers, u, (state, t, step), sizes) for step in (h, 10 * h))
    except GraphTooLarge:  # so large a step is run without these derivatives
        return SMALLER
    hidden = (here > STALLED) & (there < here / 2) & (here < BOUNDLESS)
    if not np.any(hidden):
        return SMALLER
    here = np.max(here[hidden])
    return (
        f"the step h = {float(h):.3g} is too small for double precision, in which the rounding of the state and of the unknowns "
        f"changes these by {here:.1g} of their size: take a larger step"
    )


@np.errstate(all="ignore")
def _roundoff(numbers: InNumbers | InJax, u, args, sizes) -> np.ndarray:
    """The change of each unknown, relative to their size, that follows from a last place of every number that the residual
    is a function of."""
    by_u, by_state = numbers.slopes(u, *args)
    left = np.abs(by_u) @ np.abs(u) + np.abs(by_state) @ np.abs(args[0])
    if not (np.all(np.isfinite(by_u)) and np.all(np.isfinite(left)) and condition_number(by_u) < LARGEST_CONDITION):
        return np.full(len(u), np.inf)
    return EPSILON * np.abs(balanced_inverse(by_u)) @ left / (np.abs(u) + sizes)
