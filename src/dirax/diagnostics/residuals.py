"""The size of the terms of a step's equations, to which a residual is relative."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from dirax.diagnostics.rows import over_rows, times_at
from dirax.diagnostics.verdicts import spread
from dirax.engines.step_program import linearized
from dirax.schemes.step_forms import started
from dirax.solution.solution import Solution

ROWS = 4
"""Rows of the first trajectory at which they are taken."""


def residual_size(sol: Solution) -> float | None:
    """The largest Σ |∂r/∂u_j| |u_j| of the first part of a step that leaves a saved row; None where no step can be started
    from one, and for explicit schemes."""
    if sol.system is None or sol.equation is None or not sol.equation.stages[0][0].unknowns:
        return None
    stage, fraction = sol.equation.stages[0]
    rows = spread(sol.rows, ROWS).astype(int)
    nodes = {name: np.asarray(a) for name, a in sol.fields.items() if sol.field_info[name].place == "node"}
    at = {name: np.take(a, rows, axis=int(sol.batch is not None)) for name, a in nodes.items()}
    at["t"] = times_at(sol, rows)
    times = np.atleast_2d(at["t"])[0]
    try:
        begun = over_rows(eqx.Partial(_started, sol.system, sol.step, sol.equation), sol, (at,))[0]
    except (KeyError, TypeError, ValueError):  # the scheme does not start from a saved row
        return None
    sizes, params = [], sol.params_of_one
    for begin, t in zip(begun[np.all(np.isfinite(begun), axis=1)], times, strict=False):
        state, u = begin[None, : stage.state_size], begin[None, stage.state_size :]
        found = linearized(stage, params, False, u, state, np.array([t]), np.full(1, fraction * sol.step))
        if found is None:
            return None
        sizes.append(float(np.max(np.abs(found[1][0]) @ np.abs(u[0]))))
    size = max((s for s in sizes if np.isfinite(s)), default=0.0)
    return size or None


def _started(system: Any, step: Any, equation: Any, rows: dict, params: Any):
    return jnp.concatenate(started(system, step, equation, {name: a[None] for name, a in rows.items()}, params))
