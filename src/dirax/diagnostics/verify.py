"""verify(): is the structure that a scheme promises really there, in the trajectory that came out?"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dirax.diagnostics.drift import SMALLEST_SERIES, trend
from dirax.diagnostics.report import BOUNDED, DRIFTS, NOT_CHECKED, OK, VIOLATED, Line, Report
from dirax.diagnostics.symplecticity import begin, structural_defect, symplecticity_defect
from dirax.functions import UserFunction
from dirax.geometry.finite_difference import InducedFiniteDifferenceDirac, annihilator_projector
from dirax.geometry.tulczyjew import minus_dirac_differential, plus_dirac_differential, slot_derivatives
from dirax.schemes.discrete_lagrangian import discrete_constraint, discrete_lagrangian
from dirax.schemes.lagrange_dirac import LagrangeDAlembert, MinusLagrangeDirac, PlusLagrangeDirac
from dirax.solution import Solution
from dirax.systems.lagrange_dirac import LagrangeDirac

EPSILON = 2.0**-52
ROUNDINGS = 32
"""Roundings, each of half a unit in the last place, that one step is allowed to commit in any of its equations."""

SAMPLED_STEPS = 8
CHUNK = 2048

Symmetries = Mapping[str, Callable] | Sequence[int] | None


def verify(sol: Solution, symmetries: Symmetries = None, tolerance: float | None = None) -> Report:
    """Measure the structure of a solution: a Report with one line a quantity, each with a tolerance and a verdict.

    `symmetries`: {name: generator(q) -> (n,)}, whose momentum maps ⟨p, ξ_Q(q)⟩ should be conserved, or a list of indices
    of cyclic coordinates. `tolerance` replaces the relative tolerances below.

    Every measured value is relative to its natural scale, so that 2⁻⁵² = ε is one rounding; the natural scale is the sum
    of the absolute values of the terms that should cancel, plus their change when each saved number is changed by itself
    (the absolute Jacobian times |q|). Tolerances:

    - discrete Dirac structure, constraint, saved momenta: 32 ε, because they hold step by step;
    - momentum maps: 32 ε · steps, the most that 32 roundings a step add up to (a random walk gives √steps);
    - symplecticity, structural relation: 32 ε · 2n · (condition number of the step's equations);
    - energy: see `dirax.diagnostics.drift`; a drift below 32 ε · steps is roundoff.

    What cannot be checked says so, and why. Raises `TypeError` or `ValueError` for something that is not a Solution and
    for symmetries that are not functions of q or coordinate numbers.
    """
    if not isinstance(sol, Solution):
        raise TypeError(f"sol must be a dirax Solution (from dx.simulate or dx.load), but a {type(sol).__name__} was given.")
    generators = _generators(sol, symmetries)
    lines = [
        _completion(sol),
        *_membership(sol, tolerance),
        *_constraint(sol, tolerance),
        _energy(sol, tolerance),
        *(_momentum(sol, name, generator, tolerance) for name, generator in generators.items()),
        _symplecticity(sol, tolerance),
    ]
    return Report(_title(sol), tuple(lines))


# ---------------------------------------------------------------------------------------------- the steps themselves


class DiscreteSystem(NamedTuple):
    """What a discrete Lagrange–d'Alembert scheme makes of a system, as functions of two points and `params`."""

    lagrangian: Callable  # L_d(q0, q1, params)
    constraint: Callable  # w_d(q0, q1, params)
    one_forms: Callable  # W(q, params)
    sign: str | None  # "+", "-", or None for a general constraint


def discrete_system(sol: Solution) -> DiscreteSystem | str:
    """L_d, w_d and W of a solution's scheme, or the reason why there are none."""
    system, scheme, h = sol.system, sol.scheme, sol.step
    if system is None or scheme is None:
        return "the solution was loaded without its system"
    if not isinstance(scheme, (PlusLagrangeDirac, MinusLagrangeDirac, LagrangeDAlembert)):
        return f"{type(scheme).__name__} has no discrete Lagrangian on Q × Q"
    if not isinstance(system, LagrangeDirac):
        return f"{type(system).__name__} is not a Lagrange–Dirac system"
    rule, sign = "midpoint", None
    if isinstance(scheme, LagrangeDAlembert):
        rule = scheme.constraint
    elif isinstance(scheme, PlusLagrangeDirac):
        rule, sign = "right", "+"
    else:
        rule, sign = "left", "-"
    ld = discrete_lagrangian(system.lagrangian, scheme.discrete_lagrangian)
    wd = discrete_constraint(system.constraint_matrix, rule)
    return DiscreteSystem(
        lambda q0, q1, params: ld(q0, (q1 - q0) / h, h, params),
        lambda q0, q1, params: wd(q0, (q1 - q0) / h, h, params),
        system.constraint_matrix,
        sign,
    )


def _completion(sol: Solution) -> Line:
    ok, messages = np.atleast_1d(sol.ok), np.atleast_1d(sol.message)
    residual = float(np.max(sol.stats["max_residual"])) if "max_residual" in sol.stats else None
    if np.all(ok):
        return Line("steps solved", residual, None, OK, f"every step was solved, up to t = {float(sol.t[-1]):.6g}")
    failed = np.flatnonzero(~ok)
    which = f"trajectory {failed[0]}: " if sol.batch is not None else ""
    more = f" (and {len(failed) - 1} others)" if len(failed) > 1 else ""
    return Line("steps solved", residual, None, VIOLATED, f"{which}{messages[failed[0]]}{more}")


def _membership(sol: Solution, tolerance: float | None) -> list[Line]:
    found = discrete_system(sol)
    sign = "" if isinstance(found, str) or found.sign is None else {"+": "(+)-", "-": "(−)-"}[found.sign]
    name = f"{sign}discrete Dirac structure"
    if isinstance(found, str):
        return [Line(name, None, None, NOT_CHECKED, found)]
    if sol.save_every != 1:
        return [Line(name, None, None, NOT_CHECKED, f"needs every step, but save_every = {sol.save_every}")]
    if sol.rows < 3:
        return [Line(name, None, None, NOT_CHECKED, "needs three points, but fewer were saved")]
    h = sol.step

    def element(z, params):
        """(W q̂ or w_d, γ − q̂, force outside Δ°) at three points z = (q0, q1, q2), of the pairs (q0, q1) and (q1, q2)."""
        q0, q1, q2 = jnp.split(z, 3)
        ld = lambda a, b: found.lagrangian(a, b, params)
        p1, p2 = slot_derivatives(ld, q0, q1)[1], slot_derivatives(ld, q1, q2)[1]
        minus_p0, minus_p1 = slot_derivatives(ld, q0, q1)[0], slot_derivatives(ld, q1, q2)[0]
        forms = UserFunction(lambda q, params: found.one_forms(q, params), "one_forms", ("q",))
        if found.sign == "+":
            structure = InducedFiniteDifferenceDirac(forms, step=h, sign="+")
            _, (beta, gamma) = plus_dirac_differential(ld, q0, q1, q2, h)
            c, r, f = structure.membership_defect(q0, q1, (p1, p2), beta, gamma, params)
        elif found.sign == "-":
            structure = InducedFiniteDifferenceDirac(forms, step=h, sign="-")
            _, (beta, gamma) = minus_dirac_differential(ld, q0, q1, q2, h)
            c, r, f = structure.membership_defect(q1, q2, (-minus_p0, -minus_p1), beta, gamma, params)
        else:
            onto = annihilator_projector(found.one_forms(q1, params))
            force = (p1 + minus_p1) / h
            c, r, f = found.constraint(q1, q2, params), jnp.zeros_like(q1), force - onto @ force
        return c, jnp.concatenate([r, f]), (jnp.abs(p1) + jnp.abs(p2) + jnp.abs(minus_p1)) / h

    def defects(z, params):
        size = jnp.abs(z) + jnp.tile(jnp.max(jnp.abs(jnp.diff(z.reshape(3, -1), axis=0)), axis=0) + h, 3)
        c, f, terms = element(z, params)
        jc, jf, _ = jax.jacfwd(element)(z, params)
        constraint = jnp.max(jnp.abs(c) / _nonzero(jnp.abs(jc) @ size), initial=0.0)
        force = jnp.max(jnp.abs(f)) / _nonzero(jnp.max(jnp.abs(jf) @ size) + jnp.max(terms))
        return jnp.stack([constraint, force])

    q = jnp.asarray(sol.q)
    triples = jnp.concatenate([q[..., :-2, :], q[..., 1:-1, :], q[..., 2:, :]], axis=-1)
    values = _over_rows(defects, sol, triples)
    if "q0" in sol.initial and found.sign == "+":
        values[:, 0, 0] = 0.0  # the first pair was given, not computed
    limit = ROUNDINGS * EPSILON if tolerance is None else tolerance
    lane, row = _worst(np.max(values, axis=-1))
    worst = values[lane, row]
    parts = "W q̂, γ = q̂ and β + p̂ ∈ Δ°" if found.sign else "w_d = 0 and D2L_d + D1L_d ∈ Δ°"
    at = f"worst at t = {float(sol.t[row + 1]):.6g}{_lane(sol, lane)}"
    text = f"{parts}, from q alone, in units of their scale; {at}: constraint {worst[0]:.2g}, force {worst[1]:.2g}"
    return [_judged(sol, name, np.max(values, axis=(1, 2)), limit, text)]


def _constraint(sol: Solution, tolerance: float | None) -> list[Line]:
    name = "constraint"
    try:
        residual = np.asarray(sol.constraint_residual())
    except (ValueError, KeyError, AttributeError) as error:
        return [Line(name, None, None, NOT_CHECKED, str(error))]
    if residual.shape[-1] == 0:
        return []
    residual = residual.reshape((-1, *residual.shape[-2:]))
    per_step = "constraint" in sol.fields
    scale = _constraint_scale(sol, per_step)
    given = int(per_step and "q0" in sol.initial)  # the first pair was given, not computed
    values = np.max(np.abs(residual), axis=-1)[:, given:] / scale
    limit = ROUNDINGS * EPSILON if tolerance is None else tolerance
    lane, row = _worst(values)
    kind = "discrete constraint of each step" if per_step else "constraint at each row"
    largest = float(np.nanmax(np.abs(residual[:, given:])))
    text = f"{kind}, relative to |W||v|; largest {largest:.2g}, at t = {float(sol.t[row + given]):.6g}{_lane(sol, lane)}"
    if given:
        text += f"; the pair given at the start is off by {float(np.nanmax(np.abs(residual[:, 0]))):.2g}"
    return [_judged(sol, name, np.nanmax(values, axis=1), limit, text)]


def _constraint_scale(sol: Solution, per_step: bool) -> float:
    """The size of the terms of the constraint: |W||v| where W is known, else the largest |Δq|/h or |x|."""
    if isinstance(sol.system, LagrangeDirac) and "q" in sol.fields:
        q = np.asarray(sol.q)
        speed = np.nanmax(np.abs(np.diff(q, axis=-2)), axis=tuple(range(q.ndim - 1))) / (sol.step * sol.save_every)
        system = sol.system
        forms = np.asarray(sol.map_rows(lambda row, params: jnp.abs(system.constraint_matrix(row["q"], params))))
        forms = np.nanmax(forms, axis=tuple(range(forms.ndim - 2)))
        return float(np.max(forms @ np.maximum(speed, 1.0)))
    nodes = [np.asarray(a) for k, a in sol.fields.items() if sol.field_info[k].place == "node"]
    return float(max([1.0, *(np.nanmax(np.abs(a)) for a in nodes)]))


# ------------------------------------------------------------------------------------------------- along the trajectory


def _energy(sol: Solution, tolerance: float | None) -> Line:
    name = "energy"
    try:
        energy = np.atleast_2d(np.asarray(sol.energy()))
    except (ValueError, KeyError, AttributeError) as error:
        return Line(name, None, None, NOT_CHECKED, str(error))
    t, roundoff = np.asarray(sol.t), _energy_roundoff(sol, energy, tolerance)
    results = []
    for series in energy:
        good = np.isfinite(series)
        results.append(trend(t[good], series[good]) if good.sum() >= SMALLEST_SERIES else None)
    if not any(results):
        return Line(name, None, None, NOT_CHECKED, f"needs {SMALLEST_SERIES} rows to tell a drift, but has {sol.rows}")
    drifting = [r is not None and r.significant and abs(r.drift) > roundoff for r in results]
    size = [abs(r.drift) * (1 + 1e6 * d) if r else -1.0 for r, d in zip(results, drifting, strict=True)]
    lane = int(np.argmax(size))
    worst = results[lane]
    assert worst is not None
    text = (
        f"slope {worst.slope:.2g} ± {worst.standard_error:.1g} per unit of time: {worst.drift:.2g} over the run, "
        f"in a band of {worst.band:.2g}{_lane(sol, lane)}"
    )
    details = {
        "slope": worst.slope,
        "standard_error": worst.standard_error,
        "drift": worst.drift,
        "band": worst.band,
        "roundoff": roundoff,
    }
    if sol.batch is not None:
        details["per_trajectory"] = [None if r is None else r.drift for r in results]
    return Line(name, abs(worst.drift), roundoff, DRIFTS if any(drifting) else BOUNDED, text, details)


def _energy_roundoff(sol: Solution, energy, tolerance: float | None) -> float:
    """What 32 roundings a step can add to the energy: 32 ε · steps · (|E| + |∂E||row|)."""

    def size(row, params):
        grads = jax.grad(lambda row: sol.system.energy_at(row, params))(row)
        return sum(jnp.sum(jnp.abs(grads[k] * row[k])) for k in row)

    scale = float(np.nanmax(np.abs(energy)))
    if sol.system is not None:
        scale += float(np.nanmax(np.asarray(sol.map_rows(size))))
    relative = ROUNDINGS * EPSILON * _steps(sol) if tolerance is None else tolerance
    return relative * scale


def _momentum(sol: Solution, name: str, generator: Callable, tolerance: float | None) -> Line:
    title = f"momentum map: {name}"
    if "p" not in sol.fields or "q" not in sol.fields:
        return Line(title, None, None, NOT_CHECKED, "the solution has no q and p")
    values = np.atleast_2d(np.asarray(sol.momentum_map(generator)))
    scale = np.nanmax(np.atleast_2d(sol.map_rows(lambda row, _: jnp.sum(jnp.abs(row["p"] * generator(row["q"]))))), axis=1)
    change = np.nanmax(np.abs(values - values[:, :1]), axis=1)
    relative = np.where(change > 0, change / np.where(scale > 0, scale, 1.0), 0.0)
    limit = ROUNDINGS * EPSILON * _steps(sol) if tolerance is None else tolerance
    lane = int(np.argmax(relative))
    text = f"largest change {change[lane]:.2g} of ⟨p, ξ⟩ = {values[lane, 0]:.6g}{_lane(sol, lane)}"
    return _judged(sol, title, relative, limit, text)


def _generators(sol: Solution, symmetries: Symmetries) -> dict[str, Callable]:
    if symmetries is None:
        return {}
    if isinstance(symmetries, Mapping):
        for name, generator in symmetries.items():
            if not callable(generator):
                raise TypeError(
                    f"symmetries[{name!r}] must be a function generator(q) -> (n,), but a {type(generator).__name__} was given."
                )
        return {str(name): generator for name, generator in symmetries.items()}
    if "q" not in sol.fields:
        raise ValueError("symmetries need a solution with q and p, but this one holds " + ", ".join(sol.fields) + ".")
    n, found = np.shape(sol.q)[-1], {}
    for index in symmetries:
        if isinstance(index, bool) or not isinstance(index, (int, np.integer)) or not -n <= index < n:
            raise ValueError(f"symmetries must name coordinates by whole numbers from 0 to {n - 1}, but {index!r} was given.")
        found[f"p[{int(index)}]"] = lambda q, index=int(index): jnp.zeros_like(q).at[index].set(1.0)
    return found


# ------------------------------------------------------------------------------------------------------------ one step


def _symplecticity(sol: Solution, tolerance: float | None) -> Line:
    found = discrete_system(sol)
    constrained = any(name == "multipliers" for name in sol.fields)
    name = "structural relation φ*Ω = Ω + dβ" if constrained else "symplecticity of one step"
    if sol.equation is None or sol.system is None:
        return Line(name, None, None, NOT_CHECKED, "the solution was loaded without its system")
    if not all(stage.canonical for stage, _ in sol.equation.stages):
        return Line(name, None, None, NOT_CHECKED, "the state is not (q, p) on T*Q")
    if constrained and isinstance(found, str):
        return Line(name, None, None, NOT_CHECKED, found)
    if constrained and sol.save_every != 1:
        return Line(name, None, None, NOT_CHECKED, f"needs every step, but save_every = {sol.save_every}")
    if constrained:
        values = _structural(sol, found)
        lane, row = _worst(values[..., 0])
        text = f"one step on the pairs with w_d = 0; without dβ it would be off by {values[lane, row, 1]:.2g}{_lane(sol, lane)}"
    else:
        values = _symplectic(sol)
        text = f"‖JᵀΩJ − Ω‖ relative to ‖JᵀΩJ‖, worst of {values.shape[1]} steps{_lane(sol, _worst(values[..., 0])[0])}"
    if not np.any(np.isfinite(values[..., 0])):
        return Line(name, None, None, NOT_CHECKED, "the step could not be solved again from the saved rows")
    n = sol.equation.stages[0][0].state_size // 2
    condition = float(np.nanmax(values[..., -1]))
    limit = ROUNDINGS * EPSILON * 2 * n * condition if tolerance is None else tolerance
    line = _judged(sol, name, np.nanmax(values[..., 0], axis=1), limit, text)
    line.details["condition"] = condition
    return line


def _symplectic(sol: Solution) -> np.ndarray:
    rows = _sampled(sol)
    keys = ("x",) if "x" in sol.fields else ("q", "p")
    data = {k: jnp.asarray(sol.fields[k])[..., rows, :] for k in keys}

    def one(item, params):
        row, t = item
        return jnp.stack(symplecticity_defect(sol.system, sol.equation, row, t, sol.step, params))

    return _over_rows(one, sol, (data, _times(sol, rows)))


def _structural(sol: Solution, found: DiscreteSystem) -> np.ndarray:
    rows = _sampled(sol)
    q = jnp.asarray(sol.q)
    h = sol.step

    def one(item, params):
        q0, q1, t = item
        ld = lambda a, b: found.lagrangian(a, b, params)
        _, p = slot_derivatives(ld, q0, q1)
        _, guess = begin(sol.system, sol.equation, {"q": q1, "p": p}, h, params)
        guess = guess.at[: q0.shape[0]].set((q1 - q0) / h)
        return jnp.stack(
            structural_defect(
                ld,
                lambda a, b: found.constraint(a, b, params),
                lambda a: annihilator_projector(found.one_forms(a, params)),
                sol.equation,
                guess,
                q0,
                q1,
                t,
                h,
                params,
            )
        )

    return _over_rows(one, sol, (q[..., rows, :], q[..., rows + 1, :], _times(sol, rows + 1)))


def _sampled(sol: Solution) -> np.ndarray:
    """Row numbers of a few steps, spread over the part that every trajectory has reached."""
    name = "q" if "q" in sol.fields else "x"
    values = np.asarray(sol.fields[name])
    finite = np.all(np.isfinite(values), axis=tuple(i for i in range(values.ndim) if i != values.ndim - 2))
    last = max(int(np.sum(finite)) - 2, 0)
    return np.unique(np.linspace(0, last, SAMPLED_STEPS).astype(int))


def _times(sol: Solution, rows: np.ndarray):
    t = jnp.asarray(sol.t)[rows]
    return t if sol.batch is None else jnp.broadcast_to(t, (sol.batch, len(rows)))


# -------------------------------------------------------------------------------------------------------------- helpers


def _over_rows(function: Callable, sol: Solution, items: Any) -> np.ndarray:
    """function(item, params) for every row of `items`, (B, rows, …), B = 1 without a batch; in pieces of CHUNK rows."""
    items = jax.tree.map(jnp.asarray, items)
    if sol.batch is None:
        items = jax.tree.map(lambda a: a[None], items)
    params = sol.params if sol.batch_params else jax.tree.map(lambda a: a, sol.params)
    return np.array(_mapped(function, items, params, sol.batch_params))


@eqx.filter_jit
def _mapped(function, items, params, batch_params: bool):
    def lane(pair):
        rows, params = pair
        return jax.lax.map(lambda item: function(item, params), rows, batch_size=CHUNK)

    if batch_params:
        return jax.lax.map(lane, (items, params))
    return jax.lax.map(lambda rows: lane((rows, params)), items)


def _judged(sol: Solution, name: str, per_trajectory: np.ndarray, limit: float, text: str) -> Line:
    worst = float(np.nanmax(per_trajectory))
    details = {"per_trajectory": per_trajectory.tolist()} if sol.batch is not None else {}
    return Line(name, worst, limit, OK if worst <= limit else VIOLATED, text, details)


def _worst(values: np.ndarray) -> tuple[int, int]:
    """(trajectory, row) of the largest value; NaN, in rows that were not reached, does not count."""
    lane, row = np.unravel_index(int(np.argmax(np.nan_to_num(values, nan=-1.0))), values.shape)
    return int(lane), int(row)


def _lane(sol: Solution, lane: int) -> str:
    return "" if sol.batch is None else f" (trajectory {lane})"


def _steps(sol: Solution) -> int:
    return max(1, round(float(sol.t[-1] - sol.t[0]) / float(sol.step)))


def _nonzero(values):
    return jnp.where(values > 0, values, 1.0)


def _title(sol: Solution) -> str:
    def name(thing):
        return type(thing).__name__ if thing is not None else "unknown"

    batch = f", {sol.batch} trajectories" if sol.batch is not None else ""
    return f"{name(sol.scheme)} on {name(sol.system)}: {_steps(sol)} steps of {float(sol.step):.6g}{batch}"
