"""Left-invariant systems on a Lie group, reduced by the whole group to its Lie algebra."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.geometry.lie_group import AbstractLieGroup
from dirax.numerics.tolerances import SYMMETRY_DEFECT
from dirax.program.rounding import rounding
from dirax.program.user_functions import UserFunction, evaluated
from dirax.reduction.euler_poincare import EulerPoincare
from dirax.reduction.symmetry import off_span
from dirax.systems.lagrange_dirac import LagrangeDirac
from dirax.systems.manifold_lagrangian import ManifoldLagrangian

SAMPLES = 16
"""Random elements of the group, with velocities, at which invariance is looked at."""


def reduced_by_left_translations(system: Any, group: AbstractLieGroup, params: Any = None) -> EulerPoincare:
    """The Euler–Poincaré system of `dx.reduce(system, group)`."""
    _refuse_other_systems(system, group)
    lagrangian, one_forms = system.lagrangian, getattr(system, "one_forms", None)
    for function in (lagrangian, one_forms):
        if function is not None and function.takes_params and params is None:
            raise TypeError(
                f"{function.signature} takes params, with which its invariance is checked: dx.reduce(system, group, params=…)."
            )
    _refuse_other_coordinates(system, group, params)
    _refuse_asymmetry(system, group, params)
    identity = group.identity()

    def reduced(xi, params):
        """l(ξ) = L(e, ξ)."""
        return lagrangian(identity, group.left_translate(identity, xi), params)

    forms = None if one_forms is None else lambda params: _on_the_algebra(one_forms, group, identity, params)
    return EulerPoincare(group, reduced, forms)


def _on_the_algebra(one_forms: UserFunction, group: AbstractLieGroup, g, params):
    """The matrix (m, d) of ξ ↦ W(g) g ξ."""
    return one_forms(g, params) @ jax.jacfwd(lambda xi: group.left_translate(g, xi))(jnp.zeros(group.dimension))


def _refuse_other_systems(system: Any, group: AbstractLieGroup) -> None:
    name = type(group).__name__
    if isinstance(system, ManifoldLagrangian):
        if type(system.manifold) is not type(group):
            raise ValueError(f"the Lagrangian is one on {system.manifold}, and dx.reduce by {name} takes one on {name} itself.")
    elif not isinstance(system, LagrangeDirac):
        raise TypeError(
            f"dx.reduce by {name} takes a dx.ManifoldLagrangian on {name}, or a dx.LagrangeDirac in the coordinates of its "
            f"elements, but a {type(system).__name__} was given."
        )
    more = {"forces": system.forces, "affine": system.affine}
    if isinstance(system, ManifoldLagrangian):
        more["holonomic constraints"] = system.holonomic
    given = [n for n, function in more.items() if function is not None] + ["explicit time"] * system.depends_on_time
    if given:
        raise ValueError(
            f"dx.EulerPoincare has a Lagrangian and one-forms, but the system has {' and '.join(given)}: leave them out, or step "
            "it unreduced."
        )


def _refuse_other_coordinates(system: Any, group: AbstractLieGroup, params: Any) -> None:
    """Raise `ValueError` where the functions are not ones of the coordinates of an element."""
    name, q = type(group).__name__, group.identity()
    about = f"the coordinates of the system must be those of an element of {name}, {group.element}"
    try:
        system.lagrangian.shape(q, q, params)
        forms = getattr(system, "one_forms", None)
        columns = q.size if forms is None else forms.shape(q, params).shape[-1]
    except (TypeError, ValueError) as error:
        raise ValueError(f"{about}: {error}") from error
    if columns != q.size:
        raise ValueError(f"{about}, {q.size} numbers, but the one_forms have {columns} columns.")


def _nonzero(size: Any) -> Any:
    return jnp.where(size > 0.0, size, 1.0)


def _refuse_asymmetry(system: Any, group: AbstractLieGroup, params: Any) -> None:
    """Raise `ValueError` where L, or the span of the one-forms, at (g, gξ) is another than at (e, ξ), and where holonomic
    constraints are not those of the group."""
    name, random, identity = type(group).__name__, np.random.default_rng(0), group.identity()
    turn, xi = random.normal(size=(2, SAMPLES, group.dimension))
    one_forms, holonomic = getattr(system, "one_forms", None), getattr(system, "holonomic", None)

    def at(turn, xi, params):
        g = group.group_exp(turn)
        here, there = (system.lagrangian(h, group.left_translate(h, xi), params) for h in (identity, g))
        terms = lambda function, *values: rounding(lambda *values: jnp.reshape(function(*values), (-1,)), *values)
        relative = lambda defect, sizes: (jnp.max(jnp.abs(defect)) / _nonzero(jnp.max(sizes)))[None]
        sizes = terms(lambda h, v: system.lagrangian(h, v, params), g, group.left_translate(g, xi))
        defects = [relative(there - here, sizes)]
        if one_forms is not None:
            fixed, moved = (_on_the_algebra(one_forms, group, h, params) for h in (identity, g))
            defects.append(relative(off_span(moved, fixed), jnp.abs(moved)))
        if holonomic is not None:
            defects.append(relative(holonomic(g, params), terms(lambda g, holonomic=holonomic: holonomic(g, params), g)))
        return jnp.concatenate([there[None] - here[None], *defects]), g

    values, g = (np.asarray(a) for a in evaluated(jax.vmap(at, in_axes=(0, 0, None)), turn, xi, params))
    names = ["lagrangian", *["one_forms"] * (one_forms is not None), *["holonomic"] * (holonomic is not None)]
    for column, of in enumerate(names, start=1):
        row = int(np.argmax(np.where(np.isfinite(values[:, column]), values[:, column], 0.0)))
        if not values[row, column] > SYMMETRY_DEFECT:
            continue
        where = f"at g = {g[row]}"
        if of == "lagrangian":
            raise ValueError(
                f"the lagrangian is not left-invariant on {name}, whose elements are {group.element}: L(g, gξ) − L(e, ξ) = "
                f"{values[row, 0]:.3g} {where}, ξ = {xi[row]}. A direction or a point in space that L singles out is an advected "
                f"quantity a: write dx.EulerPoincare({name.lower()}, l(xi, a), advected=…), or leave the term out."
            )
        if of == "one_forms":
            raise ValueError(
                f"the one_forms are not left-invariant on {name}: seen from the body they move out of their span by "
                f"{values[row, column]:.3g} {where}. Constraints fixed in space are given to dx.EulerPoincare as "
                "one_forms(a) of advected quantities a."
            )
        raise ValueError(
            f"the holonomic constraints are not those of {name}: they are {values[row, column]:.3g} {where}, an element of it. "
            "Leave them out, or name the smaller group."
        )
