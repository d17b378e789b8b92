"""Lines of `dx.verify` on constraints and hidden constraints."""

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from dirax.diagnostics.replay_lines import moved_numbers
from dirax.diagnostics.report import NOT_CHECKED, Line
from dirax.diagnostics.rows import at_rows, constraint_at, constraint_of, energy_at, over_rows
from dirax.diagnostics.verdicts import judged, of_lane, roundoff_limit, sampled, sampled_terms, worst_place
from dirax.numerics.tolerances import TINY
from dirax.program.tracing import jacobian
from dirax.schemes.discrete_structure import AbstractDiscreteStructure
from dirax.solution.solution import Solution
from dirax.systems.lagrange_dirac import LagrangeDirac


def constraint(sol: Solution, structure: AbstractDiscreteStructure | str, tolerance: float | None) -> Line | None:
    """The line of the constraints at the nodes, or of those that a step imposes; None for a system without any."""
    name = "constraint"
    try:
        residual = constraint_of(sol)
    except ValueError as error:
        return Line(name, None, None, NOT_CHECKED, str(error))
    if residual.shape[-1] == 0:
        return None
    residual = np.abs(residual.reshape((math.prod(residual.shape[:-2]), *residual.shape[-2:])))
    given = int("constraint" in sol.fields and "q0" in sol.initial)  # the first pair was given, not computed
    if np.all(np.isnan(residual[:, given:])):
        return Line(name, None, None, NOT_CHECKED, "no step was computed")
    residual = np.where(np.isnan(residual), 0.0, residual)  # rows that were not reached
    scale, redundant = _constraint_scale(sol, structure, residual.shape[-1]), list(sol.stats.get("redundant_constraints", ()))
    scale = np.broadcast_to(scale, residual.shape[-1:]).copy()
    scale[redundant] = np.max(scale)  # what follows from the others has their roundoff
    steps = "constraint" in sol.fields
    if steps and np.any(residual > roundoff_limit(tolerance, 1) * scale):  # points of manifolds are rounded, and then subtracted
        scale = np.maximum(scale, np.max(moved_numbers(sol, "constraint")[0].reshape(-1, len(scale)), axis=0))
    if not steps and sol.system is not None and "p" in sol.fields and np.any(residual > roundoff_limit(tolerance, 1) * scale):
        scale = scale + _moved_by_momenta(sol, at_rows(sol, constraint_at))
    values, residual = np.max(residual / scale, axis=-1), np.max(residual, axis=-1)
    values = values[:, given:]
    lane, row = worst_place(values)
    kind = "discrete constraint of each step" if steps else "constraint at each row"
    text = (
        f"{kind}, relative to its terms; at most {np.max(residual[:, given:]):.2g}, at t = {sol.time_of(row + given, lane):.6g}"
        f"{of_lane(sol, lane)}"
    )
    if redundant:
        text += f"; {', '.join(f'number {i}' for i in redundant)} left out, following from the others"
    if given:
        text += f"; the pair given at the start is off by {np.max(residual[:, 0]):.2g}"
    inside = sol.scheme is not None and not sol.scheme.constraints_at_rows
    if not steps and inside and np.max(values) > roundoff_limit(tolerance, 1):
        text = f"the scheme imposes it inside each step; at the rows it is off by {np.max(residual):.2g}"
        return Line(name, float(np.max(values)), None, NOT_CHECKED, text)
    return judged(sol, name, np.max(values, axis=1), roundoff_limit(tolerance, 1), text)


