"""Why a trajectory ended early, in words: which step, which equation, how near to singular."""

import jax
import jax.numpy as jnp
import numpy as np

from dirax.engines.result import NOT_CONVERGED, OK, Outcome, Problem


def explain(problem: Problem, outcome: Outcome, lane: int) -> str:
    """One or two sentences on the failing step of trajectory `lane`, or on the interruption."""
    completed = int(outcome.completed[lane])
    step = problem.first_step + completed
    time = problem.t0 + step * problem.h
    kept = f"kept up to step {step} (t = {time:.6g})"
    status = int(outcome.status[lane])
    if status == OK:
        return f"interrupted by the user; {kept}." if completed < problem.steps else ""
    stage, fraction = problem.equation.stages[0]
    params = jax.tree.map(lambda a: a[lane], problem.params) if problem.batch_params else problem.params
    h = fraction * problem.h
    u, state = jnp.asarray(outcome.last_unknowns[lane]), jnp.asarray(outcome.last_state[lane])
    args = (state, jnp.asarray(time), h, params)
    reason = (
        _reason(stage, u, args, status, problem.max_iterations) if stage.unknowns else "the new state is not finite"
    )
    return f"step {step + 1} (from t = {time:.6g}) failed: {reason}; {kept}."


def _reason(stage, u, args, status: int, max_iterations: int) -> str:
    """Newton is replayed from the unknowns of the step before, to see where it breaks."""
    evaluate = jax.jit(lambda u: (stage.residual(u, *args), jax.jacfwd(stage.residual)(u, *args)))
    worst, condition = 0, np.nan
    for iteration in range(max_iterations):
        residual, jacobian = (np.asarray(a) for a in evaluate(jnp.asarray(u)))
        broken = ~np.isfinite(residual) | ~np.all(np.isfinite(jacobian), axis=1)
        if np.any(broken):
            label = stage.labels[int(np.argmax(broken))]
            return (
                f"{label} is not finite (left the domain of the system's functions) in Newton iteration {iteration + 1}"
            )
        worst, condition = int(np.argmax(np.abs(residual))), np.linalg.cond(jacobian)
        if not condition < 1e15:
            return f"the Jacobian of the step is singular (condition number {condition:.2g})"
        change = np.linalg.solve(jacobian, residual)
        u = np.asarray(u) - change
    if status == NOT_CONVERGED:
        return (
            f"Newton did not converge in {max_iterations} iterations (largest residual in {stage.labels[worst]}, "
            f"condition number {condition:.2g}): a smaller step may help"
        )
    return "the new state is not finite"
