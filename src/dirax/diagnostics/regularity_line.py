"""Line of `dx.verify` on places where the Lagrangian is singular, over which no motion goes, but a step may."""

from typing import Any

import jax
import numpy as np

from dirax.diagnostics.report import VIOLATED, Line
from dirax.diagnostics.rows import at_rows, over_rows, row_numbers
from dirax.diagnostics.verdicts import of_lane, spread
from dirax.program.evaluation.functions import program_at
from dirax.program.user_functions import evaluated
from dirax.run.final_manifold import MOST
from dirax.solution.solution import Solution

ROWS, MOST_NUMBERS = 512, 2**20
"""Rows that are asked of all trajectories together, evenly spread, and the numbers of their matrices."""

SURE = 1e-7
"""Eigenvalues that are smaller, relative to the largest of a matrix with units of its own, have no sign."""


def regularity(sol: Solution) -> Line | None:
    """Between which rows ∂²L/∂v², on the velocities that the constraints allow, gets another number of negative eigenvalues; None
    where it gets none, and where that cannot be said."""
    if (
        sol.system is None
        or (form := sol.system.lagrangian_form()) is None
        or "q" not in sol.fields
        or row_numbers(sol) > 2 * MOST
    ):
        return None
    lanes, n = sol.batch or 1, sol.q.shape[-1]
    each = max(2, min(sol.rows, ROWS // lanes, MOST_NUMBERS // (n * n * lanes)))
    rows = spread(sol.rows, each)
    t, q = np.array([[sol.time_of(row, lane) for row in rows] for lane in range(lanes)]), _of_rows(sol, sol.fields["q"], rows)
    params = _of_lanes(sol, lanes)
    program = program_at(sol.system.velocity_hessian, (t[0, 0], q[0, 0], q[0, 0], jax.tree.map(lambda leaf: leaf[0], params)))
    if program is None or program.opaque or not program.depends_on(*program.inputs[:3]):
        return None
    v = np.zeros_like(q)
    if program.depends_on(program.inputs[2]):
        if "p" not in sol.fields:
            return None
        nodes = {
            name: _of_rows(sol, a, rows) if sol.batch is not None else np.asarray(a)[rows] for name, a in sol.row_fields.items()
        }
        v = over_rows(at_rows(sol, _velocity, form), sol, (nodes,))
    flat = lambda a: np.asarray(a).reshape(-1, *np.shape(a)[2:])
    repeated = [np.repeat(np.asarray(leaf, float), len(rows), axis=0) for leaf in jax.tree.leaves(params)]
    hessian = program.in_numpy([flat(t), flat(q), flat(v), *repeated])[0]
    negative = _negative(hessian)
    if np.all(negative == 0):
        return None
    if form.constraints.any:
        matrix = lambda entry: np.asarray(
            evaluated(
                form.constraints.matrix, flat(t)[entry], flat(q)[entry], jax.tree.map(lambda a: a[entry // len(rows)], params)
            )
        )
        rows_of = np.stack([matrix(entry) for entry in range(len(hessian))])
        zero = np.zeros((len(hessian), rows_of.shape[1], rows_of.shape[1]))
        negative = _negative(np.block([[hessian, np.swapaxes(rows_of, 1, 2)], [rows_of, zero]]))
    return _line(sol, rows, negative.reshape(lanes, -1))


def _line(sol: Solution, rows: np.ndarray, negative: np.ndarray) -> Line | None:
    for lane, numbers in enumerate(negative):
        known = np.flatnonzero(numbers >= 0)
        changed = np.flatnonzero(np.diff(numbers[known]))
        if changed.size:
            before, after = (sol.time_of(int(rows[known[changed[0] + i]]), lane) for i in (0, 1))
            text = (
                f"between t = {before:.6g} and {after:.6g}{of_lane(sol, lane)} the run steps over a place where ∂²L/∂v² is "
                "singular (an eigenvalue changes its sign): no motion goes on there, and what follows is none of this system; "
                "end the run before, by an event"
            )
            return Line("regular Lagrangian", None, None, VIOLATED, text)
    return None


def _of_rows(sol: Solution, values: Any, rows: np.ndarray) -> np.ndarray:
    """Rows of a field, with an axis of the batch."""
    return (np.asarray(values, float)[None] if sol.batch is None else np.asarray(values, float))[:, rows]


def _of_lanes(sol: Solution, lanes: int) -> Any:
    """The params of each trajectory, with that axis."""
    if sol.batch_params:
        return jax.tree.map(np.asarray, sol.given_params)
    return jax.tree.map(lambda leaf: np.broadcast_to(np.asarray(leaf), (lanes, *np.shape(leaf))), sol.given_params)


def _velocity(form: Any, row: dict, params: Any):
    return form.inverse_legendre(row["q"], row["p"], params, row.get("about"), row["t"])


def _negative(matrices: np.ndarray) -> np.ndarray:
    """How many negative eigenvalues symmetric matrices (entries, k, k) have, in units of their own; −1 where that is not sure."""
    with np.errstate(all="ignore"):
        scale = 1.0 / np.sqrt(np.max(np.abs(matrices), axis=2))
        matrices = matrices * scale[:, :, None] * scale[:, None]
    good = np.all(np.isfinite(matrices), axis=(1, 2))
    found = np.full(len(matrices), -1)
    if np.any(good):
        values = np.linalg.eigvalsh(matrices[good])
        sure = np.min(np.abs(values), axis=1) > SURE * np.max(np.abs(values), axis=1)
        found[good] = np.where(sure, np.sum(values < 0, axis=1), -1)
    return found
