"""Whether a system is invariant under an action, and the search for symmetries that are translations."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dirax.numerics.ranks import numerical_rank
from dirax.numerics.tolerances import SYMMETRY_DEFECT, TINY
from dirax.program.evaluation.functions import in_numpy
from dirax.program.memo import Same
from dirax.program.user_functions import UserFunction
from dirax.reduction.actions import AbstractAction
from dirax.reduction.sample_units import SampleUnits, sample_units
from dirax.systems.constraints import Constraints
from dirax.systems.system import AbstractSystem


@dataclass(frozen=True)
class Invariance:
    """Whether a system is invariant, and where it is least so; prints as a sentence.

    `of`: "lagrangian", "one_forms", "holonomic", "forces" or "discrete_lagrangian", whichever is worst; `defect`: the
    derivative of it along the orbit of `generator` (index of a basis vector ξ) at (q, v), or (q0, q1) for L_d; `relative`:
    the defect over the size of the function and its derivatives there.
    """

    ok: bool
    of: str
    generator: int
    defect: float
    relative: float
    q: np.ndarray
    v: np.ndarray

    def __bool__(self) -> bool:
        return self.ok

    def __str__(self) -> str:
        if self.ok:
            return f"invariant: the largest relative defect is {self.relative:.1e} (tolerance {SYMMETRY_DEFECT:.0e})."
        second = "q1" if self.of == "discrete_lagrangian" else "v"
        return (
            f"not invariant: the {self.of} changes along generator {self.generator} at the rate {self.defect:.3g} "
            f"at q = {self.q}, {second} = {self.v}."
        )


def check_invariance(
    system: Any,
    action: AbstractAction,
    *,
    q: Any,
    v: Any = None,
    params: Any = None,
    discrete_lagrangian: Callable | None = None,
    step: float | None = None,
    samples: int = 32,
    radius: float = 1.0,
    t: float = 0.0,
) -> Invariance:
    """Whether L, the constraints and the forces of a Lagrangian system, or with `discrete_lagrangian(q0, q1, h[,
    params])` and `step` that function, are invariant under an action; and where not.

    Looked at: `q` (n,) with `v` (n,) at the time `t`, and `samples` random points within `radius` of them at later times, in
    units that the numbers of L at (q, v) say (1 where lengths, masses and times are near 1); the group being connected, the
    derivative along its generators decides. Points where L is not finite are left out. Raises `ValueError` for an action that is
    none, or does not fit q.
    """
    if not isinstance(action, AbstractAction):
        raise TypeError(f"action must be one such as dx.Translations([0]) or dx.GroupAction(…), but {action!r} was given.")
    given = v is not None
    q, v = checked_state(q, v if given else np.zeros_like)
    action.check(jnp.asarray(q))
    if discrete_lagrangian is None:
        check_lagrangian(system, q, v, params)
        units = units_of(system, q, v, params, t)
        near = sampled_near(q, v if given else units.v, units, radius, samples, t)
        return invariance(system, action, *near, params, units)
    if step is None:
        raise ValueError("discrete_lagrangian needs step=, the h that it is called with.")
    ld = UserFunction(discrete_lagrangian, "discrete_lagrangian", ("q0", "q1", "h"), timed=True)
    value = lambda t, q, v, params: ld(*ld.given(t, q, q + step * v, step, params))
    units, functions = sample_units(value, None, t, q, v, params), {"discrete_lagrangian": ld}
    when, points, rates = sampled_near(q, v if given else units.v, units, radius, samples, t)
    return discrete_invariance(functions, action, when, points, points + step * rates, step, params, units)


def units_of(system: Any, q: np.ndarray, v: np.ndarray, params: Any, t: Any = 0.0) -> SampleUnits:
    """The units at a point and a time of a system with a Lagrangian in coordinates; 1 for any other."""
    form: Any = with_lagrangian(system)
    if getattr(form, "lagrangian_form", lambda: None)() is not form:
        return SampleUnits.plain(q.size)
    return sample_units(form.lagrangian.at, form.constraints, t, q, v, params)


Samples: TypeAlias = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Times (1 + samples,), points and velocities, (1 + samples, n) each."""


