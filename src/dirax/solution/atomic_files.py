"""Files that appear complete or not at all: written beside their place, then moved there."""

import ctypes
import errno
import os
import shutil
import sys
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from glob import escape
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows: leftovers of killed processes stay there
    fcntl = None

LONGEST_NAME = 255
"""Bytes of a file's name."""

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Errors of the system that say that there is no room."""

AT_FDCWD, RENAME_EXCHANGE = -100, 2
"""Of Linux's renameat2: paths count from the folder of the process, and both names stay."""


class Unwritten(OSError):
    """A file that cannot be written, in words."""

    def __str__(self) -> str:
        return str(self.args[-1])


def reason_of(error: OSError) -> str:
    """What the system says against writing."""
    if error.errno in FULL:
        return "there is no space left for it"
    return os.strerror(error.errno) if error.errno else str(error)


@contextmanager
def written(path: str | os.PathLike) -> Iterator[None]:
    """Errors of the system inside the block become one `Unwritten`, which names `path`."""
    try:
        yield
    except Unwritten:
        raise
    except OSError as error:
        way = "free some space, or choose another path" if error.errno in FULL else "choose another path"
        raise Unwritten(error.errno or 0, f"{path} cannot be written ({reason_of(error)}): {way}.") from error


def checked_name(path: Path) -> None:
    """Raise `ValueError` for a path that no file can have."""
    if "\0" in str(path):
        raise ValueError(f"a path cannot have the character of number 0, as {str(path)!r:.80} has: choose another name.")
    if len(os.fsencode(path.name)) > LONGEST_NAME:
        raise ValueError(
            f"the name {path.name[:20]}… has {len(os.fsencode(path.name))} bytes: choose one of at most {LONGEST_NAME}."
        )


def checked_place(path: Path, overwrite: bool, replaceable: Callable[[Path], bool] = Path.is_file) -> None:
    """Raise where nothing could be written to `path`: `ValueError` for a name that is too long, `FileNotFoundError` without
    its folder, `FileExistsError` unless `overwrite`, and for what is not `replaceable`, `Unwritten` for a new file in a folder
    that is read-only."""
    checked_name(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"the folder {path.parent} does not exist: create it before saving {path.name}.")
    if os.path.lexists(path):
        if not overwrite:
            raise FileExistsError(f"{path} exists: pass overwrite=True to replace it, or choose another path.")
        if not replaceable(path):
            kind = f"{path.suffix} file".strip()
            raise FileExistsError(f"{path} exists and is no {kind}, so it is not replaced: choose another path.")
    else:
        checked_folder(path.parent)


def checked_folder(folder: Path) -> None:
    """Raise `Unwritten` for a folder in which no file can be made."""
    if not os.access(folder, os.W_OK | os.X_OK):
        raise Unwritten(errno.EACCES, f"the folder {folder} is read-only here: make it writable, or choose another path.")


def made_folder(folder: Path) -> None:
    """Make a folder, and those that it is in, where they are missing. Raises `Unwritten` for one that cannot be written to."""
    with written(folder):
        folder.mkdir(parents=True, exist_ok=True)
    checked_folder(folder)


def write_text(path: Path, text: str) -> None:
    """A file of text, in UTF-8. Raises `Unwritten`."""
    with written(path):
        path.write_text(text, "utf-8")


@contextmanager
def placed(path: str | os.PathLike, overwrite: bool, replaceable: Callable[[Path], bool] = Path.is_file) -> Iterator[Path]:
    """A path to write a file or a folder to, which is moved to `path` at the end of the block if nothing was raised.

    An older file stays as it was until then. What killed processes have left beside it is removed. Raises as
    `checked_place` does, and `Unwritten` where the system does, such as for a folder that another process has put there
    meanwhile, unless `overwrite`.
    """
    path = Path(path)
    checked_place(path, overwrite, replaceable)
    with written(path), _workshop(path) as workshop:
        new = workshop / f"new{path.suffix}"
        yield new
        _move_into_place(new, path, workshop / f"old{path.suffix}", overwrite)


@contextmanager
def _workshop(path: Path) -> Iterator[Path]:
    """A folder beside `path`, which is removed at the end of the block, and those that killed processes have left."""
    workshop = path.parent / f".{path.stem[:40]}-{uuid.uuid4().hex}"
    clear_leftovers(path)
    workshop.mkdir()
    lock = _locked(workshop)
    try:
        yield workshop
    finally:
        shutil.rmtree(workshop, ignore_errors=True)
        if lock is not None:
            os.close(lock)


def _move_into_place(new: Path, path: Path, old: Path, overwrite: bool) -> None:
    """Files are replaced in one action, and folders where the system can; else a folder is first moved aside, and back if its
    successor cannot be moved in."""
    if not (path.is_dir() and overwrite):
        os.replace(new, path)
        return
    if _exchanged(new, path):
        return
    os.rename(path, old)
    try:
        os.rename(new, path)
    except BaseException:
        os.rename(old, path)
        raise


def _exchanged(a: Path, b: Path) -> bool:
    """Have two names change places in one action (Linux, most file systems); False where that cannot be."""
    if not sys.platform.startswith("linux"):
        return False
    rename = getattr(ctypes.CDLL(None), "renameat2", None)
    return rename is not None and rename(AT_FDCWD, os.fsencode(a), AT_FDCWD, os.fsencode(b), RENAME_EXCHANGE) == 0


def _locked(folder: Path) -> int | None:
    """The descriptor of a folder that is locked until it is closed or its process ends; None if another holds it."""
    if fcntl is None:
        return None
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        return None
    return descriptor


def clear_leftovers(path: Path) -> None:
    """Remove what processes that were killed have left beside `path`; an older folder that was moved aside is put back."""
    for left in path.parent.glob(f".{escape(path.stem[:40])}-{'[0-9a-f]' * 32}"):
        with suppress(OSError):
            lock = _locked(left) if left.is_dir() and not left.is_symlink() else None
            if lock is None:
                continue
            old = left / f"old{path.suffix}"
            if old.exists() and not os.path.lexists(path):
                os.rename(old, path)
            shutil.rmtree(left, ignore_errors=True)
            os.close(lock)