def hidden_constraint(sol: Solution, tolerance: float | None) -> Line | None:
    """G v + ∂g/∂t = 0 at every row, which the schemes with holonomic constraints impose on the saved momentum."""
    system = None if sol.system is None else sol.system.lagrangian_form()
    if system is None or system.holonomic is None or "constraint" not in sol.fields:
        return None
    hidden, items = at_rows(sol, _hidden, system), {name: np.asarray(a) for name, a in sol.row_fields.items()}
    values = np.abs(over_rows(hidden, sol, (items,)))
    terms = sampled(sol, at_rows(sol, _constraint_terms, system))[..., -values.shape[-1] :]
    sizes, limit = _largest(sampled_terms(sol, hidden), terms), roundoff_limit(tolerance, 1)
    if np.any(values > limit * sizes):
        sizes = sizes + _moved_by_momenta(sol, hidden)
    values = np.max(values / sizes, axis=-1)
    lane, row = worst_place(values)
    text = f"∂g/∂q v + ∂g/∂t at each row, relative to its terms, worst at t = {sol.time_of(row, lane):.6g}{of_lane(sol, lane)}"
    return judged(sol, "hidden constraint", np.nanmax(values, axis=1), limit, text)


def _hidden(system: LagrangeDirac, row: dict, params: Any):
    """G v + ∂g/∂t."""
    velocity = system.inverse_legendre(row["q"], row["p"], params, row.get("about"), row["t"])
    return system.constraints.hidden_defect(row["t"], row["q"], velocity, params)


def _moved_by_momenta(sol: Solution, function: eqx.Partial) -> np.ndarray:
    """How far momenta that move as in a typical step move `function`(row, params): a machine at rest has those that roundings of
    its impulses leave."""
    return _largest(sampled(sol, eqx.Partial(_moved, function, *moved_numbers(sol, "p"))))


def _moved(function: eqx.Partial, moved: np.ndarray, row: dict, params: Any):
    return jnp.abs(jacobian(lambda p: function(row | {"p": p}, params))(row["p"])) @ moved


def _constraint_terms(system: LagrangeDirac, row: dict, params: Any):
    velocity = system.inverse_legendre(row["q"], row["p"], params, row.get("about"), row["t"])
    return system.constraint_terms(row["t"], row["q"], velocity, params)


def _largest(*sizes: np.ndarray) -> np.ndarray:
    """The sums of sizes (B, rows, …), the largest of each over all rows."""
    found = sum(np.nanmax(size, axis=(0, 1), initial=0.0) for size in sizes)
    return np.where(found > 0, found, TINY)


def _constraint_scale(sol: Solution, structure: AbstractDiscreteStructure | str, count: int) -> Any:
    """The size of the terms of so many constraints: of those that the steps impose, one number for each; the largest saved
    number of a loaded solution; |dE||x| where the constraint is one on dE; else from its derivative."""
    if isinstance(structure, AbstractDiscreteStructure) and structure.own_constraints:
        q = np.asarray(sol.q)
        speed = np.abs(np.diff(q, axis=-2)) / (sol.step * sol.save_every)
        speed = np.nanmax(speed, axis=tuple(range(speed.ndim - 1)), initial=0.0)
        return _largest(sampled(sol, eqx.Partial(_own_size, structure, speed)))
    if sol.system is None:
        nodes = [np.asarray(a) for k, a in sol.fields.items() if sol.field_info[k].place == "node"]
        return float(max(np.nanmax(np.abs(a)) for a in nodes)) or TINY
    form = sol.system.lagrangian_form()
    if sol.system.constrains_differential:
        size = float(np.nanmax(sampled_terms(sol, at_rows(sol, energy_at)))) or TINY
        return np.maximum(size, _constraint_sizes(sol))
    if form is not None and form.constraints.any and "p" in sol.fields:
        return _largest(sampled(sol, at_rows(sol, _constraint_terms, form)))[:count]  # steps say no hidden ones
    size = float(np.nanmax(sampled_terms(sol, at_rows(sol, constraint_at))))
    return max(size, float(np.max(_constraint_sizes(sol), initial=0.0))) or TINY


def _constraint_sizes(sol: Solution) -> Any:
    """What the system says of each constraint, the largest over all rows; 0 where it says nothing."""
    return _largest(sampled(sol, at_rows(sol, _sizes_at))) if sol.system and sol.system.has_constraint_sizes else 0.0


def _sizes_at(system: Any, row: dict, params: Any):
    return system.constraint_sizes_at(row, params)


def _own_size(structure: AbstractDiscreteStructure, speed, row: dict, params: Any):
    return structure.constraint_size(row, jnp.asarray(speed), params)
