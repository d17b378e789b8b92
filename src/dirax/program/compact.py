"""compact(): a function for JAX in which derivatives of many operations are scalar programs, level by level.

To XLA a derivative in a jaxpr is JAX's own: of a machine of a few bodies, whose functions have hundreds of operations on small
arrays, derivatives in one another have tens of thousands, which take minutes to compile.
"""

from collections.abc import Callable
from typing import Any

import jax
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun, jaxprs_in_params

from dirax.program.same_jaxpr import shared
from dirax.program.scalar_program import program_p

DERIVATIVES = ("dirax_derivative", "dirax_directional", "dirax_pullback")
"""The primitives of derivatives that tracing leaves to the graph."""

INSIDE = ("jit", "pjit", "closed_call", "dirax_root")
"""Primitives whose jaxprs are looked into."""

MOST_OPERATIONS = 150
"""Operations on arrays of a function up to which its derivatives are left to JAX."""


def compact(function: Callable) -> Callable:
    """The function of pytrees, its derivatives of more than MOST_OPERATIONS as scalar programs where they have one."""

    def compacted(*arguments: Any) -> Any:
        leaves, structure = jax.tree.flatten(arguments)
        moves = [isinstance(leaf, jax.Array | Tracer) for leaf in leaves]

        def of_arrays(*arrays: Any) -> Any:
            rest = iter(arrays)
            given = [next(rest) if m else leaf for leaf, m in zip(leaves, moves, strict=True)]
            return function(*jax.tree.unflatten(structure, given))

        arrays = [leaf for leaf, m in zip(leaves, moves, strict=True) if m]
        closed, result = jax.make_jaxpr(of_arrays, return_shape=True)(*arrays)
        found = jaxpr_as_fun(_rewritten(closed, {}))(*arrays)
        return jax.tree.unflatten(jax.tree.structure(result), found)

    return compacted


def _rewritten(closed: ClosedJaxpr, known: dict[int, ClosedJaxpr]) -> ClosedJaxpr:
    if id(closed) not in known:
        jaxpr = closed.jaxpr
        known[id(closed)] = closed.replace(jaxpr=jaxpr.replace(eqns=[_equation(e, known) for e in jaxpr.eqns]))
    return known[id(closed)]


def _equation(e: Any, known: dict[int, ClosedJaxpr]) -> Any:
    if e.primitive.name in DERIVATIVES and operations(e.params["jaxpr"].jaxpr) > MOST_OPERATIONS:
        alone = jax.make_jaxpr(lambda *operands: e.primitive.bind(*operands, **e.params))(*(v.aval for v in e.invars))
        return e.replace(primitive=program_p, params={"jaxpr": shared(alone)})
    if e.primitive.name in INSIDE:
        inner = {k: _rewritten(j, known) for k, j in e.params.items() if isinstance(j, ClosedJaxpr)}
        return e.replace(params={**e.params, **inner})
    return e


def operations(jaxpr: Any) -> int:
    """How many operations on arrays a jaxpr has, those inside of them counted once for each time that they stand there."""
    known: dict[int, int] = {}

    def counted(jaxpr: Any) -> int:
        if id(jaxpr) not in known:
            inner = (counted(getattr(j, "jaxpr", j)) for e in jaxpr.eqns for j in jaxprs_in_params(e.params))
            known[id(jaxpr)] = len(jaxpr.eqns) + sum(inner)
        return known[id(jaxpr)]

    return counted(jaxpr)
