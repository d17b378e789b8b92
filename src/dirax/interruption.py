"""Ctrl-C while the program `dirax` is loaded, before its commands can see to it: exit status 130 and no traceback."""

import os
import signal
import sys
from itertools import pairwise
from typing import Any, NoReturn

INTERRUPTED = 128 + signal.SIGINT
"""The exit status of a program that was interrupted, as shells give it."""


def end(*_: Any) -> NoReturn:
    """Say so and leave at once, as a handler of the signal."""
    os.write(2, b"dirax: interrupted.\n")
    os._exit(INTERRUPTED)


def end_where_program() -> None:
    """Have Ctrl-C end the process from here on where the package is imported as the program; where it is a library of another
    one, and where Ctrl-C is not heard, as in the background, leave it as it is."""
    if _is_program() and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, end)


def _is_program() -> bool:
    """Whether Python was started as `python -m dirax` or by the script `dirax`."""
    own, words = sys.argv[:1], sys.orig_argv
    if own == ["-m"]:  # what Python has there until it has found the module
        return "-mdirax" in words or ("-m", "dirax") in pairwise(words)
    return bool(own) and os.path.basename(own[0]) in ("dirax", "dirax.exe")
