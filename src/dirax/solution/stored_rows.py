"""Saved rows on the disk as an array: what is indexed is read, and nothing else."""

from pathlib import Path
from typing import Any

import numpy as np

from dirax.solution.stored import Unreadable, checksum, plain_bytes
from dirax.solution.zarr_store import chunk_file


class StoredRows(np.lib.mixins.NDArrayOperatorsMixin):
    """An array (rows, …) of a store, or (B, rows, …), whose rows are read when it is indexed: `sol.q[i]`, `sol.q[i:j, 5]`.

    `shape`, `dtype`, `ndim`, `size`, `nbytes` and `len` read nothing. Everything else that NumPy's arrays have, and functions of
    NumPy, read all of it. Raises `ValueError` where a file is missing or is not what was written.
    """

    dtype = np.dtype(np.float64)

    def __init__(self, folder: Path, shape: tuple[int, ...], chunk: int, sums: list[list[int]], axis: int):
        self.folder, self.shape, self.chunk, self.sums, self.axis = folder, shape, chunk, sums, axis
        self._last: tuple[int, np.ndarray] | None = None

    @property
    def ndim(self) -> int:
        """Number of axes."""
        return len(self.shape)

    @property
    def size(self) -> int:
        """Number of entries."""
        return int(np.prod(self.shape))

    @property
    def nbytes(self) -> int:
        """Bytes on the disk."""
        return self.size * self.dtype.itemsize

    def __len__(self) -> int:
        return self.shape[0]

    def __repr__(self) -> str:
        return f"StoredRows({list(self.shape)} in {self.folder}, read where indexed)"

    def __iter__(self):
        return (self[i] for i in range(len(self)))

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.asarray(self[...], dtype)

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        read = (a[...] if isinstance(a, StoredRows) else a for a in inputs)
        return getattr(ufunc, method)(*read, **options)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        return getattr(self[...], name)

    def __getitem__(self, which: Any) -> Any:
        key = which if isinstance(which, tuple) else (which,)
        used = lambda k: k is not None and k is not Ellipsis
        if any(np.ndim(k) > 1 and np.asarray(k).dtype == bool for k in key if used(k)):  # a mask of several axes
            return self._rows(np.arange(self.shape[self.axis]))[which]
        if not any(k is Ellipsis for k in key):
            key = (*key, Ellipsis)
        at = next(i for i, k in enumerate(key) if k is Ellipsis)
        whole = (slice(None),) * (self.ndim - sum(map(used, key)))
        key = [*key[:at], *whole, *key[at + 1 :]]
        place = [i for i, k in enumerate(key) if used(k)][self.axis]
        rows = np.arange(self.shape[self.axis])[key[place]]
        own, again = np.unique(rows, return_inverse=True)
        if isinstance(key[place], slice):
            key[place] = slice(None, None, -1 if len(rows) > 1 and rows[0] > rows[1] else 1)
        else:
            key[place] = again.reshape(np.shape(rows)) if np.ndim(rows) else 0
        return self._rows(own)[tuple(key)]

    def _rows(self, numbers: np.ndarray) -> np.ndarray:
        """The rows of these numbers, which increase."""
        shape = list(self.shape)
        shape[self.axis] = len(numbers)
        found = np.empty(shape)
        for index in np.unique(numbers // self.chunk).tolist():
            mine = numbers // self.chunk == index
            lead = (slice(None),) * self.axis
            found[(*lead, mine)] = self.block(index)[(*lead, numbers[mine] - index * self.chunk)]
        return found

    def block(self, index: int) -> np.ndarray:
        """The rows of a chunk, of which the last one is kept in memory."""
        if self._last is not None and self._last[0] == index:
            return self._last[1]
        shape = list(self.shape)
        shape[self.axis] = self.chunk
        values = read_block(self.folder, index, tuple(shape), self.axis)
        total, count = self.sums[index]
        if checksum(values[(slice(None),) * self.axis + (slice(count),)]) != total:
            raise ValueError(
                f"the rows of {self.folder.name} are not what was written: the store {self.folder.parent} is damaged."
            )
        self._last = index, values
        return values


def read_block(folder: Path, index: int, shape: tuple[int, ...], axis: int) -> np.ndarray:
    """A chunk of rows, whole. Raises `Unreadable` where the file is missing or has another size."""
    if 0 in shape:
        return np.empty(shape)
    try:
        file = chunk_file(folder, tuple(index if i == axis else 0 for i in range(len(shape))))
        data = plain_bytes(file, file.relative_to(folder.parent), 8 * int(np.prod(shape)))
    except FileNotFoundError:
        raise Unreadable(f"a part of its variable {folder.name} is missing: the store is incomplete") from None
    if len(data) != 8 * int(np.prod(shape)):
        raise Unreadable(f"a part of its variable {folder.name} has {len(data)} bytes")
    return np.frombuffer(data, "<f8").astype(float, copy=False).reshape(shape)
