"""Linear algebra by one thread: several of them spend most of their time waiting for each other where matrices are small."""

import functools
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock
from typing import Any

_lock = Lock()
_inside: list[Any] = []
"""What gives the threads back, for each that is inside: the first one's does."""


@contextmanager
def one_thread() -> Iterator[None]:
    """Within, in any thread, BLAS has one thread; it is the whole process that has."""
    with _lock:
        _inside.append(None if _inside else _libraries("scipy.linalg" in sys.modules).limit(limits=1))
    try:
        yield
    finally:
        with _lock:
            first = _inside[0]
            _inside.pop()
            if not _inside:
                first.restore_original_limits()


@functools.cache
def _libraries(of_scipy: bool) -> Any:
    """The libraries of BLAS that the process has loaded; SciPy brings one of its own."""
    from threadpoolctl import ThreadpoolController  # imported when it is used

    return ThreadpoolController().select(user_api="blas")
