"""What a user's function reads from outside of its arguments: the values that it had when it was stated.

JAX traces a function once, and what was traced keeps the values of then. A global that was changed since, a field of an object
or an entry of an array would be seen by no later run, so that runs ask whether they are what they were.
"""

import argparse
import contextlib
import functools
import pickle
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

DEEPEST, MOST = 6, 400
"""How far values are followed, and how many are watched."""

COPIED, LARGEST = 2**20, 2**28
"""Bytes of an array up to which its entries are compared, and up to which a digest of them, a second for a thousand million; and
of other objects that are compared by what they are written as, the first."""

LIBRARIES = {"jax", "jaxlib", "numpy", "scipy", "equinox", "jaxtyping", "optax", *sys.stdlib_module_names} - {"__main__"}
"""Packages whose functions and modules are taken not to change."""

SPACES = types.SimpleNamespace, argparse.Namespace
"""Objects that are but their attributes."""

NOT_TO_READ = {*("__init__", "__new__", "__del__", "__repr__", "__str__", "__hash__", "__eq__", "__setitem__", "__setattr__")}
"""Methods of objects that are not called where one reads them."""

NOT_OF_VALUES = {"dirax", "jax", "jaxlib", "equinox"}
"""Packages whose objects are not asked for what they are written as."""

ABSENT = object()

PLAIN = (bool, int, float, complex, str, bytes, type(None), np.generic)


class Contents(NamedTuple):
    """What is compared of a value that is not followed, or is large: a digest."""

    digest: int


class Watched(NamedTuple):
    """One value in words, how it is read now, and what it was."""

    words: str
    read: Callable[[], Any]
    before: Any


class Captured:
    """The values that a function reads from outside, as they were when this was made. All are equal, so that functions are equal
    without them."""

    def __init__(self, function: Callable):
        self.watched: list[Watched] = []
        self._seen: set[int] = set()
        self._follow(function, "", frozenset(), 0)
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
        for words, read, before in self.watched:
            if (now := read()) is not before and not _alike(now, before):
                if isinstance(before, Contents):
                    return f"{words}, in which there is something else than when it was stated"
                return f"{words}, which was {_short(before)} when it was stated and is {_short(now)} now"
        return ""

    def _watch(self, words: str, read: Callable[[], Any], names: frozenset[str], depth: int) -> None:
        value = read()
        if value is ABSENT or len(self.watched) >= MOST:
            return
        self.watched.append(Watched(words, read, value))
        self._follow(value, words, names, depth + 1)

    def _follow(self, value: Any, words: str, names: frozenset[str], depth: int) -> None:
        """What can change of a value while it stays the same object; `names` are the attributes that code reads."""
        if depth > DEEPEST or isinstance(value, (*PLAIN, jax.Array, Tracer)) or id(value) in self._seen:
            return
        self._seen.add(id(value))
        if isinstance(value, np.ndarray) and value.dtype != object:
            if value.nbytes <= COPIED:
                self.watched.append(Watched(f"the array {words}", lambda: value, value.copy()))
            elif value.nbytes <= LARGEST:
                self._by_contents(f"the array {words}", lambda: np.ascontiguousarray(value))
        elif isinstance(value, functools.partial):
            for part in (value.func, *value.args, *value.keywords.values()):
                self._follow(part, words, names, depth + 1)
        elif isinstance(value, types.MethodType):
            self._follow(value.__func__, words, names, depth + 1)
            own = getattr(value.__func__, "__code__", None)
            self._follow(value.__self__, words or "self", names | reads(own).others if own else names, depth + 1)
        elif isinstance(value, types.FunctionType):
            self._follow_function(value, depth)
        elif (inner := _inner(value)) is not value:
            self._follow(inner, words, names, depth)
        elif isinstance(value, Mapping):
            self.watched.append(Watched(f"the keys of {words}", lambda: [*value][:MOST], [*value][:MOST]))
            for key in [*value][:MOST]:
                self._watch(f"{words}[{key!r}]", functools.partial(_item, value, key), names, depth)
        elif isinstance(value, tuple):
            for i, part in enumerate(value[:MOST]):
                self._follow(part, f"{words}[{i}]", names, depth + 1)
        elif isinstance(value, list):
            self.watched.append(Watched(f"the length of {words}", lambda: len(value), len(value)))
            for i in range(min(len(value), MOST)):
                self._watch(f"{words}[{i}]", functools.partial(_item, value, i), names, depth)
        elif isinstance(value, set | frozenset):
            self.watched.append(Watched(words, lambda: frozenset(value), frozenset(value)))
        elif isinstance(value, SPACES):
            self._follow(vars(value), words, names, depth)
        else:
            self._follow_object(value, words, names, depth)

    def _follow_object(self, value: Any, words: str, names: frozenset[str], depth: int) -> None:
        """By the attributes that code reads, of one of a library's or without any by what it is written as."""
        is_object, count = not isinstance(value, type | types.ModuleType), len(self.watched)
        if not _is_of_library(value):
            if is_object and _is_installed(type(value)):
                names = names & getattr(value, "__dict__", {}).keys()
            else:
                names = _with_methods(value, names | _to_read(value) if is_object else names)
            frozen = isinstance(value, eqx.Module) or (is_object and _root(value) == "dirax")
            for name in sorted(value.__dict__.keys() if isinstance(value, eqx.Module) else names):
                whole, read = f"{words}.{name}" if words else name, functools.partial(_attribute, value, name)
                if frozen:  # what it holds may be changed, and is held for good
                    self._follow(read(), whole, names, depth + 1)
                else:
                    self._watch(whole, read, names, depth)
        if is_object and len(self.watched) == count and not callable(value) and _root(value) not in NOT_OF_VALUES:
            self._by_contents(words, lambda: _written(value))

    def _follow_function(self, function: types.FunctionType, depth: int) -> None:
        if _package(function) in LIBRARIES:
            return
        names = _attributes(function, set())
        for part in (*(function.__defaults__ or ()), *(function.__kwdefaults__ or {}).values()):
            self._follow(part, "a default", names, depth + 1)
        for name, read in _outside(function):
            self._watch(name, read, names, depth)

    def _by_contents(self, words: str, written: Callable[[], Any]) -> None:
        """Watch a digest of bytes, where they can be had."""
        read = lambda: Contents(zlib.crc32(written()))
        with contextlib.suppress(Exception):  # locks, files, what is too large
            self.watched.append(Watched(words, read, read()))


