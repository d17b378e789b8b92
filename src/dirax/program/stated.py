"""A user's function as it is stated: one object for all functions of the same code that read the same values, so that a system
which is stated anew, in a loss function for instance, is equal to the one before and nothing is traced or compiled again."""

import functools
import sys
import types
import weakref
from collections.abc import Callable, Hashable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.core import Tracer

from dirax.program.captured import Captured
from dirax.program.code_reads import reads
from dirax.program.memo import Memo, Same
from dirax.program.outside_values import ABSENT, LIBRARIES, contents, package_of

STATED, VERSIONS = 512, 8
"""Functions that are kept in mind, and for each what it read from outside when it was stated, of the last times."""

DEEPEST = 4
"""How many functions, lists and dictionaries one in another are compared by what is in them."""

MOST_BYTES = 2**16
"""How large an array is that is compared by its numbers, which are kept."""

WRITTEN = float, complex, int, bool, str, bytes, type(None)
"""Kinds of values that their representation tells apart, −0.0 from 0.0 too."""

_stated: Memo[list[tuple[Captured, Callable]]] = Memo(STATED)

_standing: weakref.WeakSet = weakref.WeakSet()
"""The functions that stand for users' ones, some of which may have been forgotten since."""


class Stated(NamedTuple):
    """A user's function: what it read when it was stated; and what stands for it, with what that reads."""

    captured: Captured
    held: Captured
    function: Callable


def as_stated(function: Callable) -> Stated:
    """A function with what stands for it, the same object for functions that are one.

    They are where their code, their globals and the values in their closures and defaults are, and what else they read has not
    changed since. What stands for a function holds the values of its closure as they are now, whatever is assigned to their names
    later, and is another object where the function, or one like it, has read something else before.
    """
    of_values = is_of_values(function)
    known = _stated.get(key_of(function, 0) if of_values else function, list)
    for was, stands in known:
        if was.whole and not was.changed():
            return Stated(was if stands is function else Captured(function), was, stands)
    captured, stands = Captured(function), held(function, 0) if of_values else function
    if stands is function and (known or (isinstance(function, types.FunctionType) and function in _standing)):
        stands = _again(function)
    own = captured if stands is function else Captured(stands)
    known[:] = [*known[1 - VERSIONS :], (own, stands)]
    if isinstance(stands, types.FunctionType):
        _standing.add(stands)
    return Stated(captured, own, stands)


def is_of_values(function: Any) -> bool:
    """Whether a function is one of the user's that is known by its code and what it reads, and keeps no record in that."""
    if not isinstance(function, types.FunctionType) or vars(function) or function.__kwdefaults__:
        return False
    if package_of(function) in LIBRARIES or _is_of_module(function):
        return False
    found, cells = reads(function.__code__), function.__closure__ or ()
    keeps = (found.own | found.changed) & {*function.__code__.co_freevars, *found.globals}
    return not keeps and all(contents(cell) is not ABSENT for cell in cells)


def _is_of_module(function: types.FunctionType) -> bool:
    """Whether a function is what a module has under its name, and is sent to other processes by that name; in the main module
    it may be defined anew."""
    module = sys.modules.get(function.__module__ or "")
    return function.__module__ != "__main__" and getattr(module, function.__qualname__, None) is function


def key_of(value: Any, depth: int) -> Hashable:
    """Equal for values that are the same to a function which only reads them; of others the object itself."""
    if type(value) in WRITTEN:
        return type(value), repr(value)
    if isinstance(value, np.generic) or _is_small(value):
        array = np.asarray(value)
        return type(value), array.dtype.str, array.shape, array.tobytes(), getattr(value, "weak_type", False)
    if depth < DEEPEST and type(value) in (list, tuple):
        return type(value), *(key_of(part, depth + 1) for part in value)
    if depth < DEEPEST and type(value) is dict:
        return dict, *((key_of(name, depth + 1), key_of(part, depth + 1)) for name, part in value.items())
    if depth < DEEPEST and is_of_values(value):
        return *of_code(value), *(key_of(part, depth + 1) for part in outside_of(value))
    return Same(value)


def held(value: Any, depth: int) -> Any:
    """The same with copies of all that `key_of` compares by what is in it."""
    if type(value) is np.ndarray and _is_small(value):
        return value.copy()
    if depth < DEEPEST and type(value) in (list, tuple):
        return type(value)(held(part, depth + 1) for part in value)
    if depth < DEEPEST and type(value) is dict:
        return {name: held(part, depth + 1) for name, part in value.items()}
    if depth < DEEPEST and is_of_values(value) and _has_to_hold(value):
        return with_outside(value, [held(part, depth + 1) for part in outside_of(value)])
    return value


def of_code(function: types.FunctionType) -> tuple[Hashable, ...]:
    """What tells a function apart besides the values of its defaults and in its closure."""
    return function.__code__, Same(function.__globals__), len(function.__defaults__ or ())


def outside_of(function: types.FunctionType) -> list[Any]:
    """The values of the defaults of a function and in its closure."""
    return [*(function.__defaults__ or ()), *(cell.cell_contents for cell in function.__closure__ or ())]


def with_outside(function: types.FunctionType, values: Sequence) -> types.FunctionType:
    """The function with others in their place."""
    count = len(function.__defaults__ or ())
    return _with(function, tuple(values[:count]) or None, tuple(map(types.CellType, values[count:])) or None)


def _has_to_hold(function: types.FunctionType) -> bool:
    """Whether a function reads values that may be others later."""
    return bool(function.__closure__) or any(type(value) not in WRITTEN for value in function.__defaults__ or ())


def _is_small(value: Any) -> bool:
    """Whether a value is an array of numbers that are compared one by one."""
    known = type(value) is np.ndarray or (isinstance(value, jax.Array) and not isinstance(value, Tracer))
    return known and isinstance(value.dtype, np.dtype) and value.dtype != object and value.nbytes <= MOST_BYTES


def _again(function: Callable) -> Callable:
    """The same function as another object."""
    if not isinstance(function, types.FunctionType):
        return functools.partial(function)
    return _with(function, function.__defaults__, function.__closure__)


def _with(function: types.FunctionType, defaults: tuple | None, closure: tuple | None) -> types.FunctionType:
    """The function with other defaults and another closure."""
    other = types.FunctionType(function.__code__, function.__globals__, function.__name__, defaults, closure)
    other.__kwdefaults__, other.__module__, other.__doc__ = function.__kwdefaults__, function.__module__, function.__doc__
    other.__qualname__ = function.__qualname__
    return other
