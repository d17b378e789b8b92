"""What XLA has to say of how long it takes to compile goes to nobody's terminal: `stats` say it.

XLA writes such alarms to the file of standard errors, from a thread of its own, whatever Python does with `sys.stderr`. Its log
has one level for the whole process, which is raised while functions of dirax are compiled and run, and set back then.
"""

import importlib
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import jax

FATAL = 3
"""The level above that of alarms, which are errors to XLA."""

LEVELS = {"DEBUG": 0, "INFO": 0, "WARN": 1, "WARNING": 1, "ERROR": 2, "CRITICAL": 3, "FATAL": 3}
"""Those of `jax_logging_level`."""

_set_level: Any = None
with suppress(ImportError, AttributeError):  # it is not of the public interface of JAX
    _set_level = importlib.import_module("jaxlib.utils").absl_set_min_log_level

_lock = threading.Lock()
_inside = 0


@contextmanager
def without_alarms() -> Iterator[None]:
    """XLA writes nothing to the standard errors inside, unless it ends the process."""
    _enter(1)
    try:
        yield
    finally:
        _enter(-1)


def _enter(change: int) -> None:
    global _inside
    with _lock:
        before, _inside = _inside, _inside + change
        if _set_level is not None and not before * _inside:
            _set_level(FATAL if _inside else _level())


def _level() -> int:
    """The level that JAX has been given."""
    named = getattr(jax.config, "jax_logging_level", None)
    if named in LEVELS:
        return LEVELS[named]
    chosen = os.environ.get("TF_CPP_MIN_LOG_LEVEL", "")
    return int(chosen) if chosen.isdigit() else 0
