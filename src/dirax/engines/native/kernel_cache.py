"""Compiled kernels on the disk: signed with a key of the user's own, at most so many, those used longest ago leave first.

An entry is 32 bytes of HMAC-SHA256 of its name and its content under the key in the file `.key`; 8 bytes of the number of
operations of a step; object code. What is not as it should be is a miss, and the kernel is compiled anew.
"""

import contextlib
import hashlib
import hmac
import os
import re
import secrets
import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from dirax.engines.native.private_folder import (
    POSIX,
    UNFINISHED,
    NotPrivate,
    private_folder,
    read_private,
    remove,
    write_private,
)

MEGABYTES, FILES = 200, 4096
"""Largest size of the cache, unless DIRAX_CACHE_MEGABYTES and DIRAX_CACHE_FILES say otherwise."""

ABANDONED = 3600
"""Seconds after which a file that is still being written belongs to a process that was killed."""

KEY = ".key"
DIGEST, COUNT = 32, 8
ENTRY = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True)
class Kernel:
    """Object code, and the number of scalar operations of a step in it."""

    operations: int
    code: bytes


@dataclass(frozen=True)
class Contents:
    """How many kernels are kept and how large they are, in bytes."""

    files: int
    size: int


def cache_folder() -> Path | None:
    """Where compiled kernels are kept: DIRAX_CACHE, else the user's cache folder; None when DIRAX_CACHE is "off", and where
    the system does not say whose a file is."""
    chosen = os.environ.get("DIRAX_CACHE")
    if not POSIX or (chosen is not None and chosen.lower() in ("off", "0", "")):
        return None
    if chosen is not None:
        return Path(chosen) / "kernels"
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "dirax" / "kernels"


def limits() -> Contents:
    """The most that is kept. Raises `ValueError` for settings that are no whole numbers."""
    return Contents(_setting("DIRAX_CACHE_FILES", FILES), 1_000_000 * _setting("DIRAX_CACHE_MEGABYTES", MEGABYTES))


def _setting(name: str, default: int) -> int:
    text = os.environ.get(name, "").strip()
    if not re.fullmatch(r"\d{0,12}", text, re.ASCII):
        raise ValueError(f"the environment variable {name} must be a whole number of at least 0, but {text!r} was given.")
    return int(text) if text else default


