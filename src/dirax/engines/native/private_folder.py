"""A folder and files that only this user can have written: what is executed later is read from nowhere else.

Every access goes through a descriptor of the folder and one of the file, and it is these that are checked, so that nothing can
be exchanged between the check and the reading.
"""

import contextlib
import errno
import os
import secrets
import stat
from collections.abc import Iterator
from pathlib import Path

POSIX = hasattr(os, "geteuid") and os.open in os.supports_dir_fd
"""Whether this system says whose a file is, and who may write it."""

READ = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_NONBLOCK", 0) | os.O_RDONLY
"""Links are not followed, and pipes not waited for."""

WRITE = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0) | os.O_WRONLY | os.O_CREAT | os.O_EXCL
UNFINISHED = ".unfinished"
"""How the names of files end that are being written."""


class NotPrivate(Exception):
    """A folder or a file that somebody else may have written: the message says which, and why."""


@contextlib.contextmanager
def private_folder(path: Path, make: bool = False) -> Iterator[int]:
    """A descriptor of a folder of this user, of mode 0700 whatever the umask is; missing parents are made alike.

    Raises `NotPrivate` for a folder of somebody else and for what is no folder, `OSError` where there is none.
    """
    if make:
        _made(path)
    try:
        handle = os.open(path, READ | getattr(os, "O_DIRECTORY", 0))
    except OSError as error:
        if error.errno in (errno.ENOTDIR, errno.ELOOP) and os.path.lexists(path):
            raise NotPrivate(f"{path} is no folder but a file or a symbolic link") from None
        raise
    try:
        found = os.fstat(handle)
        if found.st_uid != os.geteuid():
            raise NotPrivate(f"the folder {path} belongs to another user")
        if stat.S_IMODE(found.st_mode) != 0o700:
            os.fchmod(handle, 0o700)
        yield handle
    finally:
        os.close(handle)


def _made(path: Path) -> None:
    if os.path.lexists(path):
        return
    _made(path.parent)
    with contextlib.suppress(FileExistsError):
        path.mkdir(mode=0o700)
        path.chmod(0o700)  # the umask may have taken from it what its owner needs


def read_private(folder: int, name: str, most: int) -> bytes | None:
    """The content of a file of the folder; None where there is none, or one of more than `most` bytes.

    Raises `NotPrivate` for what is not a regular file of this user that nobody else may read or write, and does not wait.
    """
    try:
        handle = os.open(name, READ, dir_fd=folder)
    except FileNotFoundError:
        return None
    except OSError as error:
        what = "is a symbolic link" if error.errno == errno.ELOOP else f"cannot be opened ({error.strerror})"
        raise NotPrivate(f"{name} {what}") from None
    try:
        found = os.fstat(handle)
        if not stat.S_ISREG(found.st_mode):
            raise NotPrivate(f"{name} is no regular file")
        if found.st_uid != os.geteuid():
            raise NotPrivate(f"{name} belongs to another user")
        if stat.S_IMODE(found.st_mode) & 0o077:
            raise NotPrivate(f"{name} may be read or written by others (mode {stat.S_IMODE(found.st_mode):o})")
        with open(handle, "rb", closefd=False) as file:
            content = file.read(most + 1) if found.st_size <= most else None
    finally:
        os.close(handle)
    return content if content is not None and len(content) <= most else None


def write_private(folder: int, name: str, content: bytes, replace: bool = True) -> None:
    """Make a file of mode 0600 of the folder, all at once; one that is there stays if `replace` is False."""
    draft = f"{name[:16]}-{secrets.token_hex(8)}{UNFINISHED}"
    handle = os.open(draft, WRITE, 0o600, dir_fd=folder)
    try:
        with os.fdopen(handle, "wb") as file:
            os.fchmod(handle, 0o600)
            file.write(content)
        if replace:
            os.replace(draft, name, src_dir_fd=folder, dst_dir_fd=folder)
        else:
            with contextlib.suppress(FileExistsError):
                os.link(draft, name, src_dir_fd=folder, dst_dir_fd=folder)
    finally:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(draft, dir_fd=folder)


def remove(folder: int, name: str) -> bool:
    """Remove a file of the folder, or what is empty in its place; whether that was possible."""
    try:
        os.unlink(name, dir_fd=folder)
    except OSError:
        try:
            os.rmdir(name, dir_fd=folder)
        except OSError:
            return False
    return True
