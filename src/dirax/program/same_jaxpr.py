"""Jaxprs that say the same are one object, so that what is made of one is made once.

JAX traces a function anew wherever another function calls it, and each time makes another jaxpr of it: the Lagrangian in the
residual of a step, in the energy of a row and in the start of a run. What a scalar program makes of a jaxpr, its derivatives
above all, is kept by the jaxpr; so the first of those that are alike stands for all.
"""

from typing import Any

import numpy as np
from jax.core import ShapedArray, Tracer
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from dirax.program.memo import Memo, Same

KEPT = 2048
"""Jaxprs kept in memory, those of the functions that others call among them."""

_first: Memo[ClosedJaxpr] = Memo(KEPT)
_seen: Memo[ClosedJaxpr] = Memo(KEPT)


def shared(closed: ClosedJaxpr) -> ClosedJaxpr:
    """The first jaxpr that has the same equations and constants, as they were then; itself where they cannot be compared."""
    return _seen.get(Same(closed), lambda: _first.get(_said_by(closed), lambda: with_own_arrays(closed)))


def with_own_arrays(closed: ClosedJaxpr) -> ClosedJaxpr:
    """The jaxpr with copies of the arrays of NumPy that it holds, which are the user's and may be changed."""
    consts = [_own(c) for c in closed.consts]
    jaxpr = _with_own_arrays(closed.jaxpr)
    if jaxpr is closed.jaxpr and all(a is b for a, b in zip(consts, closed.consts, strict=True)):
        return closed
    return closed.replace(jaxpr=jaxpr, consts=consts)


def _with_own_arrays(jaxpr: Jaxpr) -> Jaxpr:
    """The same of equations that hold jaxprs."""
    equations = [_of_equation(e) for e in jaxpr.eqns]
    same = all(a is b for a, b in zip(equations, jaxpr.eqns, strict=True))
    return jaxpr if same else jaxpr.replace(eqns=equations)


def _of_equation(equation: Any) -> Any:
    params = {name: _own(value) for name, value in equation.params.items()}
    is_array = lambda atom: isinstance(atom, Literal) and isinstance(atom.val, np.ndarray)
    atoms = [Literal(a.val.copy(), a.aval) if is_array(a) else a for a in equation.invars]
    same = all(params[name] is value for name, value in equation.params.items())
    return equation if same and not any(map(is_array, atoms)) else equation.replace(params=params, invars=atoms)


def _own(value: Any) -> Any:
    """What is held by a jaxpr, with arrays of its own; itself where it has none."""
    if isinstance(value, np.ndarray):
        return value.copy()
    if isinstance(value, ClosedJaxpr):
        return with_own_arrays(value)
    if isinstance(value, Jaxpr):
        return _with_own_arrays(value)
    if type(value) in (tuple, list):
        parts = [_own(one) for one in value]
        return value if all(a is b for a, b in zip(parts, value, strict=True)) else type(value)(parts)
    return value


def _said_by(closed: ClosedJaxpr) -> Any:
    """Equal for jaxprs that say the same."""
    return _equations(closed.jaxpr), tuple([_constant(c) for c in closed.consts])


def _equations(jaxpr: Jaxpr) -> tuple:
    """Inputs, equations and outputs, variables by their numbers."""
    numbers: dict[Any, int] = {}

    def new(variables: Any) -> tuple:
        for v in variables:
            numbers[v] = len(numbers)
        return tuple([_kind(v.aval) for v in variables])

    def read(atoms: Any) -> tuple:
        return tuple([_constant(a.val) if isinstance(a, Literal) else numbers[a] for a in atoms])

    inputs = new([*jaxpr.constvars, *jaxpr.invars])
    equations = [(e.primitive, read(e.invars), value_key(e.params), new(e.outvars)) for e in jaxpr.eqns]
    return len(jaxpr.constvars), inputs, tuple(equations), read(jaxpr.outvars)


def _kind(aval: Any) -> Any:
    return (aval.shape, aval.dtype, aval.weak_type) if isinstance(aval, ShapedArray) else aval


def _constant(value: Any) -> Any:
    if isinstance(value, Tracer):
        return Same(value)
    array = np.asarray(value)
    return type(value).__name__, array.dtype, array.shape, array.tobytes()


def value_key(value: Any) -> Any:
    """A parameter of an equation, with the first of jaxprs that are alike; one that has no hash is like no other."""
    if isinstance(value, ClosedJaxpr):
        return Same(shared(value))
    if isinstance(value, Jaxpr):
        return _equations(value)
    if isinstance(value, dict):
        return tuple([(name, value_key(value[name])) for name in sorted(value)])
    if isinstance(value, tuple | list):
        return tuple([value_key(one) for one in value])
    return _constant(value) if isinstance(value, np.ndarray | float) else (type(value), value)
