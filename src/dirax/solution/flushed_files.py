"""Stores that are written while something runs: files that are on the disk when they appear, and one writer at a time."""

import contextlib
import errno
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from dirax.solution.atomic_files import FULL, Unwritten, reason_of
from dirax.solution.zarr_store import NODE

try:
    import fcntl
except ImportError:  # Windows: nothing is locked
    fcntl = None

UNFINISHED = ".unfinished"
"""The folder in a store where files are written before they are moved into place; it is there while a call fills the store."""

LOCK = "lock"
"""The file, among the unfinished ones, that the caller holds who fills a store."""


class StoreError(Unwritten):
    """A store that cannot be written, in words."""


@contextlib.contextmanager
def writing(folder: Path) -> Iterator[None]:
    """Errors of the system inside the block become one `StoreError`."""
    try:
        yield
    except StoreError:
        raise
    except OSError as error:
        if error.errno == errno.ENOENT and not (folder / NODE).exists():
            what = f"the store {folder} was removed or moved while it was written: the same call again begins anew"
            raise StoreError(error.errno, what) from error
        way = "free some space, then" if error.errno in FULL else "mend this, then"
        what = f"the store {folder} cannot be written ({reason_of(error)}). What was finished is kept"
        raise StoreError(error.errno or 0, f"{what}: {way} the same call again goes on") from error


def flushed(path: Path, data: bytes) -> None:
    """Write a file that is on the disk afterwards."""
    with open(path, "wb", buffering=0) as file:
        view = memoryview(data).cast("B") if len(data) else memoryview(b"")
        while len(view):
            view = view[file.write(view) :]
        os.fsync(file.fileno())


def flush_folder(folder: Path) -> None:
    """Have the names in a folder on the disk, where the system does that."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


class Hold:
    """The lock of a store: held from its making, or from the first look at it, until the end of the call or of the process."""

    def __init__(self) -> None:
        self._descriptors: list[int] = []

    def take(self, folder: Path) -> bool:
        """Lock a store, and remove what processes left there that were killed; False where another caller holds it."""
        lock = folder / UNFINISHED / LOCK
        while True:
            lock.parent.mkdir(exist_ok=True)
            try:
                descriptor = os.open(lock, os.O_RDWR | os.O_CREAT, 0o644)
            except FileNotFoundError:  # a caller that has ended took the folder away
                continue
            if not _locked(descriptor):
                os.close(descriptor)
                return False
            self._descriptors.append(descriptor)
            with contextlib.suppress(FileNotFoundError):
                if os.fstat(descriptor).st_ino == lock.stat().st_ino:
                    _clear(folder)
                    return True

    def release(self, folder: Path) -> None:
        """Let others fill the store, with no unfinished file in it; nothing where it is not held."""
        if self._descriptors:
            shutil.rmtree(folder / UNFINISHED, ignore_errors=True)
        while self._descriptors:
            os.close(self._descriptors.pop())


def _locked(descriptor: int) -> bool:
    if fcntl is None:
        return True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return True
    return True


def _clear(folder: Path) -> None:
    for left in (folder / UNFINISHED).iterdir():
        if left.name != LOCK:
            left.unlink(missing_ok=True)


def taken(path: Path, hold: Hold) -> None:
    """Have this call hold a store. Raises `StoreError` for one that cannot be written, or that another call fills."""
    if not os.access(path, os.W_OK):
        raise StoreError(f"the store {path} cannot be written (it is read-only here): make it writable, or choose another path.")
    try:
        mine = hold.take(path)
    except OSError as error:
        raise StoreError(f"the store {path} cannot be written ({error.strerror}): choose another path.") from error
    if not mine:
        raise StoreError(
            f"another call is filling the store {path} at this moment: wait until it has ended, or stop it; then the same call "
            "again goes on from there."
        )


def refuse_more_than_disk(path: Path, wanted: int, way: str) -> None:
    """Raise `StoreError` for a store of so many bytes more than its disk has room for; `way`: what saves some of them."""
    free = shutil.disk_usage(path.parent).free
    if wanted > free:
        raise StoreError(
            f"the store {path} would take {wanted / 2**30:.3g} GiB, and {free / 2**30:.3g} GiB of the disk are free: {way}, or "
            "choose another disk for to=."
        )
