"""The line of `dx.verify` on the points of manifolds and elements of groups that a solution holds."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from dirax.diagnostics.report import Line
from dirax.diagnostics.rows import over_rows
from dirax.diagnostics.verdicts import judged, of_lane, roundoff_limit, worst_place
from dirax.geometry.manifolds import AbstractManifold
from dirax.program.user_functions import evaluated
from dirax.solution.solution import Solution


def points(sol: Solution, tolerance: float | None) -> Line | None:
    """How far the points in the rows are off the manifolds that they belong to, relative to their coordinates: by roundoff, or by
    what the initial data were. None for a solution that holds no such points."""
    manifolds = {} if sol.system is None else sol.system.manifolds
    curved = {name: manifold for name, manifold in manifolds.items() if manifold.dimension < manifold.ambient_dimension}
    held = [name for name in curved if name in sol.fields]
    if not held:
        return None
    off, limit = [], max(roundoff_limit(tolerance, 1), 2.0 * _given(sol, curved))
    for name in held:
        found = over_rows(eqx.Partial(_defects, curved[name]), sol, (np.asarray(sol.fields[name]),))
        size = float(np.nanmax(found[..., 2], initial=0.0)) or 1.0
        off.append(np.nan_to_num(found[..., 0]) / size)
        limit = max(limit, 2.0 * float(np.nanmax(found[..., 1], initial=0.0)) / size)
    worst = int(np.argmax([np.max(values) for values in off]))
    lane, row = worst_place(off[worst])
    where = f"worst {held[worst]} at t = {sol.time_of(row, lane):.6g}{of_lane(sol, lane)}"
    text = f"how far {' and '.join(held)} of each row are off them; {where}"
    return judged(sol, "points on their manifolds", np.max(off, axis=(0, 2)), limit, text)


def _defects(manifold: AbstractManifold, x, params):
    """How far x is off a manifold, how far the nearest point of it is by roundoff, and how large x is."""
    return jnp.stack([manifold.defect(x), manifold.defect(manifold.nearest(x)), jnp.max(jnp.abs(x))])


def _given(sol: Solution, manifolds: dict[str, AbstractManifold]) -> float:
    """How far the points of the initial data, q, or q0 and q1, are off their manifolds."""
    given = ((manifolds.get(name.rstrip("01")), np.asarray(a)) for name, a in sol.initial.items())
    off = [evaluated(manifold.defect, x) for manifold, a in given if manifold for x in a.reshape(-1, a.shape[-1])]
    return float(max(off, default=0.0))
