"""Initial data: from what the user gave to the first state of an equation, with the checks that refuse bad data."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dirax.program.user_functions import check_finite, is_traced

KINDS = ({"q", "v"}, {"q", "p"}, {"q0", "q1"}, {"x"}, {"q"})
OFF_CONSTRAINT = 1e-9
"""Largest admissible |W v|, relative to |v| where that is above 1, for initial data that are to satisfy the constraint."""


class Start(NamedTuple):
    """Where a run begins, each entry with a leading batch axis in a batch.

    First state and the first guess of every stage; the given row 0 of a two-point start; how far the data are off the
    constraints, and the size of the velocity; the Lagrangian and the matrix [W; ∂g/∂q] of the constraints at the data, if
    the system has them; the residual and the Jacobian of the first step.
    """

    state: Any
    guess: tuple
    row0: dict | None
    first_step: int
    defect: Any
    size: Any
    lagrangian: Any
    constraints: Any
    residual: Any
    jacobian: Any


def initial_data(given: dict[str, Any]) -> tuple[dict[str, Any], int | None]:
    """The initial data as float64 arrays of shape (n,) or (B, n), NumPy's where no value is traced, and B (None for one
    trajectory)."""
    if set(given) not in KINDS:
        came = ", ".join(f"{name}=" for name in sorted(given)) + (" alone" if len(given) == 1 else "")
        raise ValueError(
            f"initial data must be one of q=, v= · q=, p= · q0=, q1= · x=, but {came if given else 'none'} was given."
        )
    arrays = {name: _real_array(name, value) for name, value in given.items()}
    shapes = {name: array.shape for name, array in arrays.items()}
    if len({shape[-1] for shape in shapes.values()}) > 1:
        a, b = shapes
        raise ValueError(f"{a} and {b} must have the same length n, but their shapes are {shapes[a]} and {shapes[b]}.")
    batches = {shape[0] for shape in shapes.values() if len(shape) == 2}
    if len(batches) > 1:
        a, b = shapes
        raise ValueError(
            f"{a} and {b} must hold the same number of trajectories, but their shapes are {shapes[a]} and {shapes[b]}."
        )
    batch = batches.pop() if batches else None
    if batch is not None:
        arrays = {name: _spread(a, batch) for name, a in arrays.items()}
    return arrays, batch


def _spread(array: Any, batch: int) -> Any:
    return (jnp if is_traced(array) else np).broadcast_to(array, (batch, array.shape[-1]))


def _real_array(name: str, value: Any) -> Any:
    try:
        array = jnp.asarray(value) if is_traced(value) else np.asarray(value)
    except ValueError as error:
        reason = str(error).split(". ")[0].rstrip(".")
        raise ValueError(f"{name} must be an array of numbers, but it could not be made one: {reason}.") from error
    if not (jnp.issubdtype(array.dtype, jnp.floating) or jnp.issubdtype(array.dtype, jnp.integer)):
        raise TypeError(f"{name} must hold real numbers, but its dtype is {array.dtype}.")
    if array.ndim not in (1, 2) or 0 in array.shape:
        raise ValueError(f"{name} must have shape (n,), or (B, n) for a batch of B trajectories, but its shape is {array.shape}.")
    check_finite(name, array)
    return array.astype(np.float64)


def prepared(system, equation, data, params, h, t0, batch, batch_params: bool, project: bool) -> Start:
    """The Start of every trajectory."""
    if "q0" in data and len(equation.stages) > 1:
        raise ValueError("a composition cannot start from q0= and q1=, which belong to one step: give q= with v= or p=.")
    axes = None if batch is None else (0, 0 if batch_params else None, None, None)
    if batch is not None:  # the batch axis can be that of the parameters alone
        data = {name: _spread(a, batch) for name, a in data.items()}
    start = None
    if not is_traced(data, params, h, t0):
        start = _begin_on_host(system, equation, data, params, h, t0, batch, batch_params, project)
    if start is None:
        start = _begin(system, equation, data, params, jnp.asarray(h, float), jnp.asarray(t0, float), axes, project)
    if start.row0 is not None:
        row0 = {k: (a if batch is not None else a[None]) for k, a in start.row0.items()}
        start = start._replace(row0=row0 if is_traced(row0) else {k: np.asarray(a) for k, a in row0.items()})
    return start


@eqx.filter_jit
def _begin(system, equation, data, params, h, t0, axes, project: bool) -> Start:
    """One compiled function for all of it, reused by later runs of the same system and scheme."""
    one = _beginning(system, equation, "q0" in data, project)
    start = (one if axes is None else jax.vmap(one, in_axes=axes))(data, params, h, t0)
    return start._replace(first_step=int("q0" in data))


def _begin_on_host(system, equation, data, params, h, t0, batch, batch_params: bool, project: bool) -> Start | None:
    """The same without a compiler, which takes longer than all that has to be computed; None where that cannot be."""
    from dirax.engines.linearization import linearized  # imported when they are used
    from dirax.program.evaluation.on_host import on_host

    spread = lambda leaf: np.broadcast_to(np.asarray(leaf), (batch or 1, *np.shape(leaf)))
    given = lambda leaf: np.asarray(leaf) if batch is not None else np.asarray(leaf)[None]
    arguments = (jax.tree.map(given, data), jax.tree.map(given if batch_params else spread, params), spread(h), spread(t0))
    leaves, structure = jax.tree.flatten(arguments)
    two_points = "q0" in data
    one = _beginning(system, equation, two_points, project, first_step=False)
    start = on_host(lambda *leaves: one(*jax.tree.unflatten(structure, leaves)), leaves, (system, equation), (structure, project))
    if start is None:
        return None
    stage, fraction = equation.stages[0]
    if stage.unknowns:
        t = spread(t0 + two_points * h)
        found = linearized(equation, params, batch_params, start.guess[0], start.state, t, spread(fraction * h))
        if found is None:
            return None
        start = start._replace(residual=found[0], jacobian=found[1])
    start = start if batch is not None else jax.tree.map(lambda leaf: leaf[0], start._replace(first_step=None))
    return start._replace(first_step=int(two_points))


def _beginning(system, equation, two_points: bool, project: bool, first_step: bool = True):
    """(data, params, h, t0) ↦ the Start of one trajectory; its residual and Jacobian are left out without `first_step`."""
    stage, fraction = equation.stages[0]

    def one(data, params, h, t0):
        complete = {**system.complete({**data, "t": t0}, params, project), "t": t0}
        defect, size = system.initial_defect(complete, params), jnp.array(1.0)
        state, u = stage.start(complete, fraction * h, params)
        guess = (u, *(other.start(complete, part * h, params)[1] for other, part in equation.stages[1:]))
        row0 = None
        if two_points:
            row0 = stage.unpack(state, u, t0, h, params)
            defect = jnp.concatenate([defect, row0["constraint"]]) if "constraint" in row0 else defect
            state = stage.advance(u, state, t0, h, params)
            size = jnp.max(jnp.abs(data["q1"] - data["q0"])) / h
        elif "v" in complete:
            size = jnp.max(jnp.abs(complete["v"]))
        q, v = (data["q0"], (data["q1"] - data["q0"]) / h) if two_points else (complete.get("q"), complete.get("v"))
        lagrangian = None if q is None or v is None else system.lagrangian_value(t0, q, v, params)
        constraints = system.constraints.matrix(t0, system.point(complete), params) if system.constraints.any else None
        t = t0 + int(two_points) * h
        solved = lambda u: stage.residual(u, state, t, fraction * h, params)
        residual, jacobian = (solved(u), jax.jacfwd(solved)(u)) if stage.unknowns and first_step else (None, None)
        return Start(state, guess, row0, int(two_points), defect, size, lagrangian, constraints, residual, jacobian)

    return one


def refuse_bad_start(system: Any, start: Start, labels: tuple[str, ...], check_constraint: bool) -> None:
    """Raise `ValueError` for functions that are not finite at the data, data off the constraints (with the residual), and a
    first step without a unique solution (with the rank of the matrix (21) of [PY]). `labels` are those of
    the equations of the first step."""
    _refuse_constraints_outside_their_domain(system, start)
    _refuse_outside_the_domain(start)
    if check_constraint:
        _refuse_off_constraint(system, start)
    if start.jacobian is not None:
        _refuse_singular_step(start, labels)


def _refuse_outside_the_domain(start: Start) -> None:
    if start.lagrangian is None:
        return
    values = _lanes(start.lagrangian, 0)
    if not np.all(np.isfinite(values)):
        lane = int(np.argmin(np.isfinite(values)))
        raise ValueError(
            f"lagrangian is {values[lane]} at the initial data{_which(~np.isfinite(values))}: the data lie outside its domain, "
            "or on its edge."
        )


def _refuse_constraints_outside_their_domain(system: Any, start: Start) -> None:
    if start.constraints is None or not np.size(start.constraints):
        return
    for values, ndim in ((start.constraints, 2), (start.defect, 1)):
        if not np.size(values):
            continue
        matrices = _lanes(values, ndim)
        finite = np.all(np.isfinite(matrices), axis=tuple(range(1, ndim + 1)))
        if not np.all(finite):
            raise ValueError(
                f"{system.constraints.names} is not finite at the initial data{_which(~finite)}: the data lie outside its "
                "domain, or on its edge."
            )


def _refuse_off_constraint(system: Any, start: Start) -> None:
    defect = _lanes(start.defect, 1)
    if not defect.size:
        return
    worst = np.max(np.abs(defect), axis=-1)
    bad = ~(worst <= OFF_CONSTRAINT * np.maximum(_lanes(start.size, 0), 1.0))
    if np.any(bad):
        lane = int(np.argmax(bad))
        way = (
            "choose q1 on the discrete constraint, or pass check_initial=False to take the points as they are"
            if start.first_step
            else "pass project=True to project them, or check_initial=False to take them as they are"
        )
        more = system.explain(_lanes(start.state, 1)[lane])
        raise ValueError(
            f"the initial data{_which(bad)} are off the constraint, whose residual is "
            f"{np.array2string(defect[lane], precision=4)} (largest {worst[lane]:.3g}); {way}.{more and f' {more}.'}"
        )


def _refuse_singular_step(start: Start, labels: tuple[str, ...]) -> None:
    residual, jacobian = _lanes(start.residual, 1), _lanes(start.jacobian, 2)
    rows = np.isfinite(residual) & np.all(np.isfinite(jacobian), axis=2)
    finite = np.all(rows, axis=1)
    if not np.all(finite):
        row = int(np.argmin(rows[np.argmin(finite)]))
        raise ValueError(
            f"the first step is not finite at the initial data{_which(~finite)} (in {labels[row]}): the data lie outside the "
            "domain of the system's functions, or on its edge."
        )
    ranks, directions = numerical_rank(jacobian)
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


def numerical_rank(matrices: np.ndarray, relative: float = 1e-12) -> tuple[np.ndarray, np.ndarray]:
    """The ranks of matrices (B, k, l) with rows and columns scaled to unit size, and directions nearest to their kernels."""
    scaled = np.array(matrices, dtype=float)
    columns = np.ones((len(scaled), 1, scaled.shape[2]))
    for _ in range(3):
        rows = np.max(np.abs(scaled), axis=2, keepdims=True)
        scaled /= np.where(rows > 0, rows, 1.0)
        sizes = np.max(np.abs(scaled), axis=1, keepdims=True)
        sizes = np.where(sizes > 0, sizes, 1.0)
        scaled, columns = scaled / sizes, columns / sizes
    _, values, vt = np.linalg.svd(scaled)
    directions = vt[:, -1] * columns[:, 0]
    directions /= np.max(np.abs(directions), axis=1, keepdims=True)
    return np.sum(values > relative * np.maximum(values[:, :1], 1e-300), axis=1), directions