def name_of(*parts: object) -> str:
    """The name of the entry of code that these parts determine."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(repr(part).encode() + b"\0")
    return digest.hexdigest()


def read(name: str) -> Kernel | None:
    """The kernel kept under a name; None if there is none, with a `RuntimeWarning` where somebody else may have put it there."""
    path = cache_folder()
    if path is None:
        return None
    try:
        with private_folder(path) as folder:
            key, stored = read_private(folder, KEY, DIGEST), read_private(folder, name, limits().size)
            kernel = None if key is None or stored is None else _opened(key, name, stored)
            if kernel is not None:
                with contextlib.suppress(OSError):  # it may have been let go since, or the disk take no changes
                    os.utime(name, dir_fd=folder, follow_symlinks=False)
            return kernel
    except NotPrivate as reason:
        _note(path, reason)
    except OSError:
        pass
    return None


def write(name: str, kernel: Kernel) -> None:
    """Keep a kernel, and let those go that were used longest ago if there are too many; a folder that cannot be written is no
    error."""
    path, most = cache_folder(), limits()
    content = kernel.operations.to_bytes(COUNT, "little") + kernel.code
    if path is None or most.files == 0 or DIGEST + len(content) > most.size:
        return
    try:
        with private_folder(path, make=True) as folder:
            key = _key(folder)
            if key is not None:
                write_private(folder, name, _signature(key, name, content) + content)
                left = _room.get((path, most), Contents(0, 0))
                left = Contents(left.files - 1, left.size - DIGEST - len(content))
                _room[path, most] = left if min(left.files, left.size) >= 0 else _let_go(folder, most)
    except NotPrivate as reason:
        _note(path, reason)
    except OSError:
        return


def contents() -> Contents:
    """What the cache holds. Raises `OSError` where it cannot be read."""
    path = cache_folder()
    try:
        if path is not None:
            with private_folder(path) as folder:
                sizes = [size for _, size, _ in _entries(folder)]
                return Contents(len(sizes), sum(sizes))
    except FileNotFoundError:
        pass
    except NotPrivate as reason:
        raise PermissionError(f"the kernel cache is not used: {reason}.") from None
    return Contents(0, 0)


def clear() -> Contents:
    """Remove all kernels, the key and what was left unfinished; what was removed. Raises `OSError` where that cannot be."""
    path, before = cache_folder(), contents()
    if path is None or not path.exists():
        return before
    with private_folder(path) as folder:
        for name in os.listdir(folder):
            if ENTRY.fullmatch(name) or name == KEY or name.endswith(UNFINISHED):
                remove(folder, name)
    after = contents()
    return Contents(before.files - after.files, before.size - after.size)


def _opened(key: bytes, name: str, stored: bytes) -> Kernel | None:
    """What an entry holds, if it is whole and signed."""
    signature, content = stored[:DIGEST], stored[DIGEST:]
    if len(content) < COUNT or not hmac.compare_digest(signature, _signature(key, name, content)):
        return None
    return Kernel(int.from_bytes(content[:COUNT], "little"), content[COUNT:])


def _signature(key: bytes, name: str, content: bytes) -> bytes:
    return hmac.digest(key, name.encode() + b"\0" + content, "sha256")


def _key(folder: int) -> bytes | None:
    """The user's own key, made if there is none; of several processes that make one, the first one's holds."""
    try:
        known = read_private(folder, KEY, DIGEST)
        doubtful = known is not None and len(known) != DIGEST
    except NotPrivate:
        known, doubtful = None, True
    if known is None or doubtful:
        write_private(folder, KEY, secrets.token_bytes(DIGEST), replace=doubtful)
        known = read_private(folder, KEY, DIGEST)
    return known


def _entries(folder: int) -> Iterator[tuple[int, int, str]]:
    """(time of last use in ns, bytes, name) of all entries."""
    with os.scandir(folder) as found:
        for entry in found:
            if ENTRY.fullmatch(entry.name) or entry.name.endswith(UNFINISHED):
                try:
                    status = entry.stat(follow_symlinks=False)
                except FileNotFoundError:  # another process let it go
                    continue
                if ENTRY.fullmatch(entry.name):
                    yield status.st_mtime_ns, status.st_size, entry.name
                elif status.st_mtime < time.time() - ABANDONED:
                    remove(folder, entry.name)


_room: dict[tuple[Path, Contents], Contents] = {}
"""What this process may write into a folder with its limits before it looks again at all that is there, which takes longer than
to compile a small kernel."""


def _let_go(folder: int, most: Contents) -> Contents:
    """Where there is more than the most, let those go that were used longest ago, and a sixteenth of it besides. What may be
    written before that is looked at again: a quarter of the room that is left, for there may be other processes."""
    entries = sorted(_entries(folder))
    files, size = len(entries), sum(bytes_ for _, bytes_, _ in entries)
    if files > most.files or size > most.size:
        for _, bytes_, name in entries:
            if files <= most.files - most.files // 16 and size <= most.size - most.size // 16:
                break
            if remove(folder, name):
                files, size = files - 1, size - bytes_
    return Contents((most.files - files) // 4, (most.size - size) // 4)


def _note(path: Path, reason: NotPrivate) -> None:
    warnings.warn(
        f"the kernel cache in {path} is passed over, and the kernel compiled anew: {reason}. `dirax cache --clear` empties it; "
        "the environment variable DIRAX_CACHE names another folder.",
        RuntimeWarning,
        stacklevel=3,
    )
