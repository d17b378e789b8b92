"""Whether a system is invariant under an action, and the search for symmetries that are translations."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dirax.numerics.ranks import numerical_rank
from dirax.numerics.tolerances import SYMMETRY_DEFECT
from dirax.program.evaluation.functions import in_numpy
from dirax.program.memo import Same
from dirax.program.user_functions import UserFunction
from dirax.reduction.actions import AbstractAction
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
) -> Invariance:
    """Whether L, the constraints and the forces of a Lagrangian system, or with `discrete_lagrangian(q0, q1, h[,
    params])` and `step` that function, are invariant under an action; and where not.

    Looked at: `q` (n,) with `v` (n,) at t = 0, and `samples` random points within `radius` of them at other times; the group
    being connected, the derivative along its generators decides. Points where L is not finite are left out. Raises
    `ValueError` for an action that is none, or does not fit q.
    """
    if not isinstance(action, AbstractAction):
        raise TypeError(f"action must be one such as dx.Translations([0]) or dx.GroupAction(…), but {action!r} was given.")
    q, v = checked_state(q, np.ones_like if v is None else v)
    action.check(jnp.asarray(q))
    if discrete_lagrangian is None:
        check_lagrangian(system, q, v, params)
    random = np.random.default_rng(0)
    near = lambda point: np.concatenate([point[None], point + radius * random.uniform(-1, 1, (samples, q.size))])
    if discrete_lagrangian is None:
        return invariance(system, action, times(1 + samples), near(q), near(v), params)
    if step is None:
        raise ValueError("discrete_lagrangian needs step=, the h that it is called with.")
    ld = UserFunction(discrete_lagrangian, "discrete_lagrangian", ("q0", "q1", "h"), timed=True)
    q0, v = near(q), near(v)
    return discrete_invariance({"discrete_lagrangian": ld}, action, times(1 + samples), q0, q0 + step * v, step, params)


def times(count: int) -> np.ndarray:
    """Times at which functions are looked at: 0, and random ones up to 1."""
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
    functions: dict[str, UserFunction], action: AbstractAction, t: Any, q0: Any, q1: Any, h: float, params: Any
) -> Invariance:
    """Whether functions of ([t, ]q0, q1, h[, params]) by name are invariant, at given t, q0 and q1 (samples, …)."""

    def moving(function):
        return lambda g, t, q0, q1: function(*function.given(t, action(g, q0), action(g, q1), h, params))

    return _worst({name: moving(function) for name, function in functions.items()}, action, t, q0, q1)


def invariance(system: Any, action: AbstractAction, t: Any, q: Any, v: Any, params: Any) -> Invariance:
    """`check_invariance` at given times (samples,), points q and velocities v, (samples, n)."""
    system = with_lagrangian(system)
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
        moved = jnp.hstack([moved[:, : q.size] @ derivative, moved[:, q.size :]])
        if _sees_multipliers(system):
            return moved
        fixed = affine_rows(constraints, t, q, params)
        largest = jnp.max(jnp.abs(fixed), axis=1, keepdims=True)  # the unit of each
        return off_span(moved, fixed) / jnp.where(largest > 0.0, largest, 1.0)

    def holonomic(g, t, q, v):
        return constraints.position_defect(t, action(g, q), params)

    def forces(g, t, q, v):
        there, rate, derivative = pulled_back(g, t, q, v)
        return forces_at(system, t, there, rate, params) @ derivative

    functions = {"lagrangian": lagrangian}
    for moved in (one_forms, holonomic, forces):
        if getattr(system, moved.__name__, None) is not None:
            functions[moved.__name__] = moved
    return _worst(functions, action, t, q, v)


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


def _worst(functions: dict[str, Callable], action: AbstractAction, t: Any, q: Any, v: Any) -> Invariance:
    """The largest change of the functions (g, t, q, v) at g = 0, relative to their sizes and those of their derivatives."""
    zero, worst = jnp.zeros(action.dimension()), None
    for name, moved in functions.items():

        def at(t, q, v, moved=moved):
            rate = jax.jacfwd(moved)(zero, t, q, v)
            value, slope = moved(zero, t, q, v), jax.jacfwd(moved, argnums=2)(zero, t, q, v)
            size = jnp.maximum(jnp.max(jnp.abs(value)), jnp.max(jnp.abs(slope)))
            return jnp.max(jnp.abs(jnp.reshape(rate, (-1, zero.shape[0]))), axis=0), size

        samples = [np.asarray(a, float) for a in (t, q, v)]
        found = in_numpy(at, samples, Same(at), for_few=True)  # quicker than to compile it
        defect, size = map(np.asarray, found or jax.jit(jax.vmap(at))(*samples))
        known = np.isfinite(defect) & np.isfinite(size)[:, None]
        # one-forms less their span are 0 where they are looked at, and in their own units; the others have theirs
        there = size[np.isfinite(size) & (size > 0.0)]
        unit = np.median(there) if there.size else 1.0
        size = np.maximum(size, 1.0 if name == "one_forms" else unit)
        relative = np.where(known, defect / np.where(known, size[:, None], 1.0), 0.0)
        row, column = np.unravel_index(int(np.argmax(relative)), relative.shape)
        largest = float(relative[row, column])
        if worst is None or largest > worst.relative:
            place = np.asarray(q)[row], np.asarray(v)[row]
            worst = Invariance(largest <= SYMMETRY_DEFECT, name, int(column), float(defect[row, column]), largest, *place)
    assert worst is not None
    return worst


def translation_symmetries(
    system: Any, q: Any, v: Any = None, params: Any = None, samples: int = 64, radius: float = 1.0
) -> np.ndarray:
    """Directions d, the rows of a (k, n) matrix with orthonormal rows, in which neither L nor constraints nor forces change
    (of the one-forms, their span; forces that see the multipliers are those of fixed ones, and then the one-forms themselves).

    Found from ∂L/∂q at `samples` random points within `radius` of (q, v); `cyclic_coordinates` are those along the axes.
    """
    system = with_lagrangian(system)
    q, v = checked_state(q, np.zeros_like if v is None else v)
    check_lagrangian(system, q, v, params)
    random = np.random.default_rng(0)
    points = [c + radius * random.uniform(-1, 1, (samples, q.size)) for c in (q, v)]

    constraints = system.constraints

    def at(t, q, v):
        along = [lambda q: system.lagrangian.at(t, q, v, params)]
        if system.one_forms is not None:
            fixed = affine_rows(constraints, t, q, params)
            rows = lambda q: affine_rows(constraints, t, q, params)
            along.append(rows if _sees_multipliers(system) else lambda q: off_span(rows(q), fixed))
        if system.holonomic is not None:
            along.append(lambda q: constraints.position_defect(t, q, params))
        if system.forces is not None:
            along.append(lambda q: forces_at(system, t, q, v, params))
        inside = jnp.full((1, q.size), along[0](q))  # not finite where L is not
        return jnp.concatenate([*(jnp.reshape(jax.jacfwd(function)(q), (-1, q.size)) for function in along), inside])

    points = [np.asarray(a, float) for a in (random.uniform(0, 1, samples), *points)]
    found = in_numpy(at, points, Same(at), for_few=True)
    slopes = np.asarray(jax.jit(jax.vmap(at))(*points) if found is None else found)
    slopes = slopes[np.all(np.isfinite(slopes), axis=(1, 2))]
    unit = np.max(np.abs(slopes[:, -1]), initial=0.0)  # the size of L at the points, of which its derivatives are part
    slopes = slopes[:, :-1].reshape(-1, q.size)
    if not len(slopes):
        raise ValueError("L is finite at none of the points around q: choose q inside its domain, or a smaller radius.")
    _, values, directions = np.linalg.svd(slopes, full_matrices=True)
    rank = int(numerical_rank(values, SYMMETRY_DEFECT, least=unit))
    return directions[rank:]


def cyclic_coordinates(system: Any, q: Any, v: Any = None, params: Any = None, **sampling: Any) -> tuple[int, ...]:
    """The indices of the coordinates that neither L nor constraints nor forces depend on: what `fibre` may hold.

    dx.reduce(system, dx.LinearConnection(dx.cyclic_coordinates(system, q, params=params)))
    """
    free = translation_symmetries(system, q, v, params, **sampling)
    return tuple(int(i) for i in np.flatnonzero(np.sum(free**2, axis=0) > 1 - 1e-9))
