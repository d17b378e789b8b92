"""Blocks of a task into the store: files appear whole, flushed to the disk, and that of `status` after all others."""

import os
import uuid
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from dirax.solution.flushed_files import UNFINISHED, flushed, writing
from dirax.solution.sweep_store import MESSAGE, STATUS
from dirax.sweeps.grid import Index
from dirax.sweeps.layout import Layout


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
