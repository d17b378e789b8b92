"""The elements of a circuit: checked, and their values as functions where they are no numbers."""

from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jax.core import Tracer

from dirax.numerics.arrays import is_whole
from dirax.program.signatures import parameters_of
from dirax.program.user_functions import UserFunction, is_traced

GROUND = 0
Element = tuple[str, Any, Any, Any]
"""(kind, from, to, value): see `dx.circuit`."""

KINDS = ("C", "L", "R", "I", "V", "T")
ELEMENT = "(C, L, R, V, I or T, node, other node, value)"
ARGUMENTS: dict[str, tuple[str, tuple[str, ...]]] = {
    "C": ("capacitance", ()),
    "L": ("inductance", ()),
    "R": ("current", ("u",)),
    "V": ("voltage", ("t",)),
    "I": ("current", ("t",)),
}
"""What functions are the values of elements, and of what beside params."""

TRIED = np.concatenate([-np.geomspace(1e-9, 1.0, 40)[::-1], [0.0], np.geomspace(1e-9, 1.0, 40)])
"""Voltages at which a diode-like resistor is asked for its current."""


@dataclass(frozen=True)
class OfParams:
    """params ↦ the one of this name."""

    name: str

    def __call__(self, params: Any) -> Any:
        return params[self.name]


def function_of(element: Element) -> UserFunction | None:
    """The value of an element as a function of its voltage, of the time or of params alone; None of one that is a number."""
    kind, *_, value = element
    if not callable(value) and not isinstance(value, str):
        return None
    if kind not in ARGUMENTS:
        raise TypeError("only C, L, R, V and I may be functions, or names of params")
    name, arguments = ARGUMENTS[kind]
    alone = isinstance(value, str) or not arguments or parameters_of(value) == ("params",)
    if alone:
        name, arguments = "resistance" if kind == "R" else name, ()
    function = UserFunction(OfParams(value) if isinstance(value, str) else value, name, arguments)
    if alone and not function.takes_params:
        raise TypeError(f"{name} must be a number, the name of one of the params, or a function {name}(params)")
    return function


def checked(element: Any) -> Element:
    """The element, with a number for an array of one. Raises `ValueError` and `TypeError` for what is no element."""
    given = f"{element!r:.100} was given"
    if not isinstance(element, tuple | list) or len(element) != 4 or not isinstance(element[0], str) or element[0] not in KINDS:
        raise ValueError(f"an element is {ELEMENT}, but {given}.")
    kind, start, end, value = element
    if isinstance(value, np.ndarray | np.number | jax.Array) and not isinstance(value, Tracer) and value.shape == ():
        value = value.item()
    stated = kind, start, end, value
    sides = (start, end) if kind == "T" else ((start, end),)
    if not all(isinstance(ends, tuple | list) and len(ends) == 2 for ends in sides):
        raise ValueError(f"a transformer is (T, (a, b), (c, d), ratio), but {given}.")
    if not all(is_whole(node) for ends in sides for node in ends):
        raise TypeError(f"nodes are whole numbers, {GROUND} that of the ground, but {given}.")
    if any(a == b for a, b in sides):
        raise ValueError(f"an element is {ELEMENT} between two nodes, but {given}.")
    if isinstance(value, str) or callable(value):
        _check_function(stated, given)
        return stated
    if isinstance(value, bool) or not isinstance(value, int | float | np.number) or not np.isfinite(value):
        raise TypeError(
            "the value of an element must be a finite number, or, but for T, the name of one of the params or a function, but "
            f"{given}."
        )
    check_values(stated, value)
    if kind == "T" and value == 0:
        raise ValueError(f"the ratio of a transformer is not zero, but {given}.")
    return stated


def _check_function(element: Element, given: str) -> None:
    try:
        function = function_of(element)
    except TypeError as error:
        raise TypeError(f"{str(error).rstrip('.')}; {given}.") from error
    if function is not None and not function.takes_params:
        check_result(element, function, None)
        if element[0] == "R" and not is_traced(element[3](TRIED[0])):
            check_values(element, np.array([float(element[3](u)) for u in TRIED]))


def check_result(element: Element, function: UserFunction, params: Any) -> None:
    """Raise `TypeError` for a value that is no function with a number for result, that JAX can trace."""
    try:
        if shape := function.shape(*[np.float64(0.0)] * len(function.arguments), params).shape:
            raise TypeError(
                f"{function.name}({', '.join(function.arguments)}) must return one number, but it returned shape {shape}."
            )
    except (TypeError, ValueError) as error:
        raise TypeError(f"{str(error).rstrip('.')}; {element!r:.100} was given.") from error


def check_values(element: Element, found: Any) -> None:
    """Raise `ValueError` for a value that is not more than 0 where it has to be; or, of its currents at the voltages `TRIED`, for
    a resistor that gives energy, or has a falling current."""
    given = f"{element!r:.100} was given"
    if np.ndim(found):
        return _check_currents(np.asarray(found), given)
    if element[0] in "CLR" and not found > 0:
        told = "" if found is element[3] else f", and here it is {found:.6g}"
        raise ValueError(f"an element is (C, L, R, V, I or T, node, other node, value > 0), but {given}{told}.")


def _check_currents(found: np.ndarray, given: str) -> None:
    wrong = ~np.isfinite(found) | (np.sign(found) * TRIED < 0) | ((TRIED == 0) & (found != 0))
    if np.any(wrong):
        at = TRIED[int(np.argmax(wrong))]
        raise ValueError(
            f"the current of a diode-like resistor is zero at zero and has the sign of its voltage, but at {at:.3g} it is "
            f"{found[int(np.argmax(wrong))]:.3g}: {given}."
        )
    if np.any(np.diff(found) < 0):
        raise ValueError(f"the current of a diode-like resistor never falls with its voltage, but here it does: {given}.")
