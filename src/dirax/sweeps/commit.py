"""Blocks of a task into the store: files appear whole, flushed to the disk, and that of `status` after all others."""

import contextlib
import errno
import os
import uuid
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from dirax.sweeps.grid import Index
from dirax.sweeps.layout import MESSAGE, STATUS, Layout

UNFINISHED = ".unfinished"
"""The folder in a store where files are written before they are moved into place; it is there while a sweep runs."""


class StoreError(OSError):
    """A store that cannot be written, in words."""

    def __str__(self) -> str:
        return str(self.args[-1])


@contextlib.contextmanager
def writing(folder: Path) -> Iterator[None]:
    """Errors of the system inside the block become one `StoreError`."""
    try:
        yield
    except StoreError:
        raise
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            reason, way = "there is no space left for it", "free some space, then"
        else:
            reason, way = error.strerror or str(error), "mend this, then"
        raise StoreError(
            error.errno or 0,
            f"the store {folder} cannot be written ({reason}). What was finished is kept: {way} the same call again goes on",
        ) from error


def commit(folder: Path, layout: Layout, index: Index, blocks: Mapping[str, np.ndarray]) -> None:
    """Write the blocks of a task, `status` last. Raises `StoreError`; the store is then as it was, or has some more of the
    numbers that belong there."""
    with writing(folder):
        bench, own = folder / UNFINISHED, uuid.uuid4().hex
        beside = {
            name: bench / f"{own}-{name}" for name in layout.arrays if not _empty(folder, layout, name, index, blocks[name])
        }
        try:
            for name in beside.keys() - {STATUS}:
                flushed(beside[name], layout.encoded(name, blocks[name]))
                os.replace(beside[name], folder / layout.file(name, index))
            # a file system with a journal has the names above on the disk when this file is
            flushed(beside[STATUS], layout.encoded(STATUS, blocks[STATUS]))
            os.replace(beside[STATUS], folder / layout.file(STATUS, index))
        except BaseException:
            for path in beside.values():
                path.unlink(missing_ok=True)
            raise


def _empty(folder: Path, layout: Layout, name: str, index: Index, block: np.ndarray) -> bool:
    """Whether a block of texts need not be written, since there are none."""
    return name == MESSAGE and not any(block.ravel().tolist()) and not (folder / layout.file(name, index)).exists()


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
