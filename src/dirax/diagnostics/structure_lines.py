"""Lines of `dx.verify` on the discrete Dirac structure of every step, and on the derivative of single steps."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dirax.diagnostics.books import keeps_books
from dirax.diagnostics.judging import judged, of_lane, roundoff_limit, spread, times_at, where_reached, worst_place
from dirax.diagnostics.one_step import (
    DiscreteSystem,
    discrete_system,
    discretization_defect,
    membership_defect,
    over_rows,
    poisson_defect,
    structural_defect,
    symplecticity_defect,
)
from dirax.diagnostics.report import NOT_CHECKED, Line
from dirax.reduction.euler_poincare import EulerPoincare
from dirax.reduction.lie_poisson import LiePoisson
from dirax.schemes.discrete_dirac import DiscreteDirac
from dirax.solution.solution import Solution
from dirax.systems.dirac_system import DiracSystem

SAMPLED_STEPS = 8
"""Steps of a trajectory at which the derivative of the step is taken."""


def membership(sol: Solution, tolerance: float | None) -> list[Line]:
    if isinstance(sol.system, DiracSystem) and isinstance(sol.scheme, DiscreteDirac):
        return [_discretization(sol, tolerance)]
    found = discrete_system(sol.system, sol.scheme, sol.step)
    if isinstance(found, str):
        return [Line("discrete Dirac structure", None, None, NOT_CHECKED, found)]
    name = {"+": "(+)-", "-": "(−)-", None: ""}[found.sign] + "discrete Dirac structure"
    if sol.save_every != 1:
        return [Line(name, None, None, NOT_CHECKED, f"needs every step, but save_every = {sol.save_every}")]
    if sol.rows < 3:
        return [Line(name, None, None, NOT_CHECKED, f"needs three points, but only {sol.rows} were saved")]
    q = np.asarray(sol.q)
    points = (q[..., :-2, :], q[..., 1:-1, :], q[..., 2:, :])
    multipliers = sol.fields.get("multipliers", np.zeros((*q.shape[:-2], sol.rows - 1, 0)))
    items = (*points, np.asarray(sol.p)[..., 1:-1, :], np.asarray(multipliers)[..., 1:, :])
    times = times_at(sol, np.arange(sol.rows - 2))
    values = where_reached(over_rows(eqx.Partial(membership_defect, found), sol, (times, *items)), items, sol)
    if "q0" in sol.initial and found.sign == "+":
        values[:, 0, 0] = 0.0  # the first pair was given, not computed
    structure, saved = values[..., :2], values[..., 2]
    lane, row = worst_place(np.max(structure, axis=-1))
    constraint, force = structure[lane, row]
    parts = "q̂ ∈ Δ, β + p̂ ∈ Δ°" if found.sign else "w_d = 0, D₂L_d + D₁L_d ∈ Δ°"
    text = (
        f"{parts} at every step, from q alone; worst at t = {float(sol.t[row + 1]):.6g}{of_lane(sol, lane)}: "
        f"constraint {constraint:.2g}, force {force:.2g}"
    )
    lane, row = worst_place(saved)
    both = " and multipliers" if "multipliers" in sol.fields else ""
    about = f"against the Legendre transforms{' and forces' if both else ''} of q; worst at t = {float(sol.t[row + 1]):.6g}"
    limit = roundoff_limit(tolerance, 1)
    return [
        judged(sol, name, np.max(structure, axis=(1, 2)), limit, text),
        judged(sol, f"saved p{both}", np.max(saved, axis=1), limit, about + of_lane(sol, lane)),
    ]


def _discretization(sol: Solution, tolerance: float | None) -> Line:
    name = "discretization-map Dirac structure"
    if sol.save_every != 1:
        return Line(name, None, None, NOT_CHECKED, f"needs every step, but save_every = {sol.save_every}")
    if sol.system.holonomic is not None and sol.scheme.constraints == "resolve":
        return Line(name, None, None, NOT_CHECKED, "Method 2 projects the step of D onto the final manifold")
    x = np.asarray(sol.x)
    function = eqx.Partial(discretization_defect, sol.system, sol.scheme.map, sol.step)
    multipliers = np.asarray(sol.fields.get("multipliers", np.zeros((*x.shape[:-2], sol.rows - 1, 0))))
    items = (x[..., :-1, :], x[..., 1:, :], multipliers)
    values = where_reached(over_rows(function, sol, items), items, sol)[..., 0]
    lane, row = worst_place(values)
    text = f"(R_d⁻¹(x₀, x₁)/h, dH) ∈ D at every step, from x alone; worst at t = {float(sol.t[row]):.6g}{of_lane(sol, lane)}"
    return judged(sol, name, np.max(values, axis=1), roundoff_limit(tolerance, 1), text)


def symplecticity(sol: Solution, tolerance: float | None) -> Line:
    constrained = any(info.place == "step" and name == "multipliers" for name, info in sol.field_info.items())
    name = "structural relation φ*Ω = Ω + dβ" if constrained else "symplecticity of one step"
    if sol.equation is None or sol.system is None:
        return Line(name, None, None, NOT_CHECKED, "the solution was loaded without its system")
    if "work" in sol.fields and not keeps_books(sol):
        return Line(name, None, None, NOT_CHECKED, "the forces change the two-form")
    stages = sol.equation.stages
    reduced = isinstance(sol.system, EulerPoincare | LiePoisson) and not constrained
    if not reduced and not all(stage.canonical for stage, _ in stages):
        return Line(name, None, None, NOT_CHECKED, "the state of this scheme is not (q, p) on T*Q")
    found = discrete_system(sol.system, sol.scheme, sol.step)
    if constrained and isinstance(found, str):
        return Line(name, None, None, NOT_CHECKED, found)
    if constrained and sol.save_every != 1:
        return Line(name, None, None, NOT_CHECKED, f"needs every step, but save_every = {sol.save_every}")
    rows = _sampled(sol)
    if len(rows) == 0:
        return Line(name, None, None, NOT_CHECKED, "no two rows were computed")
    if constrained:
        assert isinstance(found, DiscreteSystem)
        q = jnp.asarray(sol.q)
        items = (q[..., rows, :], q[..., rows + 1, :], times_at(sol, rows + 1))
        values = over_rows(eqx.Partial(structural_defect, found, sol.equation), sol, items)
    else:
        data = {k: jnp.asarray(sol.fields[k])[..., rows, :] for k in (("x",) if "x" in sol.fields else ("q", "p"))}
        items = (data, times_at(sol, rows))
        reason = _cannot_start(sol, data)
        if reason:
            return Line(name, None, None, NOT_CHECKED, reason)
        of_step = poisson_defect if reduced else symplecticity_defect
        values = over_rows(eqx.Partial(of_step, sol.system, sol.equation, sol.step), sol, items)
    defect, condition = values[..., 0], float(np.max(values[..., -1], where=np.isfinite(values[..., -1]), initial=1.0))
    if not np.any(np.isfinite(defect)):
        return Line(name, None, None, NOT_CHECKED, "the step could not be solved again from the saved rows")
    lane, row = worst_place(defect)
    at = f"worst of {len(rows)} steps at t = {float(sol.t[rows[row]]):.6g}{of_lane(sol, lane)}"
    text = f"‖JΛJᵀ − Λ‖/‖JΛJᵀ‖ of the Lie–Poisson bivector, {at}" if reduced else f"‖JᵀΩJ − Ω‖/‖JᵀΩJ‖, {at}"
    if constrained:
        text = f"on the pairs with w_d = 0, {at}; without dβ it would be off by {values[lane, row, 1]:.2g}"
    limit = roundoff_limit(tolerance, stages[0][0].state_size * condition)
    line = judged(sol, name, np.max(np.where(np.isfinite(defect), defect, 0.0), axis=1), limit, text)
    line.details["condition"] = condition
    return line


def _cannot_start(sol: Solution, data: dict) -> str:
    """Why a user's `start` does not take the saved rows as initial data; empty if it does."""
    first = (0, 0) if sol.batch is not None else (0,)
    params = jax.tree.map(lambda a: a[0], sol.params) if sol.batch_params else sol.params
    stage, fraction = sol.equation.stages[0]
    try:
        row = {name: values[first] for name, values in data.items()}
        row["t"] = jnp.asarray(sol.t[0])
        complete = lambda row: {**sol.system.complete(row, params, False), "t": row["t"]}
        jax.eval_shape(lambda row: stage.start(complete(row), fraction * sol.step, params), row)
    except (KeyError, TypeError, ValueError) as error:
        return f"the scheme does not start from a saved row: {error}"
    return ""


def _sampled(sol: Solution) -> np.ndarray:
    """Numbers of a few rows that have a successor, spread over the shortest and over the longest trajectory."""
    values = np.asarray(sol.fields["q" if "q" in sol.fields else "x"])
    reached = np.sum(np.all(np.isfinite(values), axis=-1), axis=-1)
    half = SAMPLED_STEPS // 2 if np.min(reached) < np.max(reached) else SAMPLED_STEPS
    return np.union1d(spread(int(np.min(reached)) - 1, half), spread(int(np.max(reached)) - 1, half)).astype(int)
