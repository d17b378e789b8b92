"""What the functions of a step equation of one's own return, asked once: shapes, names and kinds of numbers."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

from dirax.program.memo import Memo, Same
from dirax.schemes.step import StepEquation

_asked: Memo[bool] = Memo(64)


def refuse_wrong_shapes(equation: Any, data: Mapping[str, Any], h: Any, params: Any) -> None:
    """Raise `ValueError` where a function of a stage that is not dirax's own returns what its sizes and fields do not say; `data`
    are the complete ones of one trajectory."""
    for stage, _ in equation.stages:
        if not _is_known(stage.residual):
            _asked.get(Same(stage), lambda stage=stage: _ask(stage, data, h, params))


def _is_known(function: Callable) -> bool:
    return (getattr(getattr(function, "__func__", function), "__module__", None) or "").startswith("dirax.")


def _ask(stage: StepEquation, data: Mapping[str, Any], h: Any, params: Any) -> bool:
    vector = lambda size: jax.ShapeDtypeStruct((size,), np.float64)
    number, x, u = jax.ShapeDtypeStruct((), np.float64), vector(stage.state_size), vector(stage.unknowns)
    begun = jax.eval_shape(stage.start, dict(data), h, params)
    if not isinstance(begun, tuple | list) or len(begun) != 2:
        raise ValueError(
            f"start of the step equation must return two vectors, (state, first guess), but it returned {_said(begun)}."
        )
    _refuse("start", begun[0], stage.state_size, "the state", "state_size")
    _refuse("start", begun[1], stage.unknowns, "the first guess", "unknowns")
    _refuse("residual", jax.eval_shape(stage.residual, u, x, number, number, params), stage.unknowns, "r", "unknowns")
    _refuse(
        "advance", jax.eval_shape(stage.advance, u, x, number, number, params), stage.state_size, "the next state", "state_size"
    )
    _refuse("guess", jax.eval_shape(stage.guess, x, u, number, params), stage.unknowns, "the unknowns", "unknowns")
    row = jax.eval_shape(stage.unpack, x, u, number, number, params)
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
    if not hasattr(found, "dtype") or found.shape != (size,) or found.dtype != np.float64:
        raise ValueError(
            f"{function} of the step equation must return {what} of shape ({size},) in float64, as {named}={size} says, but it "
            f"returned {_said(found)}."
        )


def _said(found: Any) -> str:
    return f"{found.dtype} of shape {found.shape}" if hasattr(found, "dtype") else f"{found!r:.60}"
