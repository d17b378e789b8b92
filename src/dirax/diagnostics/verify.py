"""verify(): is the structure that a scheme promises really there, in the trajectory that came out?"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dirax.diagnostics.books import balances, keeps_books
from dirax.diagnostics.drift import judge
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
from dirax.diagnostics.report import BOUNDED, DRIFTS, NOT_CHECKED, OK, VIOLATED, Line, Report
from dirax.reduction.euler_poincare import EulerPoincare
from dirax.reduction.lie_poisson import LiePoisson
from dirax.schemes.discrete_dirac import DiscreteDirac
from dirax.solution import Solution
from dirax.systems.dirac_system import DiracSystem
from dirax.systems.lagrange_dirac import LagrangeDirac
from dirax.systems.port_hamiltonian import PortHamiltonian

EPSILON = 2.0**-52
ROUNDINGS = 32
"""Roundings, each of half a unit in the last place, that the equations of one step are allowed, and their safety factor."""

SAMPLED_STEPS = 8
"""Steps of a trajectory at which the derivative of the step is taken."""

SAMPLED_ROWS = 64
"""Rows at which natural scales are taken."""

Symmetries = Mapping[str, Callable] | Sequence[int] | None


def verify(sol: Solution, symmetries: Symmetries = None, tolerance: float | None = None) -> Report:
    """Measure the structure of a solution: a `Report` with one line a quantity, each with a tolerance and a verdict.

    `symmetries`: {name: generator(q) -> (n,)}, whose momentum maps ⟨p, ξ_Q(q)⟩ should be conserved, or a list of the
    numbers of cyclic coordinates. `tolerance`: one relative tolerance in place of those below, the energy's apart.

    Measured values are relative to the natural scale of the quantity, so that one rounding is 2⁻⁵³ = ε/2: the sum of the
    absolute values of the terms that should cancel, and of their change when every saved number is changed by itself
    (absolute Jacobian times |q|). The tolerances are roundoff's:

    - discrete Dirac structure of every step ([PY] Proposition 5.17, Theorem 6.8; [BLM] Definition 5.1), saved momenta and
      multipliers against those of the points, constraint: 32 ε, because these hold step by step;
    - momentum maps: 32 ε · steps, the most that 32 roundings a step add up to (a random walk gives √steps of that);
    - symplecticity of one step (of Euler–Poincaré and Lie–Poisson systems: whether it is a Poisson map), and φ*Ω = Ω + dβ
      where there are constraints ([PY] §3.2): 32 ε · 2n · the condition number of the step's equations, at a few steps;
    - systems with ports ([BLM] §7.1): the power balance of every step and, with a discrete gradient, the books over the run,
      H − H(0) less what was supplied plus what was dissipated: 32 ε, however many steps;
    - energy: "bounded" or "drifts", told apart by windowed means (`dirax.diagnostics.drift`); a drift below
      32 ε · steps · (|E| + |∂E| |row|) is roundoff. The tolerance shown is the drift that could have been told.

    A batch is judged by its worst trajectory, a failed run by the part that was computed, and what cannot be checked says
    so, and why: membership needs every step saved, a loaded solution its system (`dx.load(path, system=…)`).

    Raises `TypeError` or `ValueError` for something that is not a Solution and for symmetries that are neither functions
    of q nor coordinate numbers.

        print(dx.verify(sol, symmetries={"rotation": lambda q: jnp.array([-q[1], q[0]])}))
    """
    if not isinstance(sol, Solution):
        raise TypeError(f"sol must be a dirax Solution (from dx.simulate or dx.load), but a {type(sol).__name__} was given.")
    generators = _generators(sol, symmetries)
    lines = [
        _completion(sol),
        *_membership(sol, tolerance),
        _constraint(sol, tolerance),
        _hidden_constraint(sol, tolerance),
        _energy(sol),
        *_ports(sol, tolerance),
        *(_momentum(sol, name, generator, tolerance) for name, generator in generators.items()),
        _symplecticity(sol, tolerance),
    ]
    return Report(_title(sol), tuple(line for line in lines if line is not None))


def _completion(sol: Solution) -> Line:
    ok, messages = np.atleast_1d(sol.ok), np.atleast_1d(sol.message)
    residual = float(np.max(sol.stats["max_residual"])) if "max_residual" in sol.stats else None
    if np.all(ok):
        return Line("steps solved", residual, None, OK, f"every step was solved, up to t = {float(sol.t[-1]):.6g}")
    failed = np.flatnonzero(~ok)
    which = f"trajectory {failed[0]}: " if sol.batch is not None else ""
    more = f" (and {len(failed) - 1} more)" if len(failed) > 1 else ""
    return Line("steps solved", residual, None, VIOLATED, f"{which}{messages[failed[0]]}{more}")


def _membership(sol: Solution, tolerance: float | None) -> list[Line]:
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
    times = _times(sol, np.arange(sol.rows - 2))
    values = _where_reached(over_rows(eqx.Partial(membership_defect, found), sol, (times, *items)), items, sol)
    if "q0" in sol.initial and found.sign == "+":
        values[:, 0, 0] = 0.0  # the first pair was given, not computed
    structure, saved = values[..., :2], values[..., 2]
    lane, row = _worst(np.max(structure, axis=-1))
    constraint, force = structure[lane, row]
    parts = "q̂ ∈ Δ, β + p̂ ∈ Δ°" if found.sign else "w_d = 0, D₂L_d + D₁L_d ∈ Δ°"
    text = (
        f"{parts} at every step, from q alone; worst at t = {float(sol.t[row + 1]):.6g}{_lane(sol, lane)}: "
        f"constraint {constraint:.2g}, force {force:.2g}"
    )
    lane, row = _worst(saved)
    both = " and multipliers" if "multipliers" in sol.fields else ""
    about = f"against the Legendre transforms{' and forces' if both else ''} of q; worst at t = {float(sol.t[row + 1]):.6g}"
    limit = _limit(tolerance, 1)
    return [
        _judged(sol, name, np.max(structure, axis=(1, 2)), limit, text),
        _judged(sol, f"saved p{both}", np.max(saved, axis=1), limit, about + _lane(sol, lane)),
    ]


def _discretization(sol: Solution, tolerance: float | None) -> Line:
    name = "discretization-map Dirac structure"
    if sol.save_every != 1:
        return Line(name, None, None, NOT_CHECKED, f"needs every step, but save_every = {sol.save_every}")
    x = np.asarray(sol.x)
    function = eqx.Partial(discretization_defect, sol.system, sol.scheme.map, sol.step)
    items = (x[..., :-1, :], x[..., 1:, :])
    values = _where_reached(over_rows(function, sol, items), items, sol)[..., 0]
    lane, row = _worst(values)
    text = f"(R_d⁻¹(x₀, x₁)/h, dH) ∈ D at every step, from x alone; worst at t = {float(sol.t[row]):.6g}{_lane(sol, lane)}"
    return _judged(sol, name, np.max(values, axis=1), _limit(tolerance, 1), text)


def _constraint(sol: Solution, tolerance: float | None) -> Line | None:
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
    lane, row = _worst(values)
    kind = "discrete constraint of each step" if steps else "constraint at each row"
    text = (
        f"{kind}, relative to its terms; at most {np.max(residual[:, given:]):.2g}, at t = {float(sol.t[row + given]):.6g}"
        f"{_lane(sol, lane)}"
    )
    if redundant := sol.stats.get("redundant_constraints"):
        text += f"; {', '.join(f'number {i}' for i in redundant)} left out, following from the others"
    if given:
        text += f"; the pair given at the start is off by {np.max(residual[:, 0]):.2g}"
    method_one = isinstance(sol.scheme, DiscreteDirac) and sol.scheme.constraints == "discretize"
    if not steps and method_one and np.max(values) > _limit(tolerance, 1):
        text = f"Method 1 imposes it inside each step; at the rows it is off by {np.max(residual):.2g}"
        return Line(name, float(np.max(values)), None, NOT_CHECKED, text)
    return _judged(sol, name, np.max(values, axis=1), _limit(tolerance, 1), text)


def _hidden_constraint(sol: Solution, tolerance: float | None) -> Line | None:
    """G v + ∂g/∂t = 0 at every row, which the schemes with holonomic constraints impose on the saved momentum."""
    system = sol.system
    if not isinstance(system, LagrangeDirac) or system.holonomic is None or "constraint" not in sol.fields:
        return None
    items = (_times(sol, np.arange(sol.rows)), jnp.asarray(sol.q), jnp.asarray(sol.p))
    values = over_rows(eqx.Partial(_hidden_terms, system), sol, items)
    scale = float(np.nanmax(values[..., 1])) or 1.0
    lane, row = _worst(values[..., 0])
    text = f"∂g/∂q v + ∂g/∂t at each row, relative to its terms, worst at t = {float(sol.t[row]):.6g}{_lane(sol, lane)}"
    return _judged(sol, "hidden constraint", np.nanmax(values[..., 0], axis=1) / scale, _limit(tolerance, 1), text)


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
        rows = _spread(sol.rows, SAMPLED_ROWS)
        items = (_times(sol, rows), q[..., rows, :])
        sizes = over_rows(eqx.Partial(_sizes_of_constraints, found, jnp.asarray(speed)), sol, items)
        nonholonomic, holonomic = np.nanmax(sizes[..., 0], axis=(0, 1)), np.nanmax(sizes[..., 1], axis=(0, 1))
        m = len(holonomic) if found.system.holonomic is None else _count_of_forms(sol)
        scale = np.where(np.arange(len(holonomic)) < m, np.max(nonholonomic[:m], initial=0.0), holonomic)
        return np.where(scale > 0, scale, 1.0)
    if sol.system is None:
        nodes = [np.asarray(a) for k, a in sol.fields.items() if sol.field_info[k].place == "node"]
        return float(max(1.0, *(np.nanmax(np.abs(a)) for a in nodes)))
    terms = _energy_terms if isinstance(sol.system, DiracSystem) else _constraint_terms
    return float(np.nanmax(_sampled_terms(sol, terms))) or 1.0


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


# ---------------------------------------------------------------------------------------------- along the trajectory


def energy_less_work(sol: Solution) -> tuple[np.ndarray, bool, str]:
    """The energy less the work of the forces, (…, rows), whether there are forces, and why the system changes it all the
    same ("" if it does not)."""
    energy, system = np.asarray(sol.energy()), sol.system
    forced = "work" in sol.fields and not keeps_books(sol)
    if forced:
        energy = energy - np.asarray(sol.fields["work"])
    if isinstance(system, PortHamiltonian) and (system.R is not None or system.inputs is not None):
        return energy, forced, "does not conserve it"
    if isinstance(system, LagrangeDirac) and system.depends_on_time:
        return energy, forced, "depends on time and does not conserve it"
    if isinstance(system, LagrangeDirac) and system.affine is not None:
        return energy, forced, "has constraints that do work (affine) and does not conserve it"
    return energy, forced, ""


def _energy(sol: Solution) -> Line:
    name = "energy"
    try:
        energy, forced, changes = energy_less_work(sol)
    except ValueError as error:
        return Line(name, None, None, NOT_CHECKED, str(error))
    energy = energy.reshape(-1, energy.shape[-1])
    roundoff = ROUNDINGS * EPSILON * _steps(sol) * _energy_scale(sol, energy)
    if changes:
        change = float(np.nanmax(np.abs(energy - energy[:, :1])))
        return Line(name, change, None, NOT_CHECKED, f"the system {changes}; it changed by {change:.3g}")
    t, found = np.asarray(sol.t), []
    for lane, series in enumerate(energy):
        good = np.isfinite(series)
        found.append(judge(t[good], series[good], _motion(sol, lane)[good], roundoff))
    order = (NOT_CHECKED, BOUNDED, DRIFTS)
    lane = max(range(len(found)), key=lambda i: (order.index(found[i].verdict), abs(found[i].drift)))
    worst = found[lane]
    details: dict[str, Any] = {**worst.details, "roundoff": roundoff}
    if sol.batch is not None:
        details["per_trajectory"] = [f.drift for f in found]
        details["verdicts"] = [f.verdict for f in found]
    text = "less the work of the forces: " * forced + worst.text + _lane(sol, lane)
    others = sorted({f.verdict for f in found} - {worst.verdict})
    text += "".join(f"; {details['verdicts'].count(other)} of {len(found)} {other}" for other in others)
    return Line(name, abs(worst.drift), worst.told, worst.verdict, text, details)


def _ports(sol: Solution, tolerance: float | None) -> list[Line]:
    """The balances of a system with ports."""
    if sol.system is None or not isinstance(sol.system, PortHamiltonian | DiracSystem):
        return []
    energy = np.asarray(sol.energy())
    return balances(sol, _energy_scale(sol, energy), tolerance)


def _motion(sol: Solution, lane: int) -> np.ndarray:
    """All node fields of one trajectory side by side, (rows, d)."""
    nodes = [np.asarray(a) for k, a in sol.fields.items() if sol.field_info[k].place == "node"]
    rows = [a if sol.batch is None else a[lane] for a in nodes]
    return np.concatenate([a.reshape(len(a), -1) for a in rows], axis=1)


def _energy_scale(sol: Solution, energy: np.ndarray) -> float:
    """|E| + |∂E/∂row| |row|, the largest: what roundings of the rows do to the energy, in units of ε."""
    scale = float(np.nanmax(np.abs(energy)))
    return scale if sol.system is None else scale + float(np.nanmax(_sampled_terms(sol, _energy_terms)))


def _sampled_terms(sol: Solution, terms: Callable) -> np.ndarray:
    """terms(system, row, params) at a few rows."""
    rows = _spread(sol.rows, SAMPLED_ROWS)
    lead = (slice(None),) * (sol.batch is not None)
    nodes = {k: np.asarray(a)[(*lead, rows)] for k, a in sol.fields.items() if sol.field_info[k].place == "node"}
    return over_rows(eqx.Partial(terms, sol.system), sol, (_times(sol, rows), nodes))


def _constraint_terms(system: Any, t, row: dict, params: Any):
    """Σ |∂c/∂row_i| |row_i|, the largest over the constraints c."""
    derivative = jax.jacfwd(lambda row: system.constraint_at({**row, "t": t}, params))(row)
    return jnp.max(sum(jnp.abs(derivative[name]) @ jnp.abs(row[name]) for name in row), initial=0.0)


def _energy_terms(system: Any, t, row: dict, params: Any):
    """Σ |∂E/∂row_i| |row_i|."""
    gradient = jax.grad(lambda row: system.energy_at({**row, "t": t}, params))(row)
    return sum(jnp.sum(jnp.abs(gradient[name] * row[name])) for name in row)


def _momentum(sol: Solution, name: str, generator: Callable, tolerance: float | None) -> Line:
    title = f"momentum map {name}"
    if "p" not in sol.fields or "q" not in sol.fields:
        return Line(title, None, None, NOT_CHECKED, "the solution has no q and p")
    values = over_rows(eqx.Partial(_momentum_terms, generator), sol, (jnp.asarray(sol.q), jnp.asarray(sol.p)))
    change = np.nanmax(np.abs(values[..., 0] - values[:, :1, 0]), axis=1)
    scale = np.nanmax(values[..., 1], axis=1)
    relative = np.divide(change, scale, out=np.zeros_like(change), where=scale > 0)
    lane = int(np.argmax(relative))
    text = f"⟨p, ξ⟩ = {values[lane, 0, 0]:.6g} changed by at most {change[lane]:.2g}{_lane(sol, lane)}"
    return _judged(sol, title, relative, _limit(tolerance, _steps(sol)), text)


def _momentum_terms(generator: Callable, q, p, params: Any):
    terms = p * generator(q)
    return jnp.stack([jnp.sum(terms), jnp.sum(jnp.abs(terms))])


def _generators(sol: Solution, symmetries: Symmetries) -> dict[str, Callable]:
    if symmetries is None:
        return {}
    if isinstance(symmetries, Mapping):
        for name, generator in symmetries.items():
            if not callable(generator):
                raise TypeError(
                    f"symmetries[{name!r}] must be a function generator(q) -> (n,), but a {type(generator).__name__} was given."
                )
            if "q" in sol.fields:
                _check_generator(name, generator, np.shape(sol.q)[-1])
        return {str(name): generator for name, generator in symmetries.items()}
    if isinstance(symmetries, (str, bytes)) or not isinstance(symmetries, Sequence | np.ndarray):
        raise TypeError(
            "symmetries must be a dict {name: generator(q)} or a list of coordinate numbers, but a "
            f"{type(symmetries).__name__} was given."
        )
    if "q" not in sol.fields:
        raise ValueError(f"symmetries need a solution with q and p, but this one holds {', '.join(sol.fields)}.")
    n, found = np.shape(sol.q)[-1], {}
    for index in symmetries:
        if isinstance(index, bool) or not isinstance(index, (int, np.integer)) or not 0 <= index < n:
            raise ValueError(f"symmetries must name coordinates by whole numbers from 0 to {n - 1}, but {index!r} was given.")
        found[f"p[{int(index)}]"] = eqx.Partial(_translation, int(index))
    return found


def _translation(index: int, q):
    return jnp.zeros_like(q).at[index].set(1.0)


def _check_generator(name: str, generator: Callable, n: int) -> None:
    try:
        out = jax.eval_shape(generator, jax.ShapeDtypeStruct((n,), jnp.float64))
    except Exception as error:
        raise TypeError(
            f"symmetries[{name!r}](q) could not be traced by JAX for q of shape ({n},): "
            f"{type(error).__name__}: {str(error).splitlines()[0]}"
        ) from error
    if getattr(out, "shape", None) != (n,):
        raise ValueError(f"symmetries[{name!r}](q) must return shape ({n},), but it returned {getattr(out, 'shape', out)}.")


# --------------------------------------------------------------------------------------------------------- one step


def _symplecticity(sol: Solution, tolerance: float | None) -> Line:
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
        items = (q[..., rows, :], q[..., rows + 1, :], _times(sol, rows + 1))
        values = over_rows(eqx.Partial(structural_defect, found, sol.equation), sol, items)
    else:
        data = {k: jnp.asarray(sol.fields[k])[..., rows, :] for k in (("x",) if "x" in sol.fields else ("q", "p"))}
        items = (data, _times(sol, rows))
        reason = _cannot_start(sol, data)
        if reason:
            return Line(name, None, None, NOT_CHECKED, reason)
        of_step = poisson_defect if reduced else symplecticity_defect
        values = over_rows(eqx.Partial(of_step, sol.system, sol.equation, sol.step), sol, items)
    defect, condition = values[..., 0], float(np.max(values[..., -1], where=np.isfinite(values[..., -1]), initial=1.0))
    if not np.any(np.isfinite(defect)):
        return Line(name, None, None, NOT_CHECKED, "the step could not be solved again from the saved rows")
    lane, row = _worst(defect)
    at = f"worst of {len(rows)} steps at t = {float(sol.t[rows[row]]):.6g}{_lane(sol, lane)}"
    text = f"‖JΛJᵀ − Λ‖/‖JΛJᵀ‖ of the Lie–Poisson bivector, {at}" if reduced else f"‖JᵀΩJ − Ω‖/‖JᵀΩJ‖, {at}"
    if constrained:
        text = f"on the pairs with w_d = 0, {at}; without dβ it would be off by {values[lane, row, 1]:.2g}"
    limit = _limit(tolerance, stages[0][0].state_size * condition)
    line = _judged(sol, name, np.max(np.where(np.isfinite(defect), defect, 0.0), axis=1), limit, text)
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
    return np.union1d(_spread(int(np.min(reached)) - 1, half), _spread(int(np.max(reached)) - 1, half)).astype(int)


def _times(sol: Solution, rows: np.ndarray):
    t = jnp.asarray(sol.t)[rows]
    return t if sol.batch is None else jnp.broadcast_to(t, (sol.batch, len(rows)))


# ---------------------------------------------------------------------------------------------------------- small things


def _where_reached(values: np.ndarray, items: tuple, sol: Solution) -> np.ndarray:
    """The values, 0 at rows that were not reached, and infinite where finite rows give no finite value."""
    finite = [np.all(np.isfinite(item), axis=-1) for item in items]
    reached = np.logical_and.reduce(finite).reshape(values.shape[:2])[..., None]
    return np.where(reached, np.where(np.isfinite(values), values, np.inf), 0.0)


def _judged(sol: Solution, name: str, per_trajectory: np.ndarray, limit: float, text: str) -> Line:
    worst = float(np.max(per_trajectory))
    details = {"per_trajectory": per_trajectory.tolist()} if sol.batch is not None else {}
    return Line(name, worst, limit, OK if worst <= limit else VIOLATED, text, details)


def _limit(tolerance: float | None, growth: float) -> float:
    return ROUNDINGS * EPSILON * growth if tolerance is None else float(tolerance)


def _worst(values: np.ndarray) -> tuple[int, int]:
    """(trajectory, row) of the largest value; NaN, in rows that were not reached, does not count."""
    lane, row = np.unravel_index(int(np.argmax(np.where(np.isfinite(values), values, -1.0))), values.shape)
    return int(lane), int(row)


def _spread(count: int, most: int) -> np.ndarray:
    """At most `most` different whole numbers from 0 to count − 1, evenly spread."""
    return np.unique(np.linspace(0, count - 1, most).astype(int)) if count > 0 else np.zeros(0, int)


def _lane(sol: Solution, lane: int) -> str:
    return "" if sol.batch is None else f" (trajectory {lane})"


def _steps(sol: Solution) -> int:
    return max(1, round(float(sol.t[-1] - sol.t[0]) / float(sol.step)))


def _title(sol: Solution) -> str:
    scheme, system = (type(part).__name__ if part is not None else "unknown" for part in (sol.scheme, sol.system))
    batch = f", {sol.batch} trajectories" if sol.batch is not None else ""
    return f"{scheme} on {system}: {_steps(sol)} steps of {float(sol.step):.6g}{batch}"