def sampled_near(q: np.ndarray, v: np.ndarray, units: SampleUnits, radius: float, samples: int, t: Any = 0.0) -> Samples:
    """(q, v) at the time t, and random points and velocities within `radius` of them at later times, in these units."""
    random = np.random.default_rng(0)
    away = lambda unit: np.concatenate([np.zeros((1, q.size)), radius * unit * random.uniform(-1, 1, (samples, q.size))])
    return t + units.time * times(1 + samples), q + away(units.q), v + away(units.v)


def times(count: int) -> np.ndarray:
    """How long after the first time functions are looked at: 0, and random ones up to 1."""
    return np.random.default_rng(1).uniform(0, 1, count) * (np.arange(count) > 0)


def checked_state(q: Any, v: Any) -> tuple[np.ndarray, np.ndarray]:
    """q and v as arrays of one length, v also a function of q; raises `ValueError` for other shapes."""
    q = np.asarray(q, dtype=float)
    v = v(q) if callable(v) else np.asarray(v, dtype=float)
    if q.ndim != 1 or not q.size or v.shape != q.shape:
        raise ValueError(f"q and v must be one point and velocity of shape (n,), but their shapes are {q.shape} and {v.shape}.")
    return q, v


def with_lagrangian(system: Any) -> Any:
    """The system as one with a Lagrangian L(q, v), in coordinates or on a manifold; itself where it has none."""
    if not isinstance(system, AbstractSystem):
        return system
    forms = (system.lagrangian_form(), system.manifold_form())
    return next((form for form in forms if form is not None), system)


def check_lagrangian(system: Any, q: np.ndarray, v: np.ndarray, params: Any) -> None:
    """Raise `TypeError` for a system without a Lagrangian L(q, v) that takes such q and v."""
    lagrangian = getattr(with_lagrangian(system), "lagrangian", None)
    if not isinstance(lagrangian, UserFunction) or lagrangian.arguments[-2:] != ("q", "v"):
        raise TypeError(
            "system must be one with a Lagrangian L(q, v), such as a dx.LagrangeDirac, but one of type "
            f"{type(system).__name__} was given."
        )
    lagrangian.shape(*lagrangian.given(jnp.zeros(()), jnp.asarray(q), jnp.asarray(v), params))


def discrete_invariance(
    functions: dict[str, UserFunction],
    action: AbstractAction,
    t: Any,
    q0: Any,
    q1: Any,
    h: float,
    params: Any,
    units: SampleUnits | None = None,
) -> Invariance:
    """Whether functions of ([t, ]q0, q1, h[, params]) by name are invariant, at given t, q0 and q1 (samples, …)."""

    def moving(function):
        return lambda g, t, q0, q1: function(*function.given(t, action(g, q0), action(g, q1), h, params))

    units = units or SampleUnits.plain(q0.shape[-1])
    return _worst({name: moving(function) for name, function in functions.items()}, action, t, q0, q1, units)


def invariance(
    system: Any, action: AbstractAction, t: Any, q: Any, v: Any, params: Any, units: SampleUnits | None = None
) -> Invariance:
    """`check_invariance` at given times (samples,), points q and velocities v, (samples, n), with derivatives compared in these
    `units`, 1 where they are not given."""
    system, units = with_lagrangian(system), units or SampleUnits.plain(q.shape[-1])
    constraints: Any = getattr(system, "constraints", None)

    def pulled_back(g, t, q, v):
        """Φ_g q, TΦ_g v and DΦ_g."""
        derivative = jax.jacfwd(lambda q: action(g, q))(q)
        return action(g, q), derivative @ v, derivative

    def lagrangian(g, t, q, v):
        there, rate, _ = pulled_back(g, t, q, v)
        return system.lagrangian.at(t, there, rate, params)

    def one_forms(g, t, q, v):
        """W(Φ_g q) TΦ_g, less its part in the span of W(q); with affine constraints [W b] likewise."""
        there, _, derivative = pulled_back(g, t, q, v)
        moved = affine_rows(constraints, t, there, params)
        moved = jnp.hstack([moved[:, : q.size] @ derivative, moved[:, q.size :]]) * columns(moved, units)
        if _sees_multipliers(system):
            return moved
        fixed = affine_rows(constraints, t, q, params) * columns(moved, units)
        largest = jnp.max(jnp.abs(fixed), axis=1, keepdims=True)  # the unit of each
        largest = jnp.where(largest > 0.0, largest, 1.0)
        return off_span(moved / largest, fixed / largest)

    def holonomic(g, t, q, v):
        return constraints.position_defect(t, action(g, q), params)

    def forces(g, t, q, v):
        there, rate, derivative = pulled_back(g, t, q, v)
        return forces_at(system, t, there, rate, params) @ derivative

    functions = {"lagrangian": lagrangian}
    for moved in (one_forms, holonomic, forces):
        if getattr(system, moved.__name__, None) is not None:
            functions[moved.__name__] = moved
    return _worst(functions, action, t, q, v, units)


