"""What a user's function reads from outside of its arguments: the values that it had when it was stated.

JAX traces a function once, and what was traced keeps the values of then. A global that was changed since, a field of an object
or an entry of an array would be seen by no later run, so that runs ask whether they are what they were.
"""

import argparse
import builtins
import contextlib
import functools
import itertools
import sys
import types
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer

from dirax.program.code_reads import reads
from dirax.program.memo import Memo, Same
from dirax.program.outside_values import (
    ABSENT,
    LIBRARIES,
    NOT_OF_VALUES,
    attribute,
    beside_inner,
    contents,
    inner,
    is_installed,
    is_of_library,
    item,
    keeps_traces,
    package_of,
    package_of_code,
    read_by,
    root_of,
    with_methods,
    written,
)

DEEPEST, MOST = 10, 400
"""How far values are followed, and how many are watched."""

COPIED, LARGEST = 2**20, 2**28
"""Bytes of an array up to which its entries are compared, and up to which a digest of them, a second for a thousand million."""

LONG = 32
"""Numbers of a list from which on they are compared together."""

SPACES = types.SimpleNamespace, argparse.Namespace
"""Objects that are but their attributes."""

IN_CONTAINERS = 2
"""How deep in containers functions are looked for."""

PLAIN = (bool, int, float, complex, str, bytes, type(None), np.generic)


_first_read: "Memo[Captured]" = Memo(256)
"""What classes of users, and functions that these hold as they are, read at their first run."""


class Contents(NamedTuple):
    """What is compared of a value that is not followed, or is large: a digest."""

    digest: int


class Watched(NamedTuple):
    """One value in words, how it is read now, and what it was."""

    words: str
    read: Callable[[], Any]
    before: Any


