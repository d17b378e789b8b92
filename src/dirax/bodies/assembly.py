"""Initial data of a machine: given coordinates kept, the others found so that every joint and contact is met.

All of it is done in the units of the machine, of its lengths and of the terms of its constraints."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from dirax.bodies.machine_units import coordinate_units
from dirax.numerics.equilibration import power_of_two
from dirax.numerics.tolerances import TINY
from dirax.program.rounding import rounding
from dirax.program.tracing import jacobian
from dirax.program.user_functions import evaluated

MET = 1e-11
"""Residual of a constraint, relative to its terms in the units of the machine, that counts as met."""

DEPENDENT = 1e-9
"""Part of a row across the rows before it, relative to the row, below which it depends on them."""

ASIDE = (0.1, 0.3, 1.0)
"""How far from a start at which a machine is not assembled others are tried, in every coordinate (rad, machine lengths)."""

PART = 0.5
"""How far given coordinates are moved at a time from rest to where they are (rad, machine lengths)."""

MOST_STEPS = 200
RANK = 1e-10


class Assembly:
    """The functions that the search for initial data evaluates, each traced once for a model."""

    def __init__(self, constraints: Any, demands: Any):
        self.constraints, self.demands = constraints, demands

    def position(self, q: Any, params: Any) -> tuple[Any, Any, Any]:
        """g, ∂g/∂q, and the sizes of the terms of g."""
        g = lambda q: self.constraints.position_defect(0.0, q, params)
        return g(q), jacobian(g)(q), rounding(g, q)

    def turned_over(self, q: Any, params: Any) -> Any:
        """Of the joints that may be, in a tuple."""
        return (self.demands.turned_over(q, params),)

    def rows(self, q: Any, params: Any) -> Any:
        """[W; ∂g/∂q]."""
        return self.constraints.matrix(0.0, q, params)


def assembled(model: Any, q: Any, v: Any, params: Any) -> dict[str, np.ndarray]:
    """The initial data {"q", "v"} of `Model.state`."""
    start, fixed = _given(model, q, "q", _rest(model))
    system, units = model.system, coordinate_units(model, params)
    place = start
    if system.holonomic is not None:
        place = _assembled_place(model, start, fixed, units, params)
    speed, kept = _given(model, v, "v", np.zeros(len(start)))
    if system.constraints.any:
        speed = _moving(model, place, speed, kept, units, params)
    return {"q": place, "v": speed}


def _assembled_place(model: Any, start: np.ndarray, fixed: np.ndarray, units: np.ndarray, params: Any) -> np.ndarray:
    """Where the machine is assembled: from the start, and where that is a dead centre, at which no joint knows which way to give,
    or leads to a body that is turned over, from places beside it."""
    free, names, rng = units * ~fixed, model.demands.may_turn_over, np.random.default_rng(0)
    positions, over = (_numbers(f, params) for f in (model.assembly.position, model.assembly.turned_over))
    is_over = lambda q: over(q)[0] > 1.0 if names else np.zeros(0, bool)
    beside = lambda size: start + size * rng.uniform(-1, 1, len(start)) * free
    place, turned = _solved(positions, start, free), None
    tries = [lambda: place, lambda: _in_parts(positions, _rest(model), start, free, units)]
    for found in (*tries, *(lambda size=size: _solved(positions, beside(size), free) for size in ASIDE)):
        if not _unmet(model, positions(other := found()), units):
            if not np.any(is_over(other)):
                return other
            turned = other if turned is None else turned
    missed = _unmet(model, positions(place), units)
    listed = ", ".join(f"{name} by {value:.3g}" for name, value in missed)
    if turned is not None:
        which = [name for name, one in zip(names, is_over(turned), strict=True) if one]
        listed = f"{', '.join(which)} met with the body turned over, by half a turn, alone"
    kept = [name for name, given in zip(model.coordinates, fixed, strict=True) if given]
    way = f"Leave some of the given coordinates ({', '.join(kept)}) open" if kept else "Change the lengths of the bodies"
    raise ValueError(f"the machine cannot be assembled near these data: {listed}. {way}, or start from others.")


def _numbers(function: Callable, params: Any) -> Callable:
    """q ↦ the arrays of `function(q, params)`."""
    return lambda q: tuple(map(np.asarray, evaluated(function, q, params)))


def _in_parts(positions: Callable, rest: np.ndarray, start: np.ndarray, free: np.ndarray, units: np.ndarray) -> np.ndarray:
    """The place to which the machine comes when the given coordinates are moved to where they are little by little."""
    moved = np.where(free == 0, start - rest, 0.0)
    count, place = np.ceil(np.max(np.abs(moved) / units, initial=0.0) / PART), rest
    for part in np.linspace(0.0, 1.0, int(min(count, MOST_STEPS)) + 1)[1:]:
        place = _solved(positions, np.where(free == 0, rest + part * moved, place), free)
    return place


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
        for joint, motion, place in model.unit_vectors if name == "q" else ():
            if not np.any(array[place]):
                raise ValueError(
                    f"the {motion.norm} of joint {joint.name!r} is that of zeros, which have no direction: {array[place]}."
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


def _solved(positions: Callable, start: np.ndarray, free: np.ndarray) -> np.ndarray:
    """The point nearest to `start` where the constraints vanish, as far as it can be found: Gauss–Newton steps of least length
    in the free coordinates, halved while they do not help; `free` are their units, and 0 of those that stay."""
    x = start.copy()
    value, slope, terms = positions(x)
    sizes = _sizes(slope, terms, free)
    rows = power_of_two(np.where(sizes > 0.0, sizes, sizes.max()))
    for _ in range(MOST_STEPS):
        size = np.linalg.norm(value / rows)
        if size == 0 or not np.isfinite(size):
            break
        step = free * np.linalg.lstsq(slope * free / rows[:, None], -value / rows, rcond=RANK)[0]
        fraction = 1.0
        while fraction > 1e-6:
            following = positions(x + fraction * step)
            if np.linalg.norm(following[0] / rows) < (1 - fraction / 4) * size:
                break
            fraction /= 2
        else:
            break
        x, (value, slope, _) = x + fraction * step, following
    return x


def _sizes(slope: np.ndarray, terms: np.ndarray, units: np.ndarray) -> np.ndarray:
    """How large constraints are: their terms, or what a coordinate of the size of the machine makes of them."""
    return np.maximum(terms, np.max(np.abs(slope) * units, axis=1))


def _unmet(model: Any, found: tuple[np.ndarray, np.ndarray, np.ndarray], units: np.ndarray) -> list[tuple[str, float]]:
    """The holonomic constraints that are not met, of g, ∂g/∂q and the terms of g, and by how much."""
    defect, slope, terms = found
    names, sizes = model.constraints[-len(defect) :], _sizes(slope, terms, units)
    return [(n, d) for n, d, size in zip(names, defect, sizes, strict=True) if not abs(d) <= MET * size]


def _moving(model: Any, q: np.ndarray, v: np.ndarray, kept: np.ndarray, units: np.ndarray, params: Any) -> np.ndarray:
    """The velocity on the constraints nearest to v, in these units, that leaves the given ones."""
    rows = np.asarray(evaluated(model.assembly.rows, q, params)) * units
    sizes = power_of_two(np.abs(rows).max(axis=1))
    w, rows = v / units, rows / sizes[:, None]
    fastest, defect = np.abs(w).max(), rows @ w
    for _ in range(3):  # once, and twice against roundoff
        w = w - ~kept * np.linalg.lstsq(rows * ~kept, defect, rcond=RANK)[0]
        fastest, defect = max(fastest, np.abs(w).max()), rows @ w
    v = w * units
    missed = [(n, d * s) for n, d, s in zip(model.constraints, defect, sizes, strict=True) if not abs(d) <= MET * fastest]
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
    rows = np.asarray(evaluated(model.assembly.rows, q, params)) * coordinate_units(model, params)
    for name, row in zip(model.constraints, rows, strict=True):
        rest = row - basis.T @ (basis @ row)
        rest -= basis.T @ (basis @ rest)
        if np.linalg.norm(rest) <= DEPENDENT * max(np.linalg.norm(row), TINY):
            found.append(name)
        else:
            basis = np.vstack([basis, rest / np.linalg.norm(rest)])
    return tuple(found)
