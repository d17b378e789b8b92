"""Initial data of a machine: given coordinates kept, the others found so that every joint and contact is met."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from dirax.program.tracing import jacobian
from dirax.program.user_functions import evaluated

MET = 1e-11
"""Residual of a constraint, relative to 1 + |q|, that counts as met."""

DEPENDENT = 1e-9
"""Part of a row across the rows before it, relative to the row, below which it depends on them."""

ASIDE = (0.1, 0.3, 1.0)
"""How far from a start at which the machine is not assembled others are tried, in every coordinate (rad, units of length)."""

MOST_STEPS = 200
RANK = 1e-10


class Assembly:
    """The functions that the search for initial data evaluates, each traced once for a model."""

    def __init__(self, constraints: Any):
        self.constraints = constraints

    def position(self, q: Any, params: Any) -> tuple[Any, Any]:
        """g and ∂g/∂q."""
        g = lambda q: self.constraints.position_defect(0.0, q, params)
        return g(q), jacobian(g)(q)

    def rows(self, q: Any, params: Any) -> Any:
        """[W; ∂g/∂q]."""
        return self.constraints.matrix(0.0, q, params)


def assembled(model: Any, q: Any, v: Any, params: Any) -> dict[str, np.ndarray]:
    """The initial data {"q", "v"} of `Model.state`."""
    start, fixed = _given(model, q, "q", _rest(model))
    system = model.system
    place = start
    if system.holonomic is not None:
        positions = lambda q: tuple(map(np.asarray, evaluated(model.assembly.position, q, params)))
        place = _assembled_place(model, positions, start, fixed)
    speed, kept = _given(model, v, "v", np.zeros(len(start)))
    if system.constraints.any:
        speed = _moving(model, place, speed, kept, params)
    return {"q": place, "v": speed}


def _assembled_place(model: Any, positions: Callable, start: np.ndarray, fixed: np.ndarray) -> np.ndarray:
    """Where the machine is assembled: from the start, and where that is a dead centre, at which no joint knows which way to give,
    from places beside it."""
    place, rng = _solved(positions, start, ~fixed), np.random.default_rng(0)
    for size in (0.0, *ASIDE):
        other = place if size == 0 else _solved(positions, start + size * rng.uniform(-1, 1, len(start)) * ~fixed, ~fixed)
        if not _unmet(model, positions(other)[0], other):
            return other
    missed = _unmet(model, positions(place)[0], place)
    listed = ", ".join(f"{name} by {value:.3g}" for name, value in missed)
    kept = [name for name, given in zip(model.coordinates, fixed, strict=True) if given]
    way = f"Leave some of the given coordinates ({', '.join(kept)}) open" if kept else "Change the lengths of the bodies"
    raise ValueError(f"the machine cannot be assembled near these data: {listed}. {way}, or start from others.")


def _rest(model: Any) -> np.ndarray:
    """Zero, quaternions of no rotation, and axes upwards."""
    q = np.zeros(len(model.coordinates))
    for _, motion, place in model.unit_vectors:
        q[place] = motion.rest
    return q


def _given(model: Any, values: Any, name: str, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values of all coordinates, and which of them were given by name."""
    fixed = np.zeros(len(start), dtype=bool)
    if values is None:
        return start, fixed
    if not isinstance(values, Mapping):
        array = np.asarray(values, float)
        if array.shape != start.shape:
            raise ValueError(
                f"{name} must be numbers by coordinate or an array of shape {start.shape}, but its shape is {array.shape}: "
                f"the coordinates are {', '.join(model.coordinates)}."
            )
        return array.copy(), fixed
    start = start.copy()
    for key, value in values.items():
        if key not in model.coordinates:
            raise ValueError(f"{name} has {key!r}, but the coordinates are {', '.join(model.coordinates)}.")
        if isinstance(value, str) or np.ndim(value) != 0 or not np.isfinite(value):
            raise ValueError(f"{name} of {key!r} must be a finite number, but it is {value!r}.")
        k = model.coordinates.index(key)
        start[k], fixed[k] = float(value), True
    return start, fixed


def _solved(function: Callable, start: np.ndarray, free: np.ndarray) -> np.ndarray:
    """The point nearest to `start` where the function vanishes, as far as it can be found: Gauss–Newton steps of least length in
    the free coordinates, halved while they do not help."""
    x = start.copy()
    value, slope = function(x)
    for _ in range(MOST_STEPS):
        size = np.linalg.norm(value)
        if size == 0 or not np.isfinite(size):
            break
        step = np.zeros_like(x)
        step[free] = np.linalg.lstsq(slope[:, free], -value, rcond=RANK)[0]
        fraction = 1.0
        while fraction > 1e-6:
            following = function(x + fraction * step)
            if np.linalg.norm(following[0]) < (1 - fraction / 4) * size:
                break
            fraction /= 2
        else:
            break
        x, (value, slope) = x + fraction * step, following
    return x


def _unmet(model: Any, defect: np.ndarray, q: np.ndarray) -> list[tuple[str, float]]:
    """The holonomic constraints that are not met, and by how much."""
    names = model.constraints[-len(defect) :]
    return [(n, d) for n, d in zip(names, defect, strict=True) if not abs(d) <= MET * (1 + np.abs(q).max())]


def _moving(model: Any, q: np.ndarray, v: np.ndarray, kept: np.ndarray, params: Any) -> np.ndarray:
    """The velocity on the constraints nearest to v that leaves the given ones."""
    rows = np.asarray(evaluated(model.assembly.rows, q, params))
    defect = rows @ v
    for _ in range(3):  # once, and twice against roundoff
        v = v.copy()
        v[~kept] -= np.linalg.lstsq(rows[:, ~kept], defect, rcond=RANK)[0]
        defect = rows @ v
    size = MET * (1 + np.abs(v).max()) * (1 + np.abs(rows).max())
    missed = [(n, d) for n, d in zip(model.constraints, defect, strict=True) if not abs(d) <= size]
    if missed:
        listed = ", ".join(f"{name} by {value:.3g}" for name, value in missed)
        given = [name for name, k in zip(model.coordinates, kept, strict=True) if k]
        raise ValueError(
            f"no velocity has the given ones ({', '.join(given)}) and meets the constraints: {listed}. Leave some of them open."
        )
    return v


def dependent(model: Any, q: np.ndarray, params: Any) -> tuple[str, ...]:
    """The names of constraints whose rows of [W; ∂g/∂q] at q depend on those before them."""
    if not model.constraints:
        return ()
    found, basis = [], np.zeros((0, q.size))
    for name, row in zip(model.constraints, np.asarray(evaluated(model.assembly.rows, q, params)), strict=True):
        rest = row - basis.T @ (basis @ row)
        rest -= basis.T @ (basis @ rest)
        if np.linalg.norm(rest) <= DEPENDENT * max(np.linalg.norm(row), 1e-300):
            found.append(name)
        else:
            basis = np.vstack([basis, rest / np.linalg.norm(rest)])
    return tuple(found)