class Captured:
    """What a function, or the methods of a class, read from outside, as it was when this was made. All are equal, so
    that functions are equal without them."""

    def __init__(self, function: Callable):
        self.watched: list[Watched] = []
        self.stale = ""
        """What a function reads that JAX has traced before, and keeps, with another value."""
        self.whole = True
        """Whether nothing was left out that lies too deep, or is too much: else it is not known that nothing has changed."""
        self._seen: set[int] = set()
        self._follow(function, "", _methods_of(function) if isinstance(function, type) else frozenset(), 0)
        del self._seen
        self.function = function

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Captured)

    def __hash__(self) -> int:
        return hash(Captured)

    def __reduce__(self) -> tuple:
        return Captured, (self.function,)

    def changed(self) -> str:
        """In words, one value that is not what it was; "" where all are."""
        for i, (words, read, before) in enumerate(self.watched):
            if (now := read()) is not before and not _alike(now, before):
                if before is ABSENT:  # a name that is defined after the function
                    self._fill(i, now)
                    continue
                if isinstance(before, Contents):
                    return f"{words}, in which there is something else than when it was stated"
                if isinstance(before, types.CodeType):
                    return f"{words}, whose code is not what it was when it was stated"
                return f"{words}, which was {_short(before)} when it was stated and is {_short(now)} now"
        return ""

    def _fill(self, number: int, value: Any) -> None:
        """Watch a name that has a value now."""
        words, read, _ = self.watched[number]
        names = _attributes(self.function, set()) if isinstance(self.function, types.FunctionType) else frozenset()
        self.watched[number], self._seen = Watched(words, read, value), set()
        self._follow(value, words, names, 1)
        del self._seen

    def _watch(self, words: str, read: Callable[[], Any], names: frozenset[str], depth: int, filled: bool = True) -> None:
        """`filled`: a name without a value is none, and does not get one."""
        value = read()
        if value is ABSENT and filled:
            return
        if len(self.watched) >= MOST:
            self.whole &= isinstance(value, (*PLAIN, jax.Array))
            return
        self.watched.append(Watched(words, read, value))
        self._follow(value, words, names, depth + 1)

    def _follow(self, value: Any, words: str, names: frozenset[str], depth: int) -> None:
        """What can change of a value while it stays the same object; `names` are the attributes that code reads."""
        if isinstance(value, (*PLAIN, jax.Array, Tracer)) or id(value) in self._seen:
            return
        if depth > DEEPEST:
            self.whole = False
            return
        self._seen.add(id(value))
        if isinstance(value, np.ndarray) and value.dtype != object:
            if value.nbytes <= COPIED:
                self.watched.append(Watched(f"the array {words}", lambda: value, value.copy()))
            elif value.nbytes <= LARGEST:
                self._by_contents(f"the array {words}", lambda: np.ascontiguousarray(value))
        elif isinstance(value, functools.partial):
            called = inner(value.func)
            names = names | _attributes(called, set()) if isinstance(called, types.FunctionType) else names
            for part in (value.func, *value.args, *value.keywords.values()):
                self._follow(part, words, names, depth + 1)
        elif isinstance(value, types.MethodType):
            self._follow(value.__func__, words, names, depth + 1)
            own = getattr(value.__func__, "__code__", None)
            self._follow(value.__self__, words or "self", names | reads(own).others if own else names, depth + 1)
        elif (function := inner(value)) is not value:
            if keeps_traces(value):
                self.stale = self.stale or _changed_since_traced(value.__wrapped__)
            for part in (function, *beside_inner(value)):
                self._follow(part, words, names, depth)
        elif isinstance(value, types.FunctionType):
            self._follow_function(value, words or value.__name__, depth)
        elif isinstance(value, Mapping):
            self.whole &= len(value) <= MOST
            keys = lambda: [*itertools.islice(value, MOST)]
            self.watched.append(Watched(f"the keys of {words}", keys, keys()))
            for key in keys():
                self._watch(f"{words}[{key!r}]", functools.partial(item, value, key), names, depth)
        elif isinstance(value, tuple):
            self.whole &= len(value) <= MOST
            for i, part in enumerate(value[:MOST]):
                self._follow(part, f"{words}[{i}]", names, depth + 1)
        elif isinstance(value, list) and len(value) > LONG and all(isinstance(part, PLAIN) for part in value):
            self.watched.append(Watched(f"the list {words}", lambda: value, list(value)))
        elif isinstance(value, list):
            self.whole &= len(value) <= MOST
            self.watched.append(Watched(f"the length of {words}", lambda: len(value), len(value)))
            for i in range(min(len(value), MOST)):
                self._watch(f"{words}[{i}]", functools.partial(item, value, i), names, depth)
        elif isinstance(value, set | frozenset):
            self.watched.append(Watched(words, lambda: frozenset(value), frozenset(value)))
        elif isinstance(value, SPACES):
            self._follow(vars(value), words, names, depth)
        else:
            self._follow_object(value, words, names, depth)

    def _follow_object(self, value: Any, words: str, names: frozenset[str], depth: int) -> None:
        """By the attributes that code reads, of one of a library's or without any by what it is written as."""
        is_object, count = not isinstance(value, type | types.ModuleType), len(self.watched)
        if not is_of_library(value):
            if is_object and is_installed(type(value)):
                names = names & getattr(value, "__dict__", {}).keys()
            else:
                names = with_methods(value, names | read_by(value) if is_object else names)
            frozen = isinstance(value, eqx.Module) or (is_object and root_of(value) == "dirax")
            for name in sorted(value.__dict__.keys() if isinstance(value, eqx.Module) else names):
                whole, read = f"{words}.{name}" if words else name, functools.partial(attribute, value, name)
                if frozen and (held := read()) is not ABSENT:  # it may be changed, and is held for good
                    self._follow(held, whole, names, depth + 1)
                elif not frozen:
                    self._watch(whole, read, names, depth)
        if is_object and len(self.watched) == count and not callable(value) and root_of(value) not in NOT_OF_VALUES:
            self._by_contents(words, lambda: written(value))

    def _follow_function(self, function: types.FunctionType, words: str, depth: int) -> None:
        if package_of(function) in LIBRARIES:
            return
        if package_of(function) != "dirax":  # a module that is loaded again puts other code into the functions of before
            self.watched.append(Watched(words, lambda: function.__code__, function.__code__))
            for name in ("__defaults__", "__kwdefaults__"):
                if (before := getattr(function, name)) is not None:
                    self.watched.append(Watched(f"the defaults of {words}", functools.partial(getattr, function, name), before))
        names = _attributes(function, set())
        for part in (*(function.__defaults__ or ()), *(function.__kwdefaults__ or {}).values()):
            self._follow(part, "a default", names, depth + 1)
        of_itself = function.__name__ in reads(function.__code__).globals
        for name in sorted(names if of_itself else names & vars(function).keys()):
            self._watch(f"{words}.{name}", functools.partial(item, vars(function), name), names, depth, filled=not of_itself)
        for name, read in _outside(function):
            self._watch(name, read, names, depth, filled=False)

    def _by_contents(self, words: str, to_bytes: Callable[[], Any]) -> None:
        """Watch a digest of bytes, where they can be had."""

        def read() -> Contents | None:
            try:
                return Contents(zlib.crc32(to_bytes()))
            except Exception:  # locks, files, what is too large
                return None

        if (before := read()) is not None:
            self.watched.append(Watched(words, read, before))


def _outside(function: types.FunctionType) -> Iterator[tuple[str, Callable[[], Any]]]:
    """The names that a function reads in its closure and as globals, and how; without those in which it keeps a record, and the
    globals of dirax."""
    found = reads(function.__code__)
    records = found.own | found.changed
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        if name not in records:
            yield name, functools.partial(contents, cell)
    if package_of(function) != "dirax":
        for name in sorted(found.globals - records):
            if name in function.__globals__ or not hasattr(builtins, name):
                yield name, functools.partial(item, function.__globals__, name)
        for name in sorted(found.modules):
            if name in sys.modules and not is_of_library(sys.modules[name]):
                yield name, functools.partial(item, sys.modules, name)


def _attributes(function: types.FunctionType, seen: set[int]) -> frozenset[str]:
    """The attributes that a function reads, and those that functions do which it may hand a value to."""
    seen.add(id(function))
    found = reads(function.__code__).others
    for _, read in _outside(function):
        value = read()
        known = isinstance(value, type | types.ModuleType | types.FunctionType) or is_of_library(value)
        if not known and not is_installed(type(value)):
            found |= with_methods(value, found)  # which may be handed other objects
        for other in _functions_among(value):
            if id(other) not in seen and package_of(other) not in LIBRARIES | {"dirax"}:
                found |= _attributes(other, seen)
    return found


