"""Initial data: from what the user gave to the first state of an equation, with the checks that refuse bad data."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dirax.functions import check_finite, is_traced

KINDS = ({"q", "v"}, {"q", "p"}, {"q0", "q1"}, {"x"})
OFF_CONSTRAINT = 1e-9
"""Largest admissible |W v| relative to |W|·|v| for initial data that are to satisfy the constraint."""


class Start(NamedTuple):
    """Where a run begins: first state and guess, the given row 0 of a two-point start, and how far off the constraint."""

    state: Any
    guess: Any
    row0: dict | None
    first_step: int
    defect: Any
    size: Any


def initial_data(given: dict[str, Any]) -> tuple[dict[str, jax.Array], int | None]:
    """The initial data as float64 arrays of shape (n,) or (B, n), and B (None for one trajectory)."""
    if set(given) not in KINDS:
        raise ValueError(
            "initial data must be one of q=, v= · q=, p= · q0=, q1= · x=, but "
            f"{', '.join(sorted(given)) + '=' if given else 'none'} was given."
        )
    arrays = {}
    for name, value in given.items():
        array = value if is_traced(value) else np.asarray(value)
        if not (jnp.issubdtype(array.dtype, jnp.floating) or jnp.issubdtype(array.dtype, jnp.integer)):
            raise TypeError(f"{name} must hold real numbers, but its dtype is {array.dtype}.")
        if array.ndim not in (1, 2) or 0 in array.shape:
            raise ValueError(
                f"{name} must have shape (n,), or (B, n) for a batch of B trajectories, but its shape is {array.shape}."
            )
        check_finite(name, array)
        arrays[name] = jnp.asarray(array, dtype=jnp.float64)
    shapes = {name: array.shape for name, array in arrays.items()}
    if len({shape[-1] for shape in shapes.values()}) > 1:
        a, b = shapes
        raise ValueError(f"{a} and {b} must have the same length n, but their shapes are {shapes[a]} and {shapes[b]}.")
    batches = {shape[0] for shape in shapes.values() if len(shape) == 2}
    if len(batches) > 1:
        raise ValueError(f"the initial data have different batch sizes: {shapes}.")
    batch = batches.pop() if batches else None
    if batch is not None:
        arrays = {name: jnp.broadcast_to(a, (batch, a.shape[-1])) for name, a in arrays.items()}
    return arrays, batch


def prepared(system, equation, data, params, h, batch, batch_params: bool, project: bool) -> Start:
    """The Start of every trajectory."""
    stage, fraction = equation.stages[0]
    two_points = "q0" in data
    if two_points and len(equation.stages) > 1:
        raise ValueError(
            "a composition cannot start from q0= and q1=, which belong to one step: give q= with v= or p=."
        )

    def one(data, params):
        complete = system.complete(data, params, project)
        defect, size = system.initial_defect(complete, params), jnp.array(1.0)
        state, u = stage.start(complete, fraction * h, params)
        row0 = None
        if two_points:
            t = jnp.array(0.0)
            row0 = stage.unpack(state, u, t, h, params)
            defect = row0.get("constraint", defect)
            state = stage.advance(u, state, t, h, params)
        if "v" in complete or two_points:
            v = complete["v"] if "v" in complete else (data["q1"] - data["q0"]) / h
            size = jnp.max(jnp.abs(v))
        return state, u, row0, defect, size

    if batch is not None:
        data = {k: jnp.broadcast_to(a, (batch, a.shape[-1])) for k, a in data.items()}
        one = jax.vmap(one, in_axes=(0, 0 if batch_params else None))
    state, u, row0, defect, size = jax.jit(one)(data, params)
    if row0 is not None:
        row0 = {k: (a if batch is not None else a[None]) for k, a in row0.items()}
        if not is_traced(row0):
            row0 = {k: np.asarray(a) for k, a in row0.items()}
    return Start(state, u, row0, int(two_points), defect, size)


def refuse_off_constraint(start: Start, projected: bool) -> None:
    """Raise `ValueError` with the residual for initial data off the constraint."""
    defect = np.atleast_2d(np.asarray(start.defect))
    if defect.size == 0:
        return
    size = np.atleast_1d(np.asarray(start.size))
    worst = np.max(np.abs(defect), axis=-1)
    bad = worst > OFF_CONSTRAINT * np.maximum(size, 1.0)
    if np.any(bad):
        lane = int(np.argmax(bad))
        which = f" of trajectory {lane}" if len(worst) > 1 else ""
        way = (
            "for q0=, q1= choose q1 on the discrete constraint, or pass check_initial=False to take the points as they are"
            if start.first_step
            else "pass project=True to project them, or check_initial=False to take them as they are"
        )
        raise ValueError(
            f"the initial data{which} are off the constraint: its residual is {np.array2string(defect[lane], precision=4)} "
            f"(largest {worst[lane]:.3g}); {way}."
        )


def refuse_singular_start(equation, start: Start, h, t0, params, batch, batch_params: bool) -> None:
    """Raise `ValueError` with the rank where the Jacobian of the first step is singular ([PY] (21))."""
    stage, fraction = equation.stages[0]
    if stage.unknowns == 0:
        return
    first = (lambda a: a[0]) if batch is not None else (lambda a: a)
    state, u = first(start.state), first(start.guess)
    one_params = jax.tree.map(lambda a: a[0], params) if batch_params else params
    args = (state, jnp.asarray(t0 + start.first_step * h), fraction * h, one_params)
    residual = np.asarray(stage.residual(u, *args))
    jacobian = np.asarray(jax.jacfwd(stage.residual)(u, *args))
    if not np.all(np.isfinite(residual)) or not np.all(np.isfinite(jacobian)):
        rows = ~np.isfinite(residual) | ~np.all(np.isfinite(jacobian), axis=1)
        raise ValueError(
            f"the equations are not finite at the initial data ({stage.labels[int(np.argmax(rows))]}): the data lie "
            "outside the domain of the system's functions, or on its edge."
        )
    rank, direction = numerical_rank(jacobian)
    if rank < stage.unknowns:
        raise ValueError(
            f"the step cannot be solved: the matrix (21) of the discrete equations has rank {rank} of {stage.unknowns} at "
            f"the initial data (free direction {np.array2string(direction, precision=2, suppress_small=True)} in the "
            "unknowns); the Lagrangian is singular together with its constraints, or the one-forms are dependent: remove "
            "the redundant coordinates or one-forms, or choose another discrete Lagrangian."
        )


def numerical_rank(matrix: np.ndarray, relative: float = 1e-12) -> tuple[int, np.ndarray]:
    """The rank of a matrix after scaling its rows and columns to unit size, and the direction nearest to its kernel."""
    scaled = np.array(matrix, dtype=float)
    columns = np.ones(scaled.shape[1])
    for _ in range(3):
        rows = np.max(np.abs(scaled), axis=1, keepdims=True)
        scaled = scaled / np.where(rows > 0, rows, 1.0)
        sizes = np.max(np.abs(scaled), axis=0)
        sizes = np.where(sizes > 0, sizes, 1.0)
        scaled, columns = scaled / sizes, columns / sizes
    _, values, vt = np.linalg.svd(scaled)
    direction = vt[-1] * columns
    return int(np.sum(values > relative * max(values[0], 1e-300))), direction / np.max(np.abs(direction))
