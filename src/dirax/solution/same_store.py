"""The store of a sweep, read from while nobody else has put another one in its place."""

from collections.abc import Collection
from pathlib import Path
from typing import Any

from zarr.storage import LocalStore

from dirax.solution.zarr_store import NODE


class StoreReplaced(RuntimeError):
    """A store that is read was replaced by another at the same path, whose points stand elsewhere."""


class SameStore(LocalStore):
    """A store that is read only, and only as the one that was there when it was opened: a sweep that grows puts another one in
    its place, with a description that is written once."""

    def __init__(self, root: Path | str, axes: int, blocks: Collection[str], status: str, *, read_only: bool = True):
        """`blocks`: arrays of which a block is there once that of `status` is, which has so many `axes`."""
        super().__init__(root, read_only=read_only)
        self._first, self._of_blocks = _written(self.root), (axes, blocks, status)

    def with_read_only(self, read_only: bool = False) -> "SameStore":
        """The same, read only or not."""
        return SameStore(self.root, *self._of_blocks, read_only=read_only)

    def _still(self, found: Any) -> Any:
        """What was found, if it is of the store that was opened."""
        if _written(self.root) != self._first:
            raise StoreReplaced(
                f"{self.root} is no more the store that this Dataset was read from: it has grown since, or was made anew. Take "
                "what the last dx.sweep returned, or dx.load it again; .load() an older one before the sweep goes on to keep it."
            )
        return found

    def _whole(self, key: str, found: Any) -> Any:
        """The same of a block; None for one that is not there yet. What says that points are finished is written last."""
        self._still(found)
        (name, _, numbers), (axes, blocks, status_name) = key.partition("/c."), self._of_blocks
        if found is not None or name not in blocks or not numbers:
            return found
        status = self.root / f"{status_name}/c.{'.'.join(numbers.split('.')[:axes])}"
        if status.exists() and not (self.root / key).exists():
            raise RuntimeError(
                f"{self.root / key} is gone, which the finished points of {name} are in: delete {status}, and the same call of "
                "dx.sweep computes them again."
            )
        return found

    async def get(self, key: str, *given: Any, **how: Any) -> Any:
        """As of any store; raises `StoreReplaced`, as the next two do."""
        return self._whole(key, await super().get(key, *given, **how))

    def get_sync(self, key: str, *given: Any, **how: Any) -> Any:
        """The same."""
        return self._whole(key, super().get_sync(key, *given, **how))

    async def get_partial_values(self, *keys: Any, **how: Any) -> Any:
        """The same of parts."""
        return self._still(await super().get_partial_values(*keys, **how))


def _written(root: Path) -> tuple[int, ...] | None:
    """Which file the description of a store is; None where there is none."""
    try:
        status = (root / NODE).stat()
    except OSError:
        return None
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns
