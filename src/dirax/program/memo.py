"""What dirax keeps of what it has made: traced functions, programs, kernels, step equations. All of it can be let go.

A key is made of values where equal values mean the same (functions, frozen systems, shapes), and of `Same(object)` where
only the object itself does.
"""

import gc
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from threading import Lock
from typing import Any, Generic, TypeVar

Made = TypeVar("Made")

PATIENCE = 200_000
"""New objects after which Python looks for garbage while something is made that is kept: jaxprs and graphs are many objects that
stay, and looking through them again and again takes a tenth to a sixth of a first call (heavy top .20 instead of .22 s,
spherical pendulums .55 instead of .65 s), and of a first `verify` up to a sixth (bicycle)."""

_clear: list[Callable[[], Any]] = []
_patient: list[tuple[int, int, int]] = []
_patience_lock = Lock()


@contextmanager
def patience() -> Iterator[None]:
    """Within, in any thread, Python looks for garbage less often; it is the whole process that does."""
    with _patience_lock:
        before = gc.get_threshold()
        _patient.append(before)
        if len(_patient) == 1 and before[0]:  # 0: it does not look at all
            gc.set_threshold(max(before[0], PATIENCE), *before[1:])
    try:
        yield
    finally:
        with _patience_lock:
            first = _patient[0]
            _patient.pop()
            if not _patient:
                gc.set_threshold(*first)


class Same:
    """An object as part of a key: equal to itself alone, and kept alive by the key so that it stays so."""

    __slots__ = ("object",)

    def __init__(self, object: Any):
        self.object = object

    def __eq__(self, other: Any) -> bool:
        return isinstance(other, Same) and self.object is other.object

    def __hash__(self) -> int:
        return id(self.object)


class OfKey:
    """Compared by its `key`, with others of its class."""

    key: tuple

    def __eq__(self, other: object) -> bool:
        return isinstance(other, type(self)) and self.key == other.key

    def __hash__(self) -> int:
        return hash(self.key)


def by_value(object: Any) -> Hashable:
    """An object as part of a key, equal to those of the same value where these have a hash; else to itself alone."""
    try:
        hash(object)
    except TypeError:
        return Same(object)
    return object


class Memo(Generic[Made]):
    """The `size` things that were used last, by their keys."""

    def __init__(self, size: int):
        self.size = size
        self._made: OrderedDict[Hashable, Made] = OrderedDict()
        self._lock = Lock()
        when_cleared(self.clear)

    def get(self, key: Hashable, make: Callable[[], Made]) -> Made:
        """What was made for an equal key, else what `make` makes now; always the latter for a key that has no hash."""
        try:
            hash(key)
        except TypeError:  # an object that holds arrays
            return make()
        with self._lock:
            if key in self._made:
                self._made.move_to_end(key)
                return self._made[key]
        with patience():
            made = make()
        with self._lock:
            made = self._made.setdefault(key, made)  # another thread may have been quicker
            if len(self._made) > self.size:
                self._made.popitem(last=False)
        return made

    def __contains__(self, key: Hashable) -> bool:
        return key in self._made

    def __len__(self) -> int:
        return len(self._made)

    def clear(self) -> None:
        """Let go of everything."""
        with self._lock:
            self._made.clear()


def when_cleared(clear: Callable[[], Any]) -> None:
    """Have `clear_caches` call `clear` too, which lets go of what is kept elsewhere: in a jitted function of a module."""
    _clear.append(clear)


def clear_caches() -> None:
    """Let go of every system, traced function and compiled kernel that dirax keeps in memory for later calls.

    Runs after it work as before; the first is as slow as a first one. Kernels on the disk stay.
    """
    for clear in _clear:
        clear()
