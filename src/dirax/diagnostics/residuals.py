"""The size of the terms of a step's equations, to which a residual is relative."""

from typing import Any

import equinox as eqx
import jax
import numpy as np

from dirax.diagnostics.judging import spread
from dirax.engines.step_program import linearized
from dirax.program.user_functions import evaluated
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
    lane = lambda a: np.asarray(a) if sol.batch is None else np.asarray(a)[0]
    nodes = {name: lane(a) for name, a in sol.fields.items() if sol.field_info[name].place == "node"}
    begin, sizes = eqx.Partial(_started, sol.system, sol.step, sol.equation), []
    for row in spread(sol.rows, ROWS):
        at = {name: a[row : row + 1] for name, a in nodes.items()} | {"t": np.asarray(sol.t)[row : row + 1]}
        if not all(np.all(np.isfinite(a)) for a in at.values()):
            continue
        try:
            state, u = map(np.asarray, evaluated(begin, at, sol.params_of_one))
        except (KeyError, TypeError, ValueError):  # the scheme does not start from a saved row
            return None
        entries = u[None], state[None], at["t"], np.full(1, fraction * sol.step)
        found = linearized(stage, jax.tree.map(np.asarray, sol.params_of_one), False, *entries)
        if found is None:
            return None
        sizes.append(float(np.max(np.abs(found[1][0]) @ np.abs(u))))
    size = max((s for s in sizes if np.isfinite(s)), default=0.0)
    return size or None


def _started(system: Any, step: Any, equation: Any, rows: dict, params: Any):
    return started(system, step, equation, rows, params)