def _package(function: types.FunctionType) -> str:
    return (function.__module__ or "").partition(".")[0]


def _outside(function: types.FunctionType) -> Iterator[tuple[str, Callable[[], Any]]]:
    """The names that a function reads in its closure and as globals, and how; without those in which it keeps a record, and the
    globals of dirax."""
    found = reads(function.__code__)
    records = found.own | found.changed
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        if name not in records:
            yield name, functools.partial(contents, cell)
    if _package(function) != "dirax":
        for name in sorted(found.globals - records):
            if name in function.__globals__:
                yield name, functools.partial(_item, function.__globals__, name)


def _attributes(function: types.FunctionType, seen: set[int]) -> frozenset[str]:
    """The attributes that a function reads, and those that functions do which it may hand a value to."""
    seen.add(id(function))
    found = reads(function.__code__).others
    for _, read in _outside(function):
        other = _inner(read())
        if isinstance(other, types.FunctionType) and id(other) not in seen and _package(other) not in LIBRARIES | {"dirax"}:
            found |= _attributes(other, seen)
    return found


def refuse_changed(captured: Iterable[tuple[str, Captured]]) -> None:
    """Raise `ValueError` where functions (their name, what they read) would run with values that are not those of now."""
    for name, each in captured:
        if words := each.changed():
            raise ValueError(
                f"{name} reads {words}; what was traced of it keeps the old value: state it again for the new one, or hand the "
                "value over in params."
            )


def _item(holder: Any, key: Any) -> Any:
    try:
        return holder[key]
    except (KeyError, IndexError):
        return ABSENT


def _attribute(value: Any, name: str) -> Any:
    """As it is stored: nothing is computed."""
    own = getattr(value, "__dict__", {})
    if name in own:
        return own[name]
    kinds = value.__mro__ if isinstance(value, type) else type(value).__mro__
    found = next((kind.__dict__[name] for kind in kinds if name in kind.__dict__), ABSENT)
    return getattr(value, name, ABSENT) if isinstance(found, types.MemberDescriptorType) else found


