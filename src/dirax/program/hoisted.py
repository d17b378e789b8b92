"""Values that JAX traces and functions close over, handed over with the params: what is traced and compiled of such a function
serves every call of a loss that states it anew, as it does with values in params."""

import functools
import itertools
import types
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
from jax.core import Tracer

from dirax.program.captured import Captured
from dirax.program.code_reads import reads
from dirax.program.memo import Memo, OfKey
from dirax.program.outside_values import is_installed, is_of_library, package_of
from dirax.program.stated import DEEPEST, VERSIONS, held, is_of_values, key_of, of_code, outside_of, with_outside

Make = Callable[[Sequence], Any]
"""What makes a value from those that are traced in it."""

PLACE = "a traced value"

_versions = itertools.count()

_kept: "Memo[list[OfHoisted]]" = Memo(512)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Hoisted:
    """The params of a run, and the traced values that its functions close over."""

    params: Any
    values: tuple

    def __getitem__(self, name: Any) -> Any:
        return self.params[name]

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.params, name)


def beside(params: Any, others: Any) -> Any:
    """Params with the hoisted values of others, where these have some."""
    return Hoisted(params, others.values) if isinstance(others, Hoisted) and not isinstance(params, Hoisted) else params


def split(params: Any, function: Callable, places: tuple[int, ...] | None) -> tuple[Any, tuple]:
    """The params that a function takes, which are all of them for those of dirax that hand them on, and what it takes before its
    arguments: its values at these `places`."""
    if not isinstance(params, Hoisted):
        if places is not None:
            raise TypeError("a function of hoisted values is called with params that do not hold them")
        return params, ()
    if places is None and package_of(function) == "dirax":
        return params, ()
    return params.params, () if places is None else (tuple(params.values[i] for i in places),)


class OfHoisted(OfKey):
    """A function of the values that it closed over, in order, and of its arguments; one object for all that are equal."""

    def __init__(self, key: tuple, make: Make, count: int):
        self.key, self.make, self.__wrapped__ = key, make, make([None] * count)
        self.__name__, self.__doc__ = getattr(self.__wrapped__, "__name__", PLACE), getattr(self.__wrapped__, "__doc__", None)
        self.outside = Captured(self.__wrapped__)

    def __call__(self, values: Sequence, *arguments: Any, **named: Any) -> Any:
        return self.make(values)(*arguments, **named)


def hoisted(function: Callable, values: list[Tracer]) -> tuple[OfHoisted, tuple[int, ...]] | None:
    """A function with what it closes over taken out, and the places of that among `values`, to which it is added; None where
    nothing is traced in it, or what is there is not known by its value."""
    found: list[Tracer] = []
    key, make = _opened(function, found, 0)
    if not found:
        return None
    try:
        known = _kept.get(key, list)
    except TypeError:  # something static in it has no hash
        return None
    places = tuple(_place(value, values) for value in found)
    stands = next((other for other in known if not other.outside.changed()), None)
    if stands is None:  # it has read something else from outside before
        stands = OfHoisted((key, next(_versions)), make, len(found))
        known[:] = [*known[1 - VERSIONS :], stands]
    return stands, places


def _place(value: Tracer, among: list[Tracer]) -> int:
    """Where a value is among others, to which it is added if it is not there."""
    number = next((i for i, other in enumerate(among) if other is value), len(among))
    among += [value] * (number == len(among))
    return number


def _opened(value: Any, found: list[Tracer], depth: int) -> tuple[Any, Make]:
    """What a value is told apart by, and how one like it is made of other traced values than those that are added to `found`."""
    if isinstance(value, Tracer):
        number = _place(value, found)
        return (PLACE, number), lambda values: values[number]
    if depth < DEEPEST and (parts := _parts(value)) is not None:
        kind, inside, make = parts
        opened = [_opened(part, found, depth + 1) for part in inside]
        if any(isinstance(key, tuple) and key[0] is PLACE for key, _ in opened):
            return (PLACE, kind, *(key for key, _ in opened)), lambda values: make([of(values) for _, of in opened])
    constant = held(value, depth)
    return key_of(value, depth), lambda values: constant


def _parts(value: Any) -> tuple[Hashable, Sequence, Make] | None:
    """What a value is besides its parts, these, and how one is made of others; None for one without parts."""
    if is_of_values(value):
        inside = outside_of(value)
        return of_code(value), inside, functools.partial(with_outside, with_outside(value, [None] * len(inside)))
    if type(value) is functools.partial:
        names = tuple(value.keywords)
        count = len(value.args)

        def partial(parts: Sequence) -> Any:
            return functools.partial(parts[0], *parts[1 : 1 + count], **dict(zip(names, parts[1 + count :], strict=True)))

        return (functools.partial, names, count), (value.func, *value.args, *value.keywords.values()), partial
    if isinstance(value, types.MethodType):
        return (types.MethodType, value.__func__), (value.__self__,), lambda parts: types.MethodType(value.__func__, *parts)
    try:
        leaves, structure = jax.tree.flatten(value)
    except Exception:  # the keys of a dictionary that have no order
        return None
    if len(leaves) == 1 and leaves[0] is value:
        return _parts_of_object(value)
    return structure, leaves, functools.partial(jax.tree.unflatten, structure)


def _parts_of_object(value: Any) -> tuple[Hashable, Sequence, Make] | None:
    """The attributes of an object of a user's own class that changes none of them in its methods."""
    kind = type(value)
    if isinstance(value, type | types.ModuleType) or not hasattr(value, "__dict__") or is_of_library(kind) or is_installed(kind):
        return None
    names = tuple(vars(value))
    methods = (f for each in kind.__mro__ for name, f in vars(each).items() if name != "__init__")
    if any(reads(f.__code__).changed for f in methods if isinstance(f, types.FunctionType)):
        return None

    def like(parts: Sequence) -> Any:
        other = object.__new__(kind)
        vars(other).update(zip(names, parts, strict=True))
        return other

    return (kind, names), tuple(vars(value).values()), like
