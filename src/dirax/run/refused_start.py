"""Initial data that a premise of the system or of the scheme excludes: refused before the first step, with the premise."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from dirax.numerics.ranks import rank_of_equations
from dirax.numerics.tolerances import CONSTRAINT_DEFECT, TINY
from dirax.run.start import Initial, SparseJacobians, Start, direction
from dirax.run.validate import Case
from dirax.schemes.adjoint_step import ADJOINT
from dirax.schemes.collocation_step import AT_NODE
from dirax.schemes.lagrange_dalembert_step import PROJECTION
from dirax.schemes.lagrangian_step import METHOD_2
from dirax.systems.system import AbstractSystem

OUTSIDE = "the data lie outside the domain of the system's functions, or on its edge"

AT_ZERO = (
    f"{OUTSIDE}, or forces(…, multipliers) have no derivative at multipliers of zero, with which a run begins, as a norm has "
    "none: write jnp.sqrt(multipliers @ multipliers + small**2)"
)


def refuse_bad_start(
    system: AbstractSystem,
    initial: Initial,
    start: Start,
    labels: Sequence[str],
    check_constraint: bool,
    projected: bool,
    needed: Callable[[], str] | None,
    case: Case,
    shorter: Callable[[], Start],
) -> None:
    """Raise `ValueError` for functions that are not finite at the data, data off the constraints (with the residual), and a
    first step without a unique solution (with the rank of the matrix (21) of [PY]). `labels` are those of
    the equations of the first step; `projected` says that the data have been moved, `needed` what a singular Lagrangian needs.
    `shorter` gives the start of a first step SHORTER times as long: a matrix that is singular at the first guess of a long
    step alone may just be far from the solution."""
    if start.row0 is not None and "constraint" in start.row0:
        both = _lanes(initial.defect, 1), _lanes(start.row0["constraint"], 1)
        initial = initial._replace(defect=np.concatenate(both, axis=-1))
    _refuse_constraints_outside_their_domain(system, initial)
    _refuse_outside_the_domain(initial)
    if check_constraint:
        _refuse_off_constraint(system, initial, start, projected, case)
    if needed and not system.constraints.any and labels[0].startswith(AT_NODE.format(0)):
        raise ValueError(f"collocation takes regular Lagrangians, and ∂²L/∂v² is singular at the initial data: it {needed()}.")
    if start.jacobian is not None:
        once = functools.cache(shorter) if start.row0 is None else None
        form = system.lagrangian_form()
        outside = AT_ZERO if form is not None and form.forces_see_multipliers else OUTSIDE
        _refuse_singular_step(start, labels, needed, initial.lagrangian is not None, once, outside)


def _refuse_outside_the_domain(initial: Initial) -> None:
    if initial.lagrangian is None:
        return
    values = _lanes(initial.lagrangian, 0)
    if not np.all(np.isfinite(values)):
        lane = int(np.argmin(np.isfinite(values)))
        raise ValueError(
            f"lagrangian is {values[lane]} at the initial data{_which(~np.isfinite(values))}: the data lie outside its domain, "
            "or on its edge."
        )


def _refuse_constraints_outside_their_domain(system: AbstractSystem, initial: Initial) -> None:
    if initial.constraints is None or not np.size(initial.constraints):
        return
    for values, ndim in ((initial.constraints, 2), (initial.defect, 1)):
        if not np.size(values):
            continue
        matrices = _lanes(values, ndim)
        finite = np.all(np.isfinite(matrices), axis=tuple(range(1, ndim + 1)))
        if not np.all(finite):
            raise ValueError(
                f"{system.constraints.names} is not finite at the initial data{_which(~finite)}: the data lie outside its "
                "domain, or on its edge."
            )


def _refuse_off_constraint(system: AbstractSystem, initial: Initial, start: Start, projected: bool, case: Case) -> None:
    defect = _lanes(initial.defect, 1)
    if not defect.size:
        return
    size = _lanes(initial.size, 1)[:, : defect.shape[1]]
    worst = np.max(np.abs(defect), axis=-1)
    bad = ~np.all(np.abs(defect) <= CONSTRAINT_DEFECT * size, axis=-1)
    if np.any(bad):
        lane = int(np.argmax(bad))
        way = _way_onto_constraint(system, start.row0 is not None, projected, case)
        more = system.explain(_lanes(start.state, 1)[lane])
        raise ValueError(
            f"the initial data{_which(bad)} are off the constraint, whose residual is "
            f"{np.array2string(defect[lane], precision=4)} (largest {worst[lane]:.3g}); {way}.{more and f' {more}.'}"
        )


def _way_onto_constraint(system: AbstractSystem, two_points: bool, projected: bool, case: Case) -> str:
    if two_points:
        return "choose q1 on the discrete constraint, or pass check_initial=False to take the points as they are"
    if not system.projected:
        near = "x" if case.t0 == 0 else f'{{"x": x, "t": {float(case.t0)!r}}}'
        near += ", params=params" * (case.params is not None)
        return (
            f"nothing projects the data of this {type(system).__name__}: begin on its constraint manifold, where "
            f"dx.constraint_algorithm(system, near={near}).project(x) finds a point, or pass check_initial=False to take them as "
            "they are"
        )
    if projected:
        return f"project=True, which moves {system.projected}, found no place on it: begin nearer to it"
    return "pass project=True to project them, or check_initial=False to take them as they are"


def _refuse_singular_step(
    start: Start,
    labels: Sequence[str],
    needed: Callable[[], str] | None,
    lagrangian: bool,
    shorter: Callable[[], Start] | None,
    outside: str,
) -> None:
    residual, sparse = _lanes(start.residual, 1), isinstance(start.jacobian, SparseJacobians)
    jacobian = start.jacobian.product[:, 0, :, None] if sparse else _lanes(start.jacobian, 2)
    rows = np.isfinite(residual) & np.all(np.isfinite(jacobian), axis=2)
    finite = np.all(rows, axis=1)
    if not np.all(finite):
        if needed:
            raise ValueError(
                f"the first step is not finite at the initial data{_which(~finite)}, since the Lagrangian is singular (∂²L/∂v²), "
                f"and this scheme {needed()}."
            )
        lane = int(np.argmin(finite))
        if shorter and not sparse and _is_finite(shorter(), lane):
            outside = "the step is too long: it leads out of the domain of the system's functions, and a shorter one does not"
        row = int(np.argmin(rows[lane]))
        raise ValueError(f"the first step is not finite at the initial data{_which(~finite)} (in {labels[row]}): {outside}.")
    if sparse:
        return _refuse_singular_sparse_step(start.jacobian, labels, shorter)
    ranks, directions = rank_of_equations(jacobian)
    unknowns = jacobian.shape[1]
    if shorter and np.any(ranks < unknowns):
        ranks = np.maximum(ranks, _ranks_where_finite(_lanes(shorter().jacobian, 2)))
    if np.any(ranks < unknowns):
        lane = int(np.argmax(ranks < unknowns))
        way = (
            "The Lagrangian is singular together with its constraints: remove the coordinates that it does not determine, or "
            "choose another discrete Lagrangian"
        )
        if needed and labels[0].endswith(METHOD_2):
            way = f"This is since the Lagrangian is singular (∂²L/∂v²), and this scheme {needed()}"
        elif needed and _projection_alone(jacobian[lane], labels):
            composed = len(start.guess) > 1
            ends = "a part of a composition ends at" if composed else "this scheme saves, with holonomic constraints,"
            alone = ", or without holonomic constraints the scheme by itself, with smaller steps" * composed
            way = (
                f"The Lagrangian is singular (∂²L/∂v²), and {ends} the momentum of a velocity on the constraints, which such a "
                f"Lagrangian does not determine: take dx.DiscreteDirac(), which projects nothing{alone}"
            )
        elif labels[0].startswith(ADJOINT):
            way = (
                "The step is the inverse of the scheme's step back, and not all components of a state have one: the states of "
                "the scheme are those of a manifold, on which p satisfies the constraints, or q lies. A self-adjoint scheme, "
                "one of the midpoint say, is its own adjoint: take it by itself, or in dx.Composition. dx.LagrangeDAlembert and "
                'its cases, and dx.DiscreteDirac(dx.Theta(θ), "resolve") in coordinates, have adjoints of their own'
            )
        matrix = "its matrix ([PY] (21))"
        if not lagrangian:
            matrix = "the matrix of its equations"
            way = (
                "The equations of the system do not determine it with this scheme: dx.constraint_algorithm(system, near=…) says "
                "what they leave free and on which manifold they hold, and a Hamiltonian on T*Q with one-forms is a "
                "dx.HamiltonDirac, which dx.PlusHamiltonDirac and dx.MinusHamiltonDirac step"
            )
        free = np.array2string(directions[lane], precision=2, suppress_small=True, max_line_width=1000)
        raise ValueError(
            f"the first step has no unique solution: {matrix} has rank {ranks[lane]} of {unknowns} at the "
            f"initial data{_which(ranks < unknowns)}, and leaves the direction "
            f"{free} of the unknowns free. {way}."
        )


def _is_finite(start: Start, lane: int) -> bool:
    """Whether the equations of a first step of a trajectory, and their derivatives, are finite."""
    arrays = _lanes(start.residual, 1)[lane], _lanes(start.jacobian, 2)[lane]
    return all(np.all(np.isfinite(a)) for a in arrays)


def _ranks_where_finite(jacobians: np.ndarray) -> np.ndarray:
    """The ranks (B,) of matrices (B, k, k), 0 of one that is not finite."""
    finite = np.all(np.isfinite(jacobians), axis=(1, 2))
    return rank_of_equations(np.where(finite[:, None, None], jacobians, 0.0))[0]


def _projection_alone(jacobian: np.ndarray, labels: Sequence[str]) -> bool:
    """Whether the equations of a step have a unique solution without those of the projection of its momentum, which are the last
    and have unknowns of their own."""
    steps = sum(not label.startswith(PROJECTION) for label in labels)
    return steps < len(labels) and int(rank_of_equations(jacobian[None, :steps, :steps])[0][0]) == steps


def _refuse_singular_sparse_step(jacobians: SparseJacobians, labels: Sequence[str], shorter: Callable[[], Start] | None) -> None:
    """The same of many unknowns, of which only some are named: those that move most in the direction that is left free.

    That the pattern has all entries is checked by a product with a vector that was not found with it."""
    for lane, (values, products, missed) in enumerate(zip(*jacobians[1:], strict=True)):
        which = f" of trajectory {lane}" if len(jacobians.values) > 1 else ""
        matrix, near = map(jacobians.equations.matrix, values)
        along = direction(matrix.shape[1])
        products = [
            np.abs(a @ along - product) / np.maximum(abs(a) @ along, TINY)
            for a, product in zip((matrix, near), products, strict=True)
        ]
        for what, of in (("residual", missed), ("sparse Jacobian", products)):
            worst = np.max(np.nan_to_num(of), axis=0)  # out of the domain nothing is known
            if np.any(worst > PRODUCT):
                raise AssertionError(f"the {what} of the step is wrong in {labels[int(np.argmax(worst))]}: report this.")
        free = _free_direction(jacobians, lane)
        if free is None or (shorter and _free_direction(shorter().jacobian, lane) is None):
            continue
        most = np.argsort(-np.abs(free))[:4]
        most = most[np.abs(free[most]) > 1e-3 * np.abs(free[most[0]])]
        rows = np.unique(matrix.tocsc()[:, most].indices)
        raise ValueError(
            f"the first step has no unique solution: its matrix ([PY] (21)) is singular at the initial data{which}, and "
            f"leaves a direction free in which the unknowns {', '.join(map(str, np.sort(most)))} move most, which stand in "
            f"{', '.join(labels[int(row)] for row in rows[:4])}. The Lagrangian is singular together with its constraints: "
            "remove the coordinates that it does not determine, constraints that follow from others, or choose another "
            "discrete Lagrangian."
        )


def _free_direction(jacobians: SparseJacobians, lane: int) -> np.ndarray | None:
    from dirax.numerics.sparse.ranks import free_direction  # imported when it is used

    return free_direction(jacobians.equations, jacobians.equations.matrix(jacobians.values[lane][0]))


SHORTER = 2.0**-10
"""Part of a step that is short."""

PRODUCT = 1e-10
"""Difference of two ways to a residual, or to a product of the Jacobian with a vector, relative to terms, that roundoff makes."""


def _lanes(values: Any, ndim: int) -> np.ndarray:
    """With a batch axis in any case."""
    array = np.asarray(values)
    return array if array.ndim > ndim else array[None]


def _which(bad: np.ndarray) -> str:
    return f" of trajectory {int(np.argmax(bad))}" if len(bad) > 1 else ""