def _to_read(value: Any) -> frozenset[str]:
    """The methods by which an object is read, as a user's class says them."""
    kinds = [kind for kind in type(value).__mro__ if not (_is_of_library(kind) or _is_installed(kind))]
    special = (name for kind in kinds for name in kind.__dict__ if name.startswith("__") and name.endswith("__"))
    return frozenset(special) - NOT_TO_READ


def _written(value: Any) -> bytes:
    """An object as bytes. Raises `ValueError` for one that is large."""
    if sys.getsizeof(value) > COPIED:
        raise ValueError
    return pickle.dumps(value, pickle.HIGHEST_PROTOCOL)


def _with_methods(value: Any, names: frozenset[str]) -> frozenset[str]:
    """The names of attributes, with those that methods among them read."""
    found, new = names, names
    while new:
        methods = (_inner(_attribute(value, name)) for name in new)
        codes = [method.__code__ for method in methods if isinstance(method, types.FunctionType)]
        new = frozenset().union(*(reads(code).others for code in codes)) - found
        found = found | new
    return found


def _inner(value: Any) -> Any:
    """The function that a property, a class method or what `functools.cache` makes of one stands for; else the value itself."""
    if isinstance(value, property):
        return value.fget
    if isinstance(value, functools.cached_property):
        return value.func
    if isinstance(value, classmethod | staticmethod | types.MethodType):
        return value.__func__
    if isinstance(value, functools._lru_cache_wrapper):
        return value.__wrapped__
    return value


def contents(cell: types.CellType) -> Any:
    """What a cell of a closure holds; `ABSENT` for one that is not filled yet."""
    try:
        return cell.cell_contents
    except ValueError:
        return ABSENT


def _is_of_library(value: Any) -> bool:
    file = getattr(value, "__file__", None) or "" if isinstance(value, types.ModuleType) else ""
    known = LIBRARIES | {"builtins"} | ({"dirax"} if isinstance(value, type) else set())
    return _root(value) in known or "site-packages" in file


def _is_installed(kind: type) -> bool:
    """Whether a class is one of an installed package."""
    return "site-packages" in (getattr(sys.modules.get(kind.__module__ or ""), "__file__", None) or "")


def _root(value: Any) -> str:
    """The package of a module, of a class, or of that of an object."""
    if isinstance(value, types.ModuleType):
        return value.__name__.partition(".")[0]
    kind = value if isinstance(value, type) else type(value)
    return (kind.__module__ or "").partition(".")[0]


def _alike(now: Any, before: Any) -> bool:
    """Whether two objects are one value to a function."""
    if isinstance(now, types.FunctionType) and isinstance(before, types.FunctionType):
        return now.__code__ == before.__code__ and _same_values(now, before)
    if isinstance(now, np.ndarray | jax.Array) and isinstance(before, np.ndarray | jax.Array):
        if isinstance(now, Tracer) or isinstance(before, Tracer) or now.dtype != before.dtype or now.shape != before.shape:
            return False
        return np.asarray(now).tobytes() == np.asarray(before).tobytes()
    if type(now) is not type(before):
        return False
    try:
        return bool(now == before) or bool(now != now and before != before)
    except Exception:  # values that have no truth
        return False


def _same_values(one: Callable, other: Callable) -> bool:
    a, b = (Captured(function).watched for function in (one, other))
    return len(a) == len(b) and all(
        x.words == y.words and (x.before is y.before or _alike(x.before, y.before)) for x, y in zip(a, b, strict=True)
    )


def _short(value: Any) -> str:
    text = "gone" if value is ABSENT else repr(value)
    return text if len(text) <= 40 else f"{text[:39]}…"


def functions_in(value: Any) -> Iterator[tuple[str, Captured]]:
    """The functions of systems and schemes with their names, of those inside them too."""
    if isinstance(captured := getattr(value, "captured", None), Captured):
        if captured.watched:
            yield value.name, captured
    elif isinstance(value, eqx.Module):
        for name in value.__dataclass_fields__:
            yield from functions_in(getattr(value, name, None))
    elif isinstance(value, list | tuple):
        for part in value:
            yield from functions_in(part)
