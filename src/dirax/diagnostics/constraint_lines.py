"""Lines of `dx.verify` on constraints and hidden constraints."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dirax.diagnostics.energy_lines import energy_terms
from dirax.diagnostics.judging import SAMPLED_ROWS, judged, of_lane, roundoff_limit, sampled_terms, spread, times_at, worst_place
from dirax.diagnostics.one_step import DiscreteSystem, discrete_system, over_rows
from dirax.diagnostics.report import NOT_CHECKED, Line
from dirax.schemes.discrete_dirac import DiscreteDirac
from dirax.solution.solution import Solution
from dirax.systems.dirac_system import DiracSystem
from dirax.systems.lagrange_dirac import LagrangeDirac
from dirax.systems.nonholonomic import as_lagrange_dirac


def constraint(sol: Solution, tolerance: float | None) -> Line | None:
    name = "constraint"
    try:
        residual = np.asarray(sol.constraint_residual())
    except ValueError as error:
        return Line(name, None, None, NOT_CHECKED, str(error))
    if residual.shape[-1] == 0:
        return None
    residual = np.abs(residual.reshape((-1, *residual.shape[-2:])))
    residual = np.where(np.isnan(residual), 0.0, residual)  # rows that were not reached
    values, residual = np.max(residual / _constraint_scale(sol), axis=-1), np.max(residual, axis=-1)
    steps = "constraint" in sol.fields
    given = int(steps and "q0" in sol.initial)  # the first pair was given, not computed
    if residual.shape[1] <= given:
        return Line(name, None, None, NOT_CHECKED, "no step was computed")
    values = values[:, given:]
    lane, row = worst_place(values)
    kind = "discrete constraint of each step" if steps else "constraint at each row"
    text = (
        f"{kind}, relative to its terms; at most {np.max(residual[:, given:]):.2g}, at t = {float(sol.t[row + given]):.6g}"
        f"{of_lane(sol, lane)}"
    )
    if redundant := sol.stats.get("redundant_constraints"):
        text += f"; {', '.join(f'number {i}' for i in redundant)} left out, following from the others"
    if given:
        text += f"; the pair given at the start is off by {np.max(residual[:, 0]):.2g}"
    method_one = isinstance(sol.scheme, DiscreteDirac) and sol.scheme.constraints == "discretize"
    if not steps and method_one and np.max(values) > roundoff_limit(tolerance, 1):
        text = f"Method 1 imposes it inside each step; at the rows it is off by {np.max(residual):.2g}"
        return Line(name, float(np.max(values)), None, NOT_CHECKED, text)
    return judged(sol, name, np.max(values, axis=1), roundoff_limit(tolerance, 1), text)


def hidden_constraint(sol: Solution, tolerance: float | None) -> Line | None:
    """G v + ∂g/∂t = 0 at every row, which the schemes with holonomic constraints impose on the saved momentum."""
    system = as_lagrange_dirac(sol.system)
    if not isinstance(system, LagrangeDirac) or system.holonomic is None or "constraint" not in sol.fields:
        return None
    items = (times_at(sol, np.arange(sol.rows)), jnp.asarray(sol.q), jnp.asarray(sol.p))
    values = over_rows(eqx.Partial(_hidden_terms, system), sol, items)
    scale = float(np.nanmax(values[..., 1])) or 1.0
    lane, row = worst_place(values[..., 0])
    text = f"∂g/∂q v + ∂g/∂t at each row, relative to its terms, worst at t = {float(sol.t[row]):.6g}{of_lane(sol, lane)}"
    return judged(sol, "hidden constraint", np.nanmax(values[..., 0], axis=1) / scale, roundoff_limit(tolerance, 1), text)


def _hidden_terms(system: LagrangeDirac, t, q, p, params: Any):
    """The largest |G v + ∂g/∂t|, and the largest of |∂(G v + ∂g/∂t)/∂(q, p)||(q, p)|."""

    def defect(q, p):
        return system.constraints.hidden_defect(t, q, system.inverse_legendre(q, p, params, t=t), params)

    of_q, of_p = jax.jacfwd(defect, argnums=(0, 1))(q, p)
    size = jnp.abs(of_q) @ jnp.abs(q) + jnp.abs(of_p) @ jnp.abs(p)
    return jnp.stack([jnp.max(jnp.abs(defect(q, p))), jnp.max(size)])


def _constraint_scale(sol: Solution) -> Any:
    """The size of the constraint's terms: |W||v| + |b| and |∂g/∂q||q| where the steps impose W v + b = 0 and g = 0, one number
    for all constraints or one for each; the largest saved number of a loaded solution, |dE||x| where the constraint is that
    dE be in the image of a Dirac structure; else from its derivative."""
    found = discrete_system(sol.system, sol.scheme, sol.step)
    if isinstance(found, DiscreteSystem):
        q = np.asarray(sol.q)
        speed = np.abs(np.diff(q, axis=-2)) / (sol.step * sol.save_every)
        speed = np.nanmax(speed, axis=tuple(range(speed.ndim - 1)), initial=0.0) + 1.0
        rows = spread(sol.rows, SAMPLED_ROWS)
        items = (times_at(sol, rows), q[..., rows, :])
        sizes = over_rows(eqx.Partial(_sizes_of_constraints, found, jnp.asarray(speed)), sol, items)
        nonholonomic, holonomic = np.nanmax(sizes[..., 0], axis=(0, 1)), np.nanmax(sizes[..., 1], axis=(0, 1))
        m = len(holonomic) if found.system.holonomic is None else _count_of_forms(sol)
        scale = np.where(np.arange(len(holonomic)) < m, np.max(nonholonomic[:m], initial=0.0), holonomic)
        return np.where(scale > 0, scale, 1.0)
    if sol.system is None:
        nodes = [np.asarray(a) for k, a in sol.fields.items() if sol.field_info[k].place == "node"]
        return float(max(1.0, *(np.nanmax(np.abs(a)) for a in nodes)))
    of_image = isinstance(sol.system, DiracSystem) and sol.system.holonomic is None
    terms = energy_terms if of_image else _constraint_terms
    return float(np.nanmax(sampled_terms(sol, terms))) or 1.0


def _sizes_of_constraints(discrete: DiscreteSystem, speed, t, q, params: Any):
    """The sizes of the terms of W v + b and of g, for each row of [W; ∂g/∂q], (m + c, 2)."""
    matrix, constraints = jnp.abs(discrete.matrix(t, q, params)), discrete.system.constraints
    along = matrix @ speed
    if constraints.affine is not None:
        b = jnp.abs(constraints.affine.at(t, q, params))
        along = along.at[: b.shape[0]].add(b)
    return jnp.stack([along, matrix @ jnp.abs(q)], axis=1)


def _count_of_forms(sol: Solution) -> int:
    """m, the number of one-forms."""
    q, forms = jnp.asarray(sol.q).reshape(-1, np.shape(sol.q)[-1])[0], sol.system.constraints
    params = jax.tree.map(lambda a: a[0], sol.params) if sol.batch_params else sol.params
    return forms.sizes(q, params)[0]


def _constraint_terms(system: Any, t, row: dict, params: Any):
    """Σ |∂c/∂row_i| |row_i|, the largest over the constraints c."""
    derivative = jax.jacfwd(lambda row: system.constraint_at({**row, "t": t}, params))(row)
    return jnp.max(sum(jnp.abs(derivative[name]) @ jnp.abs(row[name]) for name in row), initial=0.0)
