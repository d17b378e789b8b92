"""Why a trajectory ended early, in words: which step, which equation, how near to singular."""

import jax
import jax.numpy as jnp
import numpy as np

from dirax.engines.result import OK, Outcome, Problem

SINGULAR = 1e15
"""Condition number from which a Jacobian counts as singular."""


def explain(problem: Problem, outcome: Outcome, lane: int, kept: int | None = None) -> str:
    """One or two sentences on the step at which trajectory `lane` failed, or on the interruption.

    `kept` counts the steps up to the last row that was kept: all good ones by default.
    """
    p, completed = problem, int(outcome.completed[lane])
    time_of = lambda steps: p.t0 + (p.first_step + steps) * p.h
    kept = completed if kept is None else kept
    rows = f"kept up to step {p.first_step + kept} (t = {time_of(kept):.6g})"
    if int(outcome.status[lane]) == OK:
        return f"interrupted by the user; {rows}."
    reason = _reason(p, outcome, lane, time_of(completed))
    return f"step {p.first_step + completed + 1} (from t = {time_of(completed):.6g}) failed: {reason}; {rows}."


def _reason(p: Problem, outcome: Outcome, lane: int, t: float) -> str:
    """The stages of the failing step are replayed one by one, to see where it breaks."""
    params = jax.tree.map(lambda a: a[lane], p.params) if p.batch_params else p.params
    state, last = jnp.asarray(outcome.last_state[lane]), jnp.asarray(outcome.last_unknowns[lane])
    for stage, fraction in p.equation.stages:
        args = (state, jnp.asarray(t), fraction * p.h, params)
        u = jnp.asarray(stage.guess(state, last if len(last) == stage.unknowns else jnp.zeros(stage.unknowns), *args[2:]))
        reason, u = _replay_newton(stage, u, args, p.max_iterations)
        if reason:
            return reason
        state, t = stage.advance(u, *args), t + fraction * p.h
        if not np.all(np.isfinite(state)):
            return "the new state is not finite: it has left the domain of the system's functions, or overflowed"
    return "Newton did not converge from the values extrapolated from the steps before: a smaller step may help"


def _replay_newton(stage, u, args, max_iterations: int):
    """(what went wrong or nothing, unknowns) of one stage."""
    if not stage.unknowns:
        return "", u
    evaluate = jax.jit(lambda u: (stage.residual(u, *args), jax.jacfwd(stage.residual)(u, *args)))
    size, worst, condition = np.inf, 0, np.nan
    for iteration in range(max_iterations):
        residual, jacobian = (np.asarray(a) for a in evaluate(u))
        broken = ~np.isfinite(residual) | ~np.all(np.isfinite(jacobian), axis=1)
        if np.any(broken):
            label = stage.labels[int(np.argmax(broken))]
            return f"{label} is not finite (outside the domain of the system's functions) in Newton iteration {iteration + 1}", u
        worst, condition = int(np.argmax(np.abs(residual))), np.linalg.cond(jacobian)
        if not condition < SINGULAR:
            return f"the Jacobian of the step is singular (condition number {condition:.2g})", u
        change = np.linalg.solve(jacobian, residual)
        u, size = u - change, np.max(np.abs(change) / (np.abs(u) + np.asarray(stage.scale)))
    if size < 1e-9:
        return "", u
    return (
        f"Newton did not converge in {max_iterations} iterations (largest residual in {stage.labels[worst]}, "
        f"condition number {condition:.2g}): a smaller step may help"
    ), u
