"""Lines of `dx.verify` on a Lie group: the Casimirs of the reduced motion, and the momentum seen from space."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dirax.diagnostics.report import NOT_CHECKED, Line
from dirax.diagnostics.rows import over_rows
from dirax.diagnostics.verdicts import judged, of_lane, relative_changes, roundoff_limit, steps_of
from dirax.geometry.group_retractions import coadjoint
from dirax.geometry.semidirect import SemidirectProduct
from dirax.numerics.ranks import numerical_rank
from dirax.numerics.tolerances import STRUCTURE_DEFECT
from dirax.reduction.casimirs import casimirs
from dirax.solution.solution import Solution


def casimir_lines(sol: Solution, tolerance: float | None) -> list[Line]:
    """The Casimirs and the spatial momentum of an Euler–Poincaré or Lie–Poisson run; with constraints, whose forces move μ,
    the Casimirs of a alone."""
    if sol.system is None or sol.system.dual is None or "x" not in sol.fields:
        return []
    space, constrained = sol.system.dual, _constrained(sol)
    lines, x = [], np.asarray(sol.fields["x"])
    for casimir in casimirs(space):
        if constrained and not casimir.carried:
            continue
        u, v = x[..., casimir.first], x[..., casimir.second]
        scale = np.linalg.norm(u, axis=-1) * np.linalg.norm(v, axis=-1)
        lines.append(_conserved(sol, f"Casimir {casimir.name}", np.sum(u * v, axis=-1)[..., None], scale, tolerance))
    return [*lines, *_spatial_momentum(sol, tolerance)]


def _spatial_momentum(sol: Solution, tolerance: float | None) -> list[Line]:
    """Ad*_{g⁻¹}μ, or its part along the directions that leave g·a alone."""
    space, name = sol.system.dual, "spatial momentum"
    where = next((key for key in ("g", "q") if key in sol.fields), None)
    if where is None:
        return []
    if _constrained(sol):
        return [Line(name, None, None, NOT_CHECKED, "the forces of the constraints change it")]
    items = (np.asarray(sol.fields[where]), np.asarray(sol.fields["x"]))
    values = over_rows(eqx.Partial(_seen_from_space, space), sol, items)
    momentum, size, directions = np.split(values, (1, 2), axis=2)
    momentum, size, directions = momentum[:, :, 0], size[:, :, 0], directions[:, 0]
    kept = [_isotropy(moved) for moved in directions]
    if not min(len(rows) for rows in kept):
        return [Line(name, None, None, NOT_CHECKED, "every motion of the group changes the advected quantities")]
    along = np.stack([m @ rows[: len(kept[0])].T for m, rows in zip(momentum, kept, strict=True)])
    text = "" if len(kept[0]) == space.dimension else f", along the {len(kept[0])} directions that leave g·a alone"
    return [_conserved(sol, name, along, np.linalg.norm(size, axis=-1), tolerance, text)]


def _seen_from_space(space: SemidirectProduct, g, x, params):
    """(Ad*_{g⁻¹}μ, the sums of the sizes of its terms) and the rows (d, r) by which the basis of the algebra moves g·a."""
    group, (momentum, a) = space.group, space.split(x)
    back = group.inverse(g)
    matrix = jax.jacfwd(lambda m: coadjoint(group, back, m))(momentum)
    a = space.act(g, a)
    moved = jnp.stack([space.infinitesimal(unit, a) for unit in jnp.eye(space.dimension)])
    return jnp.concatenate([(matrix @ momentum)[None], (jnp.abs(matrix) @ jnp.abs(momentum))[None], moved.T])


def _isotropy(moved: np.ndarray) -> np.ndarray:
    """Orthonormal rows that span the directions η with η·a = 0, given the columns by which the basis moves a (r, d)."""
    if not len(moved):
        return np.eye(moved.shape[1])
    _, sizes, directions = np.linalg.svd(moved)
    rank = int(numerical_rank(sizes, STRUCTURE_DEFECT))
    return directions[rank:]


def _conserved(sol: Solution, name: str, values: np.ndarray, scale: np.ndarray, tolerance: float | None, more: str = "") -> Line:
    """The line of values (…, rows, c) that should not change, relative to the largest scale (…, rows)."""
    values, scale = values.reshape(-1, *values.shape[-2:]), np.nanmax(scale.reshape(-1, scale.shape[-1]), axis=1)
    change, relative = relative_changes(values, scale)
    lane = int(np.argmax(relative))
    first = np.array2string(values[lane, 0], precision=6) if values.shape[-1] > 1 else f"{values[lane, 0, 0]:.6g}"
    text = f"{first} changed by at most {change[lane]:.2g}{more}{of_lane(sol, lane)}"
    return judged(sol, name, relative, roundoff_limit(tolerance, steps_of(sol)), text)


def _constrained(sol: Solution) -> bool:
    return "multipliers" in sol.fields