def columns(rows: Float[Array, "m r"], units: SampleUnits) -> Float[np.ndarray, "1 r"]:
    """The units of the columns of W, or of [W b]."""
    return (units.q if rows.shape[1] == units.q.size else np.append(units.q, units.time))[None]


def affine_rows(constraints: Constraints, t: Any, q: Float[Array, " n"], params: Any) -> Float[Array, "m r"]:
    """W(t, q), or [W b] of affine constraints."""
    w = constraints.one_forms_at(t, q, params)
    return w if constraints.affine is None else jnp.hstack([w, constraints.affine.at(t, q, params)[:, None]])


def off_span(moved: Float[Array, "m r"], fixed: Float[Array, "m r"]) -> Float[Array, "m r"]:
    """The rows `moved` less their parts in the span of the rows `fixed`."""
    return moved - moved @ jnp.linalg.pinv(fixed) @ fixed


def _sees_multipliers(system: Any) -> bool:
    """Whether the forces depend on the multipliers, and so on the one-forms themselves, not on their span alone."""
    return getattr(system, "forces_see_multipliers", False)


def forces_at(system: Any, t: Any, q: Float[Array, " n"], v: Float[Array, " n"], params: Any) -> Float[Array, "k n"]:
    """The forces, as one row; where they see the multipliers, one row for random ones and one for their opposites."""
    if not _sees_multipliers(system):
        force, manifold = system.forces(t, q, v, params), getattr(system, "manifold", None)
        return (force if manifold is None else manifold.projection(q, force))[None]
    random = np.random.default_rng(2).uniform(0.2, 1.0, sum(system.constraints.sizes(q, params)))
    return jnp.stack([system.forces_at(jnp.asarray(sign * random))(t, q, v, params) for sign in (1, -1)])


