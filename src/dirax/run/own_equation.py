"""What the functions of a system and of a step equation of one's own return, asked before they are used: shapes, names and kinds
of numbers."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

from dirax.numerics.arrays import is_whole
from dirax.program.memo import Memo, Same, by_value
from dirax.program.outside_values import package_of
from dirax.program.user_functions import why_untraced
from dirax.schemes.step import StepEquation
from dirax.systems.shape import Shape

COMPLETE = {"x": ("x", "velocity"), "q": ("q", "v", "p"), "q0": ("q0", "q1")}
"""What completed data hold of those that are given."""

_asked: Memo[bool] = Memo(64)


def shape_of(system: Any, data: Mapping[str, Any], params: Any) -> Shape:
    """The sizes of a system with these data of one trajectory. Raises `TypeError` and `ValueError` where a
    method of one that is not dirax's own returns what it should not."""
    sizes = system.sizes(data, params)
    if package_of(system) == "dirax":
        return Shape(*sizes)
    name = type(system).__name__
    if not isinstance(sizes, tuple | list) or len(sizes) not in (2, 3) or not all(is_whole(size) and size >= 0 for size in sizes):
        raise TypeError(
            f"sizes of {name} must return (n, m) or (n, m, c), numbers of coordinates and constraints, not {sizes!r:.60}."
        )
    shape, data = Shape(*map(int, sizes)), {**data, "t": jax.ShapeDtypeStruct((), np.float64)}
    complete = _returned(f"complete of {name}", lambda data, params: system.complete(data, params, False), data, params)
    needed = next((names for given, names in COMPLETE.items() if given in data), ())
    if not isinstance(complete, Mapping) or not set(needed) <= set(complete):
        held = ", ".join(complete) if isinstance(complete, Mapping) else _said(complete)
        raise ValueError(f"complete of {name} must return a dict with {', '.join(needed)}, but it returned {held}.")
    relation = system.relation_form(shape)
    if relation is not None and "x" in complete:
        x, u = complete["x"], jax.ShapeDtypeStruct((relation.multipliers,), np.float64)
        found = _returned(f"the relation of {name}", relation.residual, x, x, u, data["t"], params)
        size = x.shape[0] + relation.multipliers
        if not _is_vector(found, size):
            needed = f"{size} numbers in float64, one of each coordinate and multiplier"
            raise ValueError(f"the relation of {name} must return {needed}, but it returned {_said(found)}.")
    return shape


def _returned(what: str, function: Callable, *arguments: Any) -> Any:
    """The shapes of what a user's function returns, whose last argument are params. Raises `TypeError` for one that JAX does not
    trace; a `ValueError` is its own."""
    try:
        return jax.eval_shape(function, *arguments)
    except ValueError:
        raise
    except Exception as error:
        raise TypeError(f"{what} could not be traced by JAX: {why_untraced(error, arguments[-1])}") from error


def refuse_wrong_shapes(system: Any, equation: Any, data: Mapping[str, Any], h: Any, params: Any) -> None:
    """Raise `ValueError` where a function of a stage that is not dirax's own returns what its sizes and fields do not say, and
    where the energy of such a system is not one number; `data` are the complete ones of one trajectory."""
    if package_of(system) != "dirax":
        _asked.get((by_value(system), Same(equation)), lambda: _ask_energy(system, equation, params))
    for stage, _ in equation.stages:
        if package_of(stage.residual) != "dirax":
            _asked.get(Same(stage), lambda stage=stage: _ask(stage, data, h, params))


def _ask_energy(system: Any, equation: Any, params: Any) -> bool:
    nodes = {name: jax.ShapeDtypeStruct(f.shape, np.float64) for name, f in equation.fields.items() if f.place == "node"}
    try:
        found = jax.eval_shape(system.energy_at, {**nodes, "t": jax.ShapeDtypeStruct((), np.float64)}, params)
    except Exception:  # it asks for what these rows do not hold, or is not there: nothing asks for it in a run
        return True
    if np.shape(found) != ():
        raise ValueError(f"energy_at of {type(system).__name__} must return one number, but it returned {_said(found)}.")
    return True


def _ask(stage: StepEquation, data: Mapping[str, Any], h: Any, params: Any) -> bool:
    vector = lambda size: jax.ShapeDtypeStruct((size,), np.float64)
    number, x, u = jax.ShapeDtypeStruct((), np.float64), vector(stage.state_size), vector(stage.unknowns)
    begins = {"start": dict(data)}
    if stage.resume is not stage.start:
        begins["resume"] = {**data, **{name: jax.ShapeDtypeStruct(f.shape, np.float64) for name, f in stage.fields.items()}}
    for name, known in begins.items():
        begun = _returned(f"{name} of the step equation", getattr(stage, name), known, h, params)
        if not isinstance(begun, tuple | list) or len(begun) != 2:
            raise ValueError(
                f"{name} of the step equation must return two vectors, (state, first guess), but it returned {_said(begun)}."
            )
        _refuse(name, begun[0], stage.state_size, "the state", "state_size")
        _refuse(name, begun[1], stage.unknowns, "the first guess", "unknowns")
    asked = lambda name, *arguments: _returned(f"{name} of the step equation", getattr(stage, name), *arguments, params)
    _refuse("residual", asked("residual", u, x, number, number), stage.unknowns, "r", "unknowns")
    _refuse("advance", asked("advance", u, x, number, number), stage.state_size, "the next state", "state_size")
    _refuse("guess", asked("guess", x, u, number), stage.unknowns, "the unknowns", "unknowns")
    row = asked("unpack", x, u, number, number)
    if not isinstance(row, Mapping) or set(row) != set(stage.fields):
        held = ", ".join(row) if isinstance(row, Mapping) else _said(row)
        raise ValueError(
            f"unpack of the step equation must return a dict of its fields, {', '.join(stage.fields)}, but it returned {held}."
        )
    for name, field in stage.fields.items():
        if np.shape(row[name]) != field.shape:
            raise ValueError(
                f"unpack of the step equation must return {name} of shape {field.shape}, as fields say, but it returned "
                f"{_said(row[name])}."
            )
    return True


def _refuse(function: str, found: Any, size: int, what: str, named: str) -> None:
    if not _is_vector(found, size):
        raise ValueError(
            f"{function} of the step equation must return {what} of shape ({size},) in float64, as {named}={size} says, but it "
            f"returned {_said(found)}."
        )


def _is_vector(found: Any, size: int) -> bool:
    return hasattr(found, "dtype") and found.shape == (size,) and found.dtype == np.float64


def _said(found: Any) -> str:
    if hasattr(found, "dtype"):
        return f"{found.dtype} of shape {found.shape}"
    return "None" if found is None else f"a {type(found).__name__}"
