"""What there is in a jaxpr, and in those inside of it."""

from collections.abc import Callable
from typing import Any

from jax.extend.core import jaxprs_in_params

DERIVATIVES = ("dirax_derivative", "dirax_directional", "dirax_pullback")


def nesting(jaxpr: Any) -> int:
    """How deep derivatives that tracing left to the graph lie in one another."""
    known: dict[int, int] = {}

    def depth(jaxpr: Any) -> int:
        if id(jaxpr) not in known:
            inner = [(e.primitive.name in DERIVATIVES, j) for e in jaxpr.eqns for j in jaxprs_in_params(e.params)]
            known[id(jaxpr)] = max((derives + depth(getattr(j, "jaxpr", j)) for derives, j in inner), default=0)
        return known[id(jaxpr)]

    return depth(jaxpr)


def array_operations(jaxpr: Any, of_derivative: float = 1.0, is_one: Callable[[str], bool] | None = None) -> float:
    """How many operations on arrays a jaxpr has, those inside of them counted once for each time that they stand there, and for
    each derivative that they are under so many times; of those alone whose names `is_one` says, where it is given."""
    known: dict[int, float] = {}

    def counted(jaxpr: Any) -> float:
        if id(jaxpr) not in known:
            more = lambda e: of_derivative if e.primitive.name in DERIVATIVES else 1.0
            inner = (more(e) * counted(getattr(j, "jaxpr", j)) for e in jaxpr.eqns for j in jaxprs_in_params(e.params))
            own = len(jaxpr.eqns) if is_one is None else sum(is_one(e.primitive.name) for e in jaxpr.eqns)
            known[id(jaxpr)] = own + sum(inner)
        return known[id(jaxpr)]

    return counted(jaxpr)
