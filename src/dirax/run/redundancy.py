"""Constraints that follow from others: found where a run begins, left out of its equations, and reported."""

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.numerics.equilibration import geometric_scales
from dirax.numerics.ranks import rank_of_equations
from dirax.numerics.tolerances import CONSTRAINT_DEFECT
from dirax.program.compiled import compiled
from dirax.program.evaluation.functions import at_values
from dirax.program.memo import Same
from dirax.program.tracing import jacobian
from dirax.program.user_functions import constant_entries, is_traced
from dirax.run.start import completed
from dirax.run.validate import Case
from dirax.systems.constraints import Constraints
from dirax.systems.system import AbstractSystem

AWAY = 1e-3
"""How far from the initial point, relative to it, the rank of the constraints is compared."""

TRIED = 8
"""Multipliers, and velocities, at which forces are asked whether they see more of them than is determined."""


def redundant_constraints(system: AbstractSystem, matrices: Any, data: dict, params: Any, t0: float) -> tuple[int, ...]:
    """The numbers of the constraints, in the order of `Solution.multipliers`, that follow from others, given the
    matrices [W; G] (m + c, n), or (B, m + c, n), at the initial points; `data` and `params` are those of the first trajectory.
    A one-form that says what the derivative of a holonomic constraint says is left out before this, which holds positions too.

    Raises `ValueError` where constraints contradict each other, where their rank is larger near the initial point than
    at it, where one of them has no direction, where the trajectories of a batch differ in what is redundant, and where forces
    see multipliers of which only the sum [W; G]ᵀμ is determined.
    """
    if matrices is None or not np.size(matrices):
        return ()
    matrices = np.asarray(matrices)
    matrices = matrices if matrices.ndim == 3 else matrices[None]
    if not np.all(np.isfinite(matrices)):
        return ()
    ranks, _ = rank_of_equations(matrices)
    total = matrices.shape[1]
    if np.all(ranks == total):
        return ()
    where = f" of trajectory {int(np.argmax(ranks < total))}" if len(ranks) > 1 else ""
    _refuse_singular_point(system, matrices, ranks, where, data, params, t0)
    one_forms = total - (system.sizes(data, params)[2:] or (0,))[0]
    kept = _independent(matrices[:1], [*range(one_forms, total), *range(one_forms)])
    if np.any(ranks != len(kept)) or np.any(rank_of_equations(matrices[:, kept])[0] < len(kept)):
        raise ValueError(
            f"the constraints that follow from others are not the same in all trajectories of the batch (ranks from "
            f"{np.min(ranks)} to {np.max(ranks)} of {total}): run the trajectories in groups."
        )
    _refuse_undetermined_forces(system, matrices[0], len(kept), data, params, t0)
    return tuple(row for row in range(total) if row not in kept)


def without_redundant(system: AbstractSystem, case: Case, project: bool) -> Case:
    """A case with traced values, with the constraints noted in it that are known to follow from others."""
    if not system.constraints.any:
        return case
    return replace(case, redundant=redundant_in_numbers(system, case, project))


def redundant_in_numbers(system: AbstractSystem, case: Case, project: bool) -> tuple[int, ...]:
    """The same of a case with traced values, as far as numbers that JAX knows decide it: all of them under `jax.grad`, and of
    constraints that depend on none that are traced under any transformation; none where that is not so."""
    known = replace(case, **{name: jax.tree.map(_number, getattr(case, name)) for name in ("data", "params", "h", "t0")})
    if not known.traced:
        data, params = known.first
        return redundant_constraints(system, completed(system, known, project).constraints, data, params, known.t0)
    several = known.batch_params or any(np.ndim(a) == 2 for a in known.data.values())
    if project or several or case.two_points:
        return ()
    leaves, structure = jax.tree.flatten((known.t0, *known.first))
    moving = [leaf for leaf in leaves if is_traced(leaf)]

    def constraints(*moving):
        rest = iter(moving)
        t, data, params = jax.tree.unflatten(structure, [next(rest) if is_traced(leaf) else leaf for leaf in leaves])
        q = system.point(data)
        matrix, still = system.constraints.matrix(t, q, params), jnp.zeros_like(q)
        return jnp.concatenate([matrix, system.constraints.defect(t, q, still, params)[: len(matrix), None]], axis=1)

    found = constant_entries(constraints, *moving)
    if found is None or np.any(np.isnan(found)):
        return ()
    t0, data, params = jax.tree.unflatten(structure, [np.ones(np.shape(leaf)) if is_traced(leaf) else leaf for leaf in leaves])
    return redundant_constraints(system, found[:, :-1], data, params, t0)


def _number(leaf: Any) -> Any:
    """What `jax.grad` traces as what it is; other values as they are."""
    number = jax.lax.stop_gradient(leaf) if is_traced(leaf) else leaf
    return np.asarray(number)[()] if isinstance(number, jax.Array) and not is_traced(number) else number


