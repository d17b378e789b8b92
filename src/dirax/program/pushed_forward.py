"""The tangent of a jaxpr as another jaxpr, in which derivatives stay one equation each, so that a graph of scalars finds them.

JAX itself would take derivatives of derivatives apart into operations on arrays, which gives many times as many scalars.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal, jaxpr_as_fun

from dirax.program.roots import least_change, root_p
from dirax.program.same_jaxpr import shared
from dirax.program.tracing import CALLS, all_plain, alone, directional_p, jacobian, of_one_result

Moved = list[tuple[Any, Any]]
"""Values, each with its tangent, None where it stands still."""


def pushed_forward(jaxpr: ClosedJaxpr, moves: tuple[bool, ...]) -> ClosedJaxpr:
    """The jaxpr of (operands, directions of those that move) ↦ the tangents of the results, all of them floats."""
    shapes = [jax.ShapeDtypeStruct(a.shape, a.dtype) for a in jaxpr.in_avals]

    def tangents(*values: Any) -> list:
        rest = iter(values[len(moves) :])
        given = [(x, next(rest) if moved else None) for x, moved in zip(values, moves, strict=False)]
        return [jnp.zeros_like(x) if along is None else along for x, along in _of_jaxpr(jaxpr, given)]

    return jax.make_jaxpr(tangents)(*shapes, *(shape for shape, moved in zip(shapes, moves, strict=True) if moved))


def _of_jaxpr(closed: ClosedJaxpr, given: Moved) -> Moved:
    if all(along is None for _, along in given):
        return [(x, None) for x in jaxpr_as_fun(closed)(*(x for x, _ in given))]
    if _is_derived(closed):
        return _along(closed, given)
    known = {v: (x, None) for v, x in zip(closed.jaxpr.constvars, closed.consts, strict=True)}
    known.update(zip(closed.jaxpr.invars, given, strict=True))
    read = lambda atom: (atom.val, None) if isinstance(atom, Literal) else known[atom]
    for equation in closed.jaxpr.eqns:
        if equation.primitive is root_p and not equation.params["axes"]:
            results = _of_root(equation, [read(atom) for atom in equation.invars])
        elif equation.primitive.name in CALLS:
            results = _of_jaxpr(equation.params["jaxpr"], [read(atom) for atom in equation.invars])
        else:
            one, variables = alone(closed.jaxpr, equation)
            results = _of_equation(one, [read(v) for v in variables])
        known.update(zip(equation.outvars, results, strict=True))
    return [read(atom) for atom in closed.jaxpr.outvars]


def _is_derived(closed: ClosedJaxpr) -> bool:
    """Whether the graph derives one array of floats from floats as JAX does."""
    avals = [*closed.in_avals, *closed.out_avals]
    return len(closed.out_avals) == 1 and all(a.dtype == np.float64 for a in avals) and all_plain(closed.jaxpr)


def _along(closed: ClosedJaxpr, given: Moved) -> Moved:
    """The directional derivative as one equation, of the operands that move after those that do not."""
    order = sorted(range(len(given)), key=lambda k: given[k][1] is not None)
    jaxpr = closed.jaxpr.replace(invars=[closed.jaxpr.invars[k] for k in order])
    along = [given[k][1] for k in order if given[k][1] is not None]
    operands = *(given[k][0] for k in order), *along
    (value,) = jaxpr_as_fun(closed)(*(x for x, _ in given))
    return [(value, directional_p.bind(*operands, jaxpr=shared(ClosedJaxpr(jaxpr, closed.consts)), count=len(along))[0])]


def _of_equation(one: ClosedJaxpr, given: Moved) -> Moved:
    moving = [k for k, (_, along) in enumerate(given) if along is not None]
    if not moving or (one.eqns[0].primitive.name.startswith("dirax_") and _is_derived(one)):
        return _of_jaxpr(one, given) if moving else [(x, None) for x in jaxpr_as_fun(one)(*(x for x, _ in given))]

    def of_moving(*values: Any) -> list:
        point = [x for x, _ in given]
        for k, value in zip(moving, values, strict=True):
            point[k] = value
        return jaxpr_as_fun(one)(*point)

    values, tangents = jax.jvp(of_moving, tuple(given[k][0] for k in moving), tuple(given[k][1] for k in moving))
    return [(x, t if t.dtype == x.dtype else None) for x, t in zip(values, tangents, strict=True)]


def _of_root(equation: Any, given: Moved) -> Moved:
    """The implicit function theorem, as in `dirax.program.roots`."""
    residual, values = equation.params["residual"], [x for x, _ in given]
    (u,) = root_p.bind(*values, **equation.params)
    ((_, right),) = _of_jaxpr(residual, [*given[:-1], (u, None)])
    if right is None:
        return [(u, None)]
    slope = jacobian(lambda u: of_one_result(residual)(*values[:-1], u))(u)
    return [(u, -least_change(slope, right))]
