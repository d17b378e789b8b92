"""What a user's function reads from outside of its arguments: the values that it had when it was stated.

JAX traces a function once, and what was traced keeps the values of then. A global that was changed since, a field of an object
or an entry of an array would be seen by no later run, so that runs ask whether they are what they were.
"""

import dis
import functools
import sys
import types
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer

DEEPEST, MOST, MOST_BYTES = 6, 400, 2**20
"""How far values are followed, how many are watched, and how large an array is whose entries are compared."""

LIBRARIES = {"jax", "jaxlib", "numpy", "scipy", "equinox", "jaxtyping", "optax", *sys.stdlib_module_names} - {"__main__"}
"""Packages whose functions and modules are taken not to change."""

ABSENT = object()

PLAIN = (bool, int, float, complex, str, bytes, type(None), np.generic)


class Reads(NamedTuple):
    """The names that code reads as globals and as attributes, those that it sets, and whether it changes what it reads."""

    globals: frozenset[str]
    attributes: frozenset[str]
    own: frozenset[str]
    writes: bool


@functools.lru_cache(maxsize=1024)
def reads(code: types.CodeType) -> Reads:
    """Of code and of the functions inside it."""
    names: dict[str, set[str]] = {"LOAD_GLOBAL": set(), "LOAD_ATTR": set(), "STORE": set()}
    writes = False
    for i in dis.get_instructions(code):
        kind = {"LOAD_NAME": "LOAD_GLOBAL", "LOAD_METHOD": "LOAD_ATTR", "STORE_GLOBAL": "STORE", "STORE_DEREF": "STORE"}
        if (place := kind.get(i.opname, i.opname)) in names:
            names[place].add(i.argval)
        writes = writes or i.opname in ("STORE_SUBSCR", "STORE_ATTR", "DELETE_SUBSCR")
    inner = [reads(c) for c in code.co_consts if isinstance(c, types.CodeType)]
    read, attributes, own = (
        frozenset(own).union(*(getattr(r, name) for r in inner)) for own, name in zip(names.values(), Reads._fields, strict=False)
    )
    return Reads(read, attributes, own, writes or any(r.writes for r in inner))


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
        if isinstance(value, np.ndarray):
            if value.nbytes <= MOST_BYTES and value.dtype != object:
                self.watched.append(Watched(f"the array {words}", lambda: value, value.copy()))
        elif isinstance(value, functools.partial):
            for part in (value.func, *value.args, *value.keywords.values()):
                self._follow(part, words, names, depth + 1)
        elif isinstance(value, types.MethodType):
            self._follow(value.__func__, words, names, depth + 1)
            own = getattr(value.__func__, "__code__", None)
            self._follow(value.__self__, words or "self", names | reads(own).attributes if own else names, depth + 1)
        elif isinstance(value, types.FunctionType):
            self._follow_function(value, depth)
        elif isinstance(value, Mapping):
            for key in [*value][:MOST]:
                self._watch(f"{words}[{key!r}]", functools.partial(_item, value, key), names, depth)
        elif isinstance(value, list | tuple):
            for i in range(min(len(value), MOST)):
                self._watch(f"{words}[{i}]", functools.partial(_item, value, i), names, depth)
        elif hasattr(value, "__dict__") and not _is_of_library(value):
            names = _with_methods(value, names | {"__call__"} if callable(value) and not isinstance(value, type) else names)
            for name in sorted(names if not isinstance(value, eqx.Module) else value.__dict__.keys()):
                self._watch(f"{words}.{name}" if words else name, functools.partial(_attribute, value, name), names, depth)

    def _follow_function(self, function: types.FunctionType, depth: int) -> None:
        root = (function.__module__ or "").partition(".")[0]
        if root in LIBRARIES:
            return
        found = reads(function.__code__)
        if found.writes:  # it keeps a record of its own in what it reads
            return
        for part in (*(function.__defaults__ or ()), *(function.__kwdefaults__ or {}).values()):
            self._follow(part, "a default", found.attributes, depth + 1)
        for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
            if name not in found.own:
                self._watch(name, functools.partial(contents, cell), found.attributes, depth)
        if root != "dirax":
            for name in sorted(found.globals - found.own):
                if name in function.__globals__:
                    self._watch(name, functools.partial(_item, function.__globals__, name), found.attributes, depth)


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
    if name in value.__dict__:
        return value.__dict__[name]
    kinds = value.__mro__ if isinstance(value, type) else type(value).__mro__
    return next((kind.__dict__[name] for kind in kinds if name in kind.__dict__), ABSENT)


def _with_methods(value: Any, names: frozenset[str]) -> frozenset[str]:
    """The names of attributes, with those that methods among them read."""
    found, new = names, names
    while new:
        codes = [getattr(_attribute(value, name), "__code__", None) for name in new]
        new = frozenset().union(*(reads(code).attributes for code in codes if code)) - found
        found = found | new
    return found


def contents(cell: types.CellType) -> Any:
    """What a cell of a closure holds; `ABSENT` for one that is not filled yet."""
    try:
        return cell.cell_contents
    except ValueError:
        return ABSENT


def _is_of_library(value: Any) -> bool:
    if isinstance(value, type):
        return (value.__module__ or "").partition(".")[0] in LIBRARIES | {"dirax"}
    name = value.__name__ if isinstance(value, types.ModuleType) else type(value).__module__ or ""
    file = getattr(value, "__file__", None) or "" if isinstance(value, types.ModuleType) else ""
    return name.partition(".")[0] in LIBRARIES or "site-packages" in file


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