def _independent(matrices: np.ndarray, rows: list[int]) -> list[int]:
    """Those of the rows (of matrices (1, m, n)) that do not follow from the ones before: most of many, so that the next one that
    does is looked for in steps that double, and then between the last two."""
    follows = lambda rows: rank_of_equations(matrices[:, rows])[0][0] < len(rows)
    kept: list[int] = []
    while rows:
        most, step = 0, 1
        while most < len(rows) and not follows([*kept, *rows[: most + step]]):
            most, step = min(most + step, len(rows)), 2 * step
        least = min(most + step, len(rows))
        while least - most > 1:
            middle = (most + least) // 2
            most, least = (most, middle) if follows([*kept, *rows[:middle]]) else (middle, least)
        kept, rows = [*kept, *rows[:most]], rows[most + 1 :]
    return kept


def _refuse_singular_point(system, matrices, ranks, where, data, params, t0) -> None:
    """Raise where the dependence is not one of the constraints as functions, or where they have no common solution."""
    constraints: Constraints = system.constraints
    total = matrices.shape[1]
    zero = np.flatnonzero(np.any(np.all(matrices == 0.0, axis=2), axis=0))
    if len(zero):
        raise ValueError(
            f"constraint {zero[0]} (in the order of the multipliers: one_forms, then holonomic) has no direction at the "
            f"initial data{where}: its row of [W; ∂g/∂q] is zero there. Leave it out, or start elsewhere."
        )
    values = np.asarray(system.point(data), float), params, np.asarray(t0, float)
    nearby = _Nearby(Same(system))
    found = at_values(nearby, values)
    near, left, terms = map(np.asarray, compiled(nearby, seldom=True)(*values) if found is None else found[0])
    bad = np.abs(left) > CONSTRAINT_DEFECT * terms
    if np.any(bad):
        worst = np.where(bad, left, 0.0)
        raise ValueError(
            f"the constraints ({constraints.names}) contradict each other at the initial data: their rank is {np.min(ranks)} "
            f"of {total}, and the nearest point and velocity leave the residual {np.array2string(worst, precision=4)}. Take "
            "out those that cannot hold."
        )
    nearby = int(rank_of_equations(near[None])[0][0])
    if nearby > np.min(ranks):
        raise ValueError(
            f"the constraints ({constraints.names}) are dependent at the initial data{where}, with rank {np.min(ranks)} of "
            f"{total}, but have rank {nearby} nearby: a singular configuration, where the multipliers are not determined. "
            "Start elsewhere."
        )


def _refuse_undetermined_forces(system, matrix, rank, data, params, t0) -> None:
    """Raise where forces change with the multipliers μ along the null vectors N of [W; G]ᵀ, with `rank` rows that do not follow
    from others: at velocities and multipliers of which none is zero."""
    if not getattr(system, "forces_see_multipliers", False):
        return
    rows, columns = geometric_scales(np.abs(matrix))
    null = np.linalg.svd(matrix / rows / columns)[0][:, rank:]
    q, v = (np.asarray(a, float) for a in (system.point(data), data.get("v", 0.0)))
    rng, size, slope = np.random.default_rng(0), np.max(np.abs(v)) or 1.0, _ForcesByMultipliers(Same(system))
    for _ in range(TRIED):
        moving = v + size * rng.uniform(-1.0, 1.0, len(q))
        multipliers = rng.choice([-1.0, 1.0], len(rows)) * rng.uniform(0.5, 1.0, len(rows)) / rows[:, 0]
        values = np.asarray(t0, float), q, moving, multipliers, params
        found = at_values(slope, values)
        by_unit = np.asarray(compiled(slope, seldom=True)(*values) if found is None else found[0]) / rows.T / columns.T
        if np.max(np.abs(by_unit @ null)) > CONSTRAINT_DEFECT * np.max(np.abs(by_unit)):
            raise ValueError(
                f"the forces see multipliers that nothing determines: the constraints ({system.constraints.names}) have rank "
                f"{rank} of {len(matrix)} at the initial data, so that of their multipliers μ only [W; ∂g/∂q]ᵀμ is known, and "
                "not how they share it. Leave out the constraints that follow from others (support a body at three points), or "
                "let the forces depend on [W; ∂g/∂q]ᵀμ alone."
            )


@dataclass(frozen=True)
class _ForcesByMultipliers:
    """(t, q, v, μ, params) ↦ ∂f/∂μ (n, k), at the velocity on the constraints that is nearest to v."""

    same: Same

    def __call__(self, t, q, v, multipliers, params):
        system = self.same.object
        v = system.project_velocity(q, v, params, t)
        return jacobian(lambda multipliers: system.forces(t, q, v, multipliers, params))(multipliers)


@dataclass(frozen=True)
class _Nearby:
    """(q, params, t) ↦ [W; G] at an admissible point near q, and the residual (W v + b, g, G v + ∂g/∂t) that no point and no
    velocity nearest to q makes zero, with the sizes of its terms."""

    same: Same

    def __call__(self, q, params, t):
        system, constraints = self.same.object, self.same.object.constraints
        still = jnp.zeros_like(q)
        nearest = system.project_position(q, still, params, t)
        v = system.project_velocity(nearest, still, params, t)
        residual, terms = constraints.defect(t, nearest, v, params), constraints.terms(t, nearest, v, still, params)
        direction, size = np.random.default_rng(len(q)).uniform(0.5, 1.0, len(q)), jnp.max(jnp.abs(q))
        away = nearest + AWAY * jnp.where(size > 0.0, size, 1.0) * direction
        return constraints.matrix(t, system.project_position(away, still, params, t), params), residual, terms
