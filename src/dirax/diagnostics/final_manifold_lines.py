"""Lines of `dx.verify` on the final manifold of a singular Lagrangian, and on solutions that jump to and fro across it."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from dirax.diagnostics.report import NOT_CHECKED, OK, VIOLATED, Line
from dirax.diagnostics.rows import initial_of_one, over_rows, shape_of, times_at
from dirax.diagnostics.verdicts import judged, of_lane, roundoff_limit, worst_place
from dirax.numerics.ranks import rank_of_equations
from dirax.numerics.tolerances import MANIFOLD_RANK
from dirax.program.tracing import jacobian
from dirax.program.user_functions import evaluated
from dirax.run.composition_premise import KEPT
from dirax.run.final_manifold import LOOKED_AT, MOST, VISIBLE, chain_at, left_manifold, moved_onto, slope_of
from dirax.schemes.index_premise import is_of_index_three
from dirax.solution.solution import Solution
from dirax.systems.constraint_algorithm import constraint_algorithm
from dirax.systems.constraint_chain import IRREGULAR, ConstraintChain

NOTICED = 1e-6
"""Jumps below this, relative to the positions, are not called so."""


def final_manifold(sol: Solution, tolerance: float | None) -> Line | None:
    """The constraints of M_f at every row of a run with a singular Lagrangian, or with a relation of x whose constraints are of
    index 3 or more; None for others."""
    if sol.system is not None and "x" in sol.fields:
        return _of_index_three(sol, tolerance)
    if sol.system is None or not {"q", "p"} <= sol.fields.keys() or sol.q.shape[-1] > MOST:
        return None
    chain = _chain_of(sol)
    if chain is None or chain.empty or len(chain.coordinates) - chain.clock != 2 * sol.q.shape[-1]:
        return None
    name, rows = "final manifold", np.arange(sol.rows)
    items = (times_at(sol, rows), np.asarray(sol.q), np.asarray(sol.p))
    found = over_rows(eqx.Partial(_defect, chain), sol, items)
    size = float(np.nanmax(found[..., 1])) or 1.0
    values = np.where(np.isnan(found[..., 0]), 0.0, found[..., 0]) / size
    lane, row = worst_place(values)
    text = f"the constraints of M_f at each row, worst at t = {sol.time_of(row, lane):.6g}{of_lane(sol, lane)}"
    line = judged(sol, name, np.max(values, axis=1), roundoff_limit(tolerance, 1), text)
    if line.verdict != VIOLATED:
        return line
    if _jumps(sol):
        text = f"the trajectory jumps from one solution of the discrete equations to the other, across M_f; {text}"
        return Line(name, line.value, line.tolerance, VIOLATED, text)
    if "q0" not in sol.initial and np.max(values[:, 0]) > KEPT:
        return Line(name, line.value, line.tolerance, VIOLATED, f"the run starts off it by {np.max(values[:, 0]):.2g}; {text}")
    if left := _left(sol, chain):
        return Line(name, line.value, line.tolerance, VIOLATED, left)
    text = f"the scheme imposes it inside each step, and not at the rows, which are off by {line.value:.2g}"
    return Line(name, line.value, None, NOT_CHECKED, text)


def _of_index_three(sol: Solution, tolerance: float | None) -> Line | None:
    """Of rows x, and of no multipliers, which those nearest to M_f stand for."""
    assert sol.system is not None
    first, n, params = initial_of_one(sol), sol.x.shape[-1], sol.params_of_one
    form = sol.system.relation_form(shape_of(sol))
    if form is None or not is_of_index_three(sol.system, form, n, first, params):
        return None
    rows = np.asarray(sol.x).reshape(-1, sol.rows, n)[0]
    try:
        chain = constraint_algorithm(sol.system, rows[0], params)
    except (TypeError, ValueError):
        return None
    if chain.empty or chain.verdict == IRREGULAR or chain.clock:
        return None
    pad = np.zeros(len(chain.coordinates) - n)
    asked = np.unique(np.linspace(0, len(rows) - 1, LOOKED_AT).astype(int))
    asked = asked[np.all(np.isfinite(rows[asked]), axis=1)]
    points = [moved_onto(chain, np.append(x, pad), slice(n, None), params) for x in rows[asked]]
    values = np.array([np.abs(np.asarray(chain.constraints(jnp.asarray(x), params))) for x in points])
    slopes = np.array([np.abs(np.asarray(evaluated(slope_of(chain), x, params))) @ np.abs(x) for x in points])
    sizes = np.max(slopes, axis=0)
    off = np.max(values / np.where(sizes > 0, sizes, 1.0), axis=1, initial=0.0)
    worst, limit = int(np.argmax(off)), roundoff_limit(tolerance, 1)
    value, first_of = float(off[worst]), " of the first trajectory" if sol.batch is not None else ""
    text = f"the constraints of M_f, the hidden ones too, worst at t = {sol.time_of(int(asked[worst])):.6g}{first_of}"
    if value <= limit:
        return Line("final manifold", value, limit, OK, text)
    if value > VISIBLE:
        return Line("final manifold", value, limit, VIOLATED, f"a constraint of index 3 hides others, which are not kept: {text}")
    return Line("final manifold", value, None, NOT_CHECKED, f"the scheme does not impose it: {text}")


def _left(sol: Solution, chain: ConstraintChain) -> str:
    """In words, that the first trajectory, about which the chain is, leaves M_f."""
    q, p = (np.asarray(sol.fields[name]).reshape(-1, *np.shape(sol.fields[name])[-2:])[0] for name in ("q", "p"))
    t = np.array([sol.time_of(row) for row in range(len(q))])
    good = np.all(np.isfinite(q), axis=1)
    return left_manifold(chain, t[good], q[good], p[good], initial_of_one(sol).get("v", np.zeros_like(q[0])), sol.params_of_one)


def _chain_of(sol: Solution) -> ConstraintChain | None:
    """The chain around the first row, None for a Lagrangian that is regular there."""
    assert sol.system is not None
    first = lambda name: np.asarray(sol.fields[name]).reshape(-1, *np.shape(sol.fields[name])[-2:])[0, 0]
    q, t, params = first("q"), sol.time_of(0), sol.params_of_one
    v = initial_of_one(sol).get("v", np.zeros_like(q))
    system = sol.system
    if system.lagrangian_form() is None or system.metric_form() is not None or system.final_relation(shape_of(sol)) is not None:
        return None
    hessian = np.asarray(evaluated(system.velocity_hessian, np.asarray(t), q, v, params))
    if rank_of_equations(hessian[None], MANIFOLD_RANK)[0][0] == len(q):
        return None
    return chain_at(sol.system, q, v, t, params)


def _defect(chain: ConstraintChain, t, q, p, params: Any):
    """The largest |φ| at a row, and of |∂φ| times the largest entry of the row, in the units of the chain."""
    x = jnp.concatenate([q, p, jnp.reshape(t, (1,))] if chain.clock else [q, p])
    slope = jacobian(lambda x: chain.constraints(x, params))(x)
    size = jnp.max(jnp.abs(slope * chain.units[None])) * jnp.max(jnp.abs(x / chain.units)[: q.size + p.size])
    return jnp.stack([jnp.max(jnp.abs(chain.constraints(x, params))), size])


def _jumps(sol: Solution) -> bool:
    """Whether a position goes to and fro from row to row by more than it moves in a step."""
    q = np.asarray(sol.q).reshape(-1, *np.shape(sol.q)[-2:])
    if sol.save_every != 1 or q.shape[1] < 4:
        return False
    turns, moves = np.abs(q[:, 2:] - 2 * q[:, 1:-1] + q[:, :-2]) / 4, np.abs(q[:, 2:] - q[:, :-2]) / 2
    turns, moves = np.nanmax(turns, axis=1), np.nanmax(moves, axis=1)
    return bool(np.any((turns > moves) & (turns > NOTICED * np.nanmax(np.abs(q), axis=1))))
