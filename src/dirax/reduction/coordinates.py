"""Other coordinates for a system, in which a symmetry is a translation."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from dirax.numerics.ranks import numerical_rank
from dirax.numerics.tolerances import ONE_FORM_RANK
from dirax.program.user_functions import UserFunction
from dirax.systems.lagrange_dirac import LagrangeDirac
from dirax.systems.manifold_lagrangian import ManifoldLagrangian


def in_coordinates(system: LagrangeDirac | ManifoldLagrangian, coordinates: Callable) -> LagrangeDirac:
    """The same system in coordinates y: `coordinates(y[, params])` is the point q of y, both of shape (n,).

    L(q(y), Dq ẏ), and constraints and forces pulled back. Schemes commute with changes that are linear in y; other changes
    give other discrete equations of the same continuous ones. Of a `dx.ManifoldLagrangian` y are as many coordinates of its
    manifold as it has dimensions: of a torus, or where a torus acts, its angles are coordinates of a retraction-compatible
    chart, in which the action is addition and the discrete equations are those of the manifold ([RL] §6).

        polar = dx.in_coordinates(kepler, lambda y: y[0] * jnp.array([jnp.cos(y[1]), jnp.sin(y[1])]))
        dx.reduce(polar, dx.LinearConnection(fibre=[1]))

    Raises `TypeError` for another kind of system, or a function of other arguments.
    """
    point = UserFunction(coordinates, "coordinates", ("y",))
    if not isinstance(system, LagrangeDirac | ManifoldLagrangian):
        raise TypeError(
            f"in_coordinates takes a dx.LagrangeDirac or a dx.ManifoldLagrangian system, but a {type(system).__name__} was given."
        )
    constraints = system.constraints

    def moved(y, v, params):
        return jax.jvp(lambda y: point(y, params), (y,), (v,))

    def pulled_back(covectors, y, params):
        return covectors @ jax.jacfwd(lambda y: point(y, params))(y)

    def at_all_times(t, name, y, params):
        return getattr(system, name).at(t, point(y, params), params)

    functions: dict[str, tuple[Callable, Callable]] = {  # with and without the time
        "lagrangian": (
            lambda t, y, v, params: system.lagrangian.at(t, *moved(y, v, params), params),
            lambda y, v, params: system.lagrangian(*moved(y, v, params), params),
        ),
        "one_forms": (
            lambda t, y, params: pulled_back(at_all_times(t, "one_forms", y, params), y, params),
            lambda y, params: pulled_back(at_all_times(0.0, "one_forms", y, params), y, params),
        ),
        "affine": (
            lambda t, y, params: at_all_times(t, "affine", y, params),
            lambda y, params: at_all_times(0.0, "affine", y, params),
        ),
        "holonomic": (
            lambda t, y, params: constraints.position_defect(t, point(y, params), params),
            lambda y, params: constraints.position_defect(0.0, point(y, params), params),
        ),
    }
    given: dict[str, Any] = {}
    for name, (timed, timeless) in functions.items():
        own = getattr(system, name, None)
        if own is not None:
            given[name] = timed if own.takes_time else timeless
    forces = system.forces
    if forces is not None:
        given["forces"] = lambda t, y, v, params: pulled_back(forces(t, *moved(y, v, params), params), y, params)
    return LagrangeDirac(**given)


def adapted_basis(directions: Any) -> np.ndarray:
    """A matrix T (n, n) with q = T y whose last k columns are the given directions (k, n), and whose first ones are an
    orthonormal basis of their complement: translations along the directions are translations of the last k entries of y.

        T = dx.adapted_basis(dx.translation_symmetries(system, q))
        adapted = dx.in_coordinates(system, lambda y: T @ y)
        reduced = dx.reduce(adapted, dx.LinearConnection(range(n - k, n)))      # starts from y = T⁻¹ q

    Raises `ValueError` for dependent directions.
    """
    rows = np.atleast_2d(np.asarray(directions, dtype=float))
    k, n = rows.shape
    _, values, basis = np.linalg.svd(rows, full_matrices=True)
    if k > n or numerical_rank(values, ONE_FORM_RANK) < k:
        raise ValueError(f"directions must hold independent rows, but their singular values are {values}.")
    return np.concatenate([basis[k:], rows]).T