def _worst(functions: dict[str, Callable], action: AbstractAction, t: Any, q: Any, v: Any, units: SampleUnits) -> Invariance:
    """The largest change of the functions (g, t, q, v) at g = 0, relative to their sizes, to those of their derivatives, and to
    how far points are moved."""
    zero, worst = jnp.zeros(action.dimension()), None
    for name, moved in functions.items():

        def at(t, q, v, moved=moved, unit=units.q if name == "forces" else np.ones(1)):
            """The largest rate of change along each generator, that in units, the size in units, and how fast points move."""
            value = jnp.ravel(moved(zero, t, q, v))
            weights = jnp.tile(unit, value.size // unit.size)[:, None]
            rate = jnp.reshape(jax.jacfwd(moved)(zero, t, q, v), (value.size, zero.size))
            slope = jnp.reshape(jax.jacfwd(moved, argnums=2)(zero, t, q, v), (value.size, q.size)) * units.q[None]
            size = jnp.maximum(jnp.max(jnp.abs(weights[:, 0] * value)), jnp.max(jnp.abs(weights * slope)))
            speed = jnp.max(jnp.abs(jax.jacfwd(action)(zero, q)) / units.q[:, None], axis=0)
            return jnp.max(jnp.abs(rate), axis=0), jnp.max(jnp.abs(weights * rate), axis=0), size, speed

        samples = [np.asarray(a, float) for a in (t, q, v)]
        found = in_numpy(at, samples, Same(at), for_few=True)  # quicker than to compile it
        defect, scaled, size, speed = map(np.asarray, found or jax.jit(jax.vmap(at))(*samples))
        known = np.isfinite(scaled) & np.isfinite(size)[:, None]
        # one-forms less their span are 0 where they are looked at, and in their own units; the others have theirs
        there = size[np.isfinite(size) & (size > 0.0)]
        unit = np.median(there) if there.size else 1.0
        size = np.maximum(size, 1.0 if name == "one_forms" else unit)
        fastest = np.max(np.where(np.isfinite(speed), speed, 0.0), axis=0)
        scale = size[:, None] * np.where(fastest > 0.0, fastest, 1.0)
        relative = np.where(known, scaled / np.where(known, scale, 1.0), 0.0)
        row, column = np.unravel_index(int(np.argmax(relative)), relative.shape)
        largest = float(relative[row, column])
        if worst is None or largest > worst.relative:
            place = np.asarray(q)[row], np.asarray(v)[row]
            worst = Invariance(largest <= SYMMETRY_DEFECT, name, int(column), float(defect[row, column]), largest, *place)
    assert worst is not None
    return worst


def translation_symmetries(
    system: Any, q: Any, v: Any = None, params: Any = None, samples: int = 64, radius: float = 1.0, t: float = 0.0
) -> np.ndarray:
    """Directions d, the rows of a (k, n) matrix with orthonormal rows, in which neither L nor constraints nor forces change
    (of the one-forms, their span; forces that see the multipliers are those of fixed ones, and then the one-forms themselves).

    Found from ∂L/∂q at `samples` random points within `radius` of (q, v) at the time `t` and later, in units as those of
    `check_invariance`; `cyclic_coordinates` are those along the axes.
    """
    system = with_lagrangian(system)
    q, v = checked_state(q, np.zeros_like if v is None else v)
    check_lagrangian(system, q, v, params)
    units, random = units_of(system, q, v, params, t), np.random.default_rng(0)
    points = [c + radius * unit * random.uniform(-1, 1, (samples, q.size)) for c, unit in ((q, units.q), (v, units.v))]
    constraints = system.constraints

    def at(t, q, v):
        """The functions and their slopes, in units of the coordinates, side by side."""
        along = [lambda q: system.lagrangian.at(t, q, v, params)[None]]
        if system.one_forms is not None:
            rows = lambda q: affine_rows(constraints, t, q, params) * columns(affine_rows(constraints, t, q, params), units)
            fixed, moved = rows(q), rows
            if not _sees_multipliers(system):
                largest = jnp.max(jnp.abs(fixed), axis=1, keepdims=True)
                unit = jnp.where(largest > 0.0, largest, 1.0)
                fixed, moved = fixed / unit, lambda q: off_span(rows(q) / unit, fixed / unit)
            along.append(lambda q: jnp.concatenate([moved(q), jax.lax.stop_gradient(fixed)]))
        if system.holonomic is not None:
            along.append(lambda q: constraints.position_defect(t, q, params))
        if system.forces is not None:
            along.append(lambda q: forces_at(system, t, q, v, params) * units.q[None])
        values = [jnp.reshape(function(q), (-1, 1)) for function in along]
        slopes = [jnp.reshape(jax.jacfwd(function)(q), (-1, q.size)) * units.q[None] for function in along]
        return [jnp.hstack(pair) for pair in zip(values, slopes, strict=True)]

    points = [np.asarray(a, float) for a in (t + units.time * random.uniform(0, 1, samples), *points)]
    found = in_numpy(at, points, Same(at), for_few=True) or jax.jit(jax.vmap(at))(*points)
    tables = [np.asarray(table) for table in found]
    finite = np.all([np.all(np.isfinite(table), axis=(1, 2)) for table in tables], axis=0)
    if not np.any(finite):
        raise ValueError("L is finite at none of the points around q: choose q inside its domain, or a smaller radius.")
    sizes = [np.max(np.abs(table[finite]), initial=0.0) for table in tables]  # each function has its own unit
    slopes = [table[finite, :, 1:].reshape(-1, q.size) / (size or 1.0) for table, size in zip(tables, sizes, strict=True)]
    _, values, directions = np.linalg.svd(np.concatenate(slopes), full_matrices=True)
    rank = int(numerical_rank(values, SYMMETRY_DEFECT, least=1.0))
    return _orthonormal(directions[rank:] * units.q)


def _orthonormal(rows: np.ndarray) -> np.ndarray:
    """Orthonormal rows with the same span, of independent ones."""
    return np.linalg.qr((rows / np.max(np.abs(rows), axis=1, keepdims=True, initial=TINY)).T)[0].T


def cyclic_coordinates(system: Any, q: Any, v: Any = None, params: Any = None, **sampling: Any) -> tuple[int, ...]:
    """The indices of the coordinates that neither L nor constraints nor forces depend on: what `fibre` may hold.

    dx.reduce(system, dx.LinearConnection(dx.cyclic_coordinates(system, q, params=params)))
    """
    free = translation_symmetries(system, q, v, params, **sampling)
    return tuple(int(i) for i in np.flatnonzero(np.sum(free**2, axis=0) > 1 - 1e-9))
