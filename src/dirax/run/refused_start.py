"""Initial data that a premise of the system or of the scheme excludes: refused before the first step, with the premise."""

from typing import Any

import numpy as np

from dirax.numerics.ranks import rank_of_equations
from dirax.numerics.tolerances import CONSTRAINT_DEFECT
from dirax.run.start import Initial, Start
from dirax.systems.system import AbstractSystem


def refuse_bad_start(
    system: AbstractSystem, initial: Initial, start: Start, labels: tuple[str, ...], check_constraint: bool, singular: bool
) -> None:
    """Raise `ValueError` for functions that are not finite at the data, data off the constraints (with the residual), and a
    first step without a unique solution (with the rank of the matrix (21) of [PY]). `labels` are those of
    the equations of the first step; `singular` says that the Lagrangian is."""
    if start.row0 is not None and "constraint" in start.row0:
        both = _lanes(initial.defect, 1), _lanes(start.row0["constraint"], 1)
        initial = initial._replace(defect=np.concatenate(both, axis=-1))
    _refuse_constraints_outside_their_domain(system, initial)
    _refuse_outside_the_domain(initial)
    if check_constraint:
        _refuse_off_constraint(system, initial, start)
    if start.jacobian is not None:
        _refuse_singular_step(start, labels, singular)


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


def _refuse_off_constraint(system: AbstractSystem, initial: Initial, start: Start) -> None:
    defect = _lanes(initial.defect, 1)
    if not defect.size:
        return
    size = _lanes(initial.size, 1)[:, : defect.shape[1]]
    worst = np.max(np.abs(defect), axis=-1)
    bad = ~np.all(np.abs(defect) <= CONSTRAINT_DEFECT * size, axis=-1)
    if np.any(bad):
        lane = int(np.argmax(bad))
        way = (
            "choose q1 on the discrete constraint, or pass check_initial=False to take the points as they are"
            if start.row0 is not None
            else "pass project=True to project them, or check_initial=False to take them as they are"
        )
        more = system.explain(_lanes(start.state, 1)[lane])
        raise ValueError(
            f"the initial data{_which(bad)} are off the constraint, whose residual is "
            f"{np.array2string(defect[lane], precision=4)} (largest {worst[lane]:.3g}); {way}.{more and f' {more}.'}"
        )


def _refuse_singular_step(start: Start, labels: tuple[str, ...], singular: bool) -> None:
    residual, jacobian = _lanes(start.residual, 1), _lanes(start.jacobian, 2)
    rows = np.isfinite(residual) & np.all(np.isfinite(jacobian), axis=2)
    finite = np.all(rows, axis=1)
    if not np.all(finite):
        if singular:
            raise ValueError(
                f"the first step is not finite at the initial data{_which(~finite)}, since the Lagrangian is singular (∂²L/∂v²), "
                'and this scheme needs its final manifold: simulate dx.constraint_algorithm(system, near={"q": …, "v": …})'
                ".resolved() instead of the system, from x=chain.point."
            )
        row = int(np.argmin(rows[np.argmin(finite)]))
        raise ValueError(
            f"the first step is not finite at the initial data{_which(~finite)} (in {labels[row]}): the data lie outside the "
            "domain of the system's functions, or on its edge."
        )
    ranks, directions = rank_of_equations(jacobian)
    unknowns = jacobian.shape[1]
    if np.any(ranks < unknowns):
        lane = int(np.argmax(ranks < unknowns))
        raise ValueError(
            f"the first step has no unique solution: its matrix ([PY] (21)) has rank {ranks[lane]} of {unknowns} at the "
            f"initial data{_which(ranks < unknowns)}, and leaves the direction "
            f"{np.array2string(directions[lane], precision=2, suppress_small=True)} of the unknowns free. The Lagrangian is "
            "singular together with its constraints: remove the coordinates that it does not determine, or choose another "
            "discrete Lagrangian."
        )


def _lanes(values: Any, ndim: int) -> np.ndarray:
    """With a batch axis in any case."""
    array = np.asarray(values)
    return array if array.ndim > ndim else array[None]


def _which(bad: np.ndarray) -> str:
    return f" of trajectory {int(np.argmax(bad))}" if len(bad) > 1 else ""