def _functions_among(value: Any, depth: int = 0) -> Iterator[types.FunctionType]:
    """A function, or those in lists, tuples and dictionaries."""
    other = inner(value)
    if isinstance(other, types.FunctionType):
        yield other
    elif depth < IN_CONTAINERS and isinstance(value, list | tuple | dict):
        for part in itertools.islice(value.values() if isinstance(value, dict) else value, MOST):
            yield from _functions_among(part, depth + 1)


class ReadsChanged(ValueError):
    """A function reads what is no longer what it was when it was stated."""


_kept: "Memo[Captured]" = Memo(256)
"""What functions read when a system was first stated with them, of which JAX keeps what it traced."""


def _changed_since_traced(function: Any) -> str:
    """In words, what such a function reads that is not what it was then."""
    return _kept.get(Same(function), lambda: Captured(function)).changed()


def refuse_changed(captured: Iterable[tuple[str, Captured]]) -> None:
    """Raise `ReadsChanged` where functions (their name, what they read) would run with values that are not those of now."""
    for name, each in captured:
        if each.stale:
            raise ReadsChanged(
                f"{name} reads {each.stale}, inside of a function that jax.jit or jax.checkpoint has made, and JAX keeps what it "
                "traced of that then: make the function anew, leave jax.jit away, or hand the value over in params."
            )
        if words := each.changed():
            raise ReadsChanged(
                f"{name} reads {words}; what was traced of it keeps the old value: state it again for the new one, or hand the "
                "value over in params."
            )


def _alike(now: Any, before: Any) -> bool:
    """Whether two objects are one value to a function."""
    if isinstance(now, types.FunctionType) and isinstance(before, types.FunctionType):
        same = _same_parts if package_of_code(now) in LIBRARIES else _same_values
        return now.__code__ == before.__code__ and same(now, before)
    if isinstance(now, np.ndarray | jax.Array) and isinstance(before, np.ndarray | jax.Array):
        if isinstance(now, Tracer) or isinstance(before, Tracer) or now.dtype != before.dtype or now.shape != before.shape:
            return False
        return np.asarray(now).tobytes() == np.asarray(before).tobytes()
    if type(now) is not type(before):
        return False
    if hasattr(now, "__array__"):  # those of other libraries, which make new ones where they are asked for the same
        with contextlib.suppress(Exception):
            one, other = np.asarray(now), np.asarray(before)
            if one.dtype != object and other.dtype != object:
                return _alike(one, other)
    if type(now) is tuple:
        return len(now) == len(before) and all(x is y or _alike(x, y) for x, y in zip(now, before, strict=True))
    if type(now) is dict:
        return now.keys() == before.keys() and all(x is before[name] or _alike(x, before[name]) for name, x in now.items())
    try:
        return bool(now == before) or bool(now != now and before != before)
    except Exception:  # values that have no truth
        return False


def _same_parts(one: types.FunctionType, other: types.FunctionType) -> bool:
    """Whether two functions of a library, such as those that it makes of a user's, hold the same."""
    parts = lambda f: (f.__defaults__, f.__kwdefaults__, *map(contents, f.__closure__ or ()))
    return _alike(parts(one), parts(other))


def _same_values(one: Callable, other: Callable) -> bool:
    a, b = (Captured(function).watched for function in (one, other))
    return len(a) == len(b) and all(
        x.words == y.words and (x.before is y.before or _alike(x.before, y.before)) for x, y in zip(a, b, strict=True)
    )


def _short(value: Any) -> str:
    text = "gone" if value is ABSENT else repr(value)
    return text if len(text) <= 40 else f"{text[:39]}…"


def _methods_of(kind: type) -> frozenset[str]:
    """The names of the methods that a user's class states, and those that it has of others."""
    own = (each for each in kind.__mro__ if not is_of_library(each))
    return frozenset(name for each in own for name, f in vars(each).items() if isinstance(inner(f), types.FunctionType))


def functions_in(value: Any) -> Iterator[tuple[str, Captured]]:
    """The functions of systems and schemes with their names, of those inside them too; and classes that are a user's own, with
    what their methods read when the first of their objects was run."""
    if isinstance(captured := getattr(value, "captured", None), Captured):
        if captured.watched:
            yield value.name, captured
    elif isinstance(value, types.FunctionType | types.MethodType) and package_of(value) not in LIBRARIES | {"dirax"}:
        yield value.__qualname__, _first_read.get(Same(value), lambda: Captured(value))
    elif isinstance(value, eqx.Module):
        if not is_of_library(kind := type(value)) and not is_installed(kind):
            yield kind.__name__, _first_read.get(Same(kind), lambda: Captured(kind))
        for name in value.__dataclass_fields__:
            yield from functions_in(getattr(value, name, None))
    elif isinstance(value, list | tuple):
        for part in value:
            yield from functions_in(part)
