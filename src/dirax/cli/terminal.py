"""What the program expects of the terminal, and what it does where that is not so: pipes that close, signs that an encoding
lacks, Ctrl-C."""

import codecs
import io
import os
import signal
import sys
import threading
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from dirax.interruption import INTERRUPTED
from dirax.interruption import end as end_now

SIMPLER = {"─": "-", "–": "-", "—": "-", "−": "-", "…": "...", "’": "'", "≤": "<=", "≥": ">=", "·": "."}
"""What takes the place of signs that an encoding lacks; Greek letters are written out, others lose their accents."""

AGAIN = 0.01
"""Seconds after which an interruption is tried again that no caller could hear of."""


@contextmanager
def interruptible() -> Iterator[None]:
    """After Ctrl-C inside the block the exit status is INTERRUPTED, whatever became of the interruption, and there is no
    traceback; after the block, and while a module is imported, Ctrl-C ends the process at once."""
    # another handler, such as in the background: nothing is heard
    if signal.getsignal(signal.SIGINT) not in (signal.default_int_handler, end_now):
        yield
        return
    heard = False

    def interrupt(_: int, frame: FrameType | None) -> None:
        nonlocal heard
        heard = True
        if _imports(frame):  # a compiled module that is interrupted while it is loaded crashes
            end_now()
        raise KeyboardInterrupt

    def unheard(lost: Any) -> None:
        """Python drops what is raised while it collects garbage: an interruption is sent again, when that has ended."""
        if heard and issubclass(lost.exc_type, KeyboardInterrupt):
            threading.Timer(AGAIN, os.kill, (os.getpid(), signal.SIGINT)).start()
        else:
            said(lost)

    said, sys.unraisablehook = sys.unraisablehook, unheard
    signal.signal(signal.SIGINT, interrupt)
    try:
        yield
    except BaseException as end:  # an import that is interrupted ends in an ImportError, a command in a SystemExit
        if not heard:
            raise
        if not isinstance(end, SystemExit):
            print("dirax: interrupted.", file=sys.stderr)
        raise SystemExit(INTERRUPTED) from None
    finally:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        sys.unraisablehook = said


def _imports(frame: FrameType | None) -> bool:
    """Whether a module is being imported where the program is."""
    while frame is not None and not frame.f_code.co_filename.startswith("<frozen importlib"):
        frame = frame.f_back
    return frame is not None


def prepared() -> None:
    """Make the streams fit: a reader that closes its pipe ends the program as it ends others, and no sign is an error.

    Raises `SystemExit` where there is no standard output.
    """
    if hasattr(signal, "SIGPIPE"):
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    codecs.register_error("dirax.simpler", _simpler)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="dirax.simpler")
    if sys.stdout is None:
        raise SystemExit("dirax: standard output is closed, so that no result could be shown: redirect it, to /dev/null say.")


@contextmanager
def written() -> Iterator[None]:
    """What the block prints is written out at its end; one sentence and status 1 where that fails, as on a full disk."""
    try:
        try:
            yield
        finally:
            sys.stdout.flush()
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes once more at its end
        raise SystemExit(f"dirax: the results could not be written: {error.strerror}.") from None


def _simpler(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return "".join(map(_simple, error.object[error.start : error.end])), error.end


def _simple(sign: str) -> str:
    if sign in SIMPLER:
        return SIMPLER[sign]
    name = unicodedata.name(sign, "")
    if name.startswith("GREEK"):
        return name.rpartition("LETTER ")[2].partition(" ")[0].lower()
    return unicodedata.normalize("NFKD", sign).encode("ascii", "ignore").decode() or "?"
