"""The store of a sweep, read from while nobody else has put another one in its place."""

from pathlib import Path
from typing import Any

from zarr.storage import LocalStore

from dirax.solution.zarr_store import NODE


class StoreReplaced(RuntimeError):
    """A store that is read was replaced by another at the same path, whose points stand elsewhere."""


class SameStore(LocalStore):
    """A store that is read only, and only as the one that was there when it was opened: a sweep that grows puts another one in
    its place, with a description that is written once."""

    def __init__(self, root: Path | str, *, read_only: bool = True):
        super().__init__(root, read_only=read_only)
        self._first = _written(self.root)

    def _still(self, found: Any) -> Any:
        """What was found, if it is of the store that was opened."""
        if _written(self.root) != self._first:
            raise StoreReplaced(
                f"{self.root} is no more the store that this Dataset was read from: it has grown since, or was made anew. Take "
                "what the last dx.sweep returned, or dx.load it again; .load() an older one before the sweep goes on to keep it."
            )
        return found

    async def get(self, *key: Any, **how: Any) -> Any:
        """As of any store; raises `StoreReplaced`, as the next two do."""
        return self._still(await super().get(*key, **how))

    def get_sync(self, *key: Any, **how: Any) -> Any:
        """The same."""
        return self._still(super().get_sync(*key, **how))

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
