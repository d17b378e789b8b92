"""The symplecticity of single steps of a large system, in some directions: no matrix of all coordinates is formed."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.diagnostics.report import NOT_CHECKED, Line
from dirax.diagnostics.verdicts import judged, of_lane, roundoff_limit, spread
from dirax.engines.contract import Problem
from dirax.engines.policy import engine_of
from dirax.program.compiled import compiled
from dirax.program.memo import Same
from dirax.solution.solution import Solution
from dirax.solution.steps_again import begun_at

ROWS, PAIRS = 2, 2
"""Steps that are looked at, and pairs of random directions at each."""

GROWTH = 64
"""Roundings of sums of very many terms, relative to the sum of their sizes, at the least."""


def symplecticity_of_many(sol: Solution, name: str, tolerance: float | None) -> Line:
    """The line: by how much ω(Dφ u, Dφ w) differs from ω(u, w), relative to their terms, for random u and w."""
    none = lambda why: Line(name, None, None, NOT_CHECKED, why)
    if not all(stage.canonical for stage, _ in sol.equation.stages) or "multipliers" in sol.fields:
        return none(f"the derivative of a step is a matrix of {sol.equation.stages[0][0].state_size} numbers squared")
    if sol.has_own_times or sol.impacts is not None or "engine" not in sol.stats:
        return none("of a large system, only runs of equal steps are looked at")
    first = int("q0" in sol.initial)
    rows, lanes = first + spread(sol.rows - 1 - first, ROWS), spread(sol.batch or 1, ROWS)
    worst, where, rng = np.zeros(sol.batch or 1), "", np.random.default_rng(0)
    for lane in lanes.tolist():
        for row in rows.tolist():
            state, guess, t, params = begun_at(sol, lane, row)
            state, guess = jnp.asarray(state), tuple(map(jnp.asarray, guess))
            for _ in range(PAIRS):
                along = jnp.asarray(rng.normal(size=(2, state.shape[0])))
                numbers = (jnp.asarray(a, float) for a in (t, sol.step))
                defect = float(_defect(Same(sol.equation), sol.stats["engine"], state, guess, params, *numbers, along))
                if not np.isfinite(defect):
                    return none(f"the step from t = {t:.6g} has no solution from its saved row")
                if defect >= worst[lane]:
                    worst[lane], where = defect, f"t = {t:.6g}{of_lane(sol, lane)}"
    text = f"{PAIRS} pairs of random directions at {len(rows)} of {sol.rows - 1 - first} rows; worst at {where}"
    return judged(sol, name, worst, roundoff_limit(tolerance, GROWTH), text)


@compiled
def _defect(same: Same, engine: str, state: Any, guess: tuple, params: Any, t: Any, h: Any, along: Any) -> Any:
    """|ω(Dφ u, Dφ w) − ω(u, w)| relative to its terms, of the map φ of one step and of directions `along` (2, s)."""
    problem = Problem(same.object, state, guess, h, t, 1, params=params)

    def after(state):
        return engine_of(engine).run_traced(problem.with_numbers(state=state)).last_state[0]

    moved = jax.vmap(jax.linearize(after, state)[1])(along)

    def form(pair):
        (q, p), (r, s) = (jnp.split(one, 2) for one in pair)
        return jnp.sum(q * s - p * r), jnp.sum(jnp.abs(q * s) + jnp.abs(p * r))

    (one, size), (other, _) = form(moved), form(along)
    return jnp.abs(one - other) / size
