"""What a store of a sweep holds: arrays with the names of their axes, and the files that any zarr library opens.

Every array over the points has chunks that are blocks of the grid, whole in its other axes: a block is one file of each. The
block of `status` is written last, by one renaming, and is what says that the others are there.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from dirax.solution.zarr_store import BYTES, LITTLE
from dirax.sweeps.grid import Grid, Index

TEXT = "string"
"""The type of arrays of texts."""

TEXTS = {"name": "vlen-utf8"}

OPEN, OK, FAILED, REFUSED = 0, 1, 2, 3
"""What `status` says of a point: it has not been run, ran to the end, failed, or was refused before its first step."""


@dataclass(frozen=True)
class Array:
    """An array over the points (`inner` are its other axes), or without them for an axis itself."""

    dims: tuple[str, ...]
    inner: tuple[int, ...]
    dtype: str
    about: dict[str, Any] = field(default_factory=dict)

    @property
    def fill(self) -> Any:
        """What stands where nothing has been written: NaN, an empty text, 0."""
        return np.nan if np.dtype("U" if self.dtype == TEXT else self.dtype).kind == "f" else "" if self.dtype == TEXT else 0


@dataclass(frozen=True)
class Layout:
    """The `arrays` over the points by name, and how these are cut; `dims` are the names of the grid's axes."""

    grid: Grid
    dims: tuple[str, ...]
    arrays: dict[str, Array]

    @property
    def point_bytes(self) -> int:
        """Bytes that a point takes, apart from messages."""
        return sum(_size(array) for array in self.arrays.values())

    def beside(self, other: "Layout") -> "Layout":
        """The same with arrays of types that have the numbers of another layout too."""
        arrays = dict(self.arrays)
        for name, array in arrays.items():
            if name in other.arrays and TEXT not in (array.dtype, other.arrays[name].dtype):
                arrays[name] = replace(array, dtype=np.result_type(array.dtype, other.arrays[name].dtype).name)
        return replace(self, arrays=arrays)

    def file(self, name: str, index: Index) -> Path:
        """Where a block of an array is, in the folder of the store."""
        return Path(name, ".".join(map(str, ("c", *index, *(0 for _ in self.arrays[name].inner)))))

    def blank(self, name: str) -> np.ndarray:
        """A block of an array to which nothing has been written."""
        array = self.arrays[name]
        return np.full((*self.grid.chunk, *array.inner), array.fill, object if array.dtype == TEXT else array.dtype)

    def encoded(self, name: str, block: np.ndarray) -> Any:
        """The bytes of the file of a block."""
        if self.arrays[name].dtype == TEXT:
            return encoded_texts(block)
        return np.ascontiguousarray(block, np.dtype(self.arrays[name].dtype).newbyteorder("<")).data

    def read(self, folder: Path, name: str, index: Index) -> np.ndarray:
        """A block of an array as it is in the store."""
        array, path = self.arrays[name], folder / self.file(name, index)
        try:
            data = path.read_bytes()
        except FileNotFoundError:
            return self.blank(name)
        shape = (*self.grid.chunk, *array.inner)
        if array.dtype == TEXT:
            return decoded_texts(data).reshape(shape)
        return np.frombuffer(data, np.dtype(array.dtype).newbyteorder("<")).reshape(shape).astype(array.dtype)

    def nodes(self, axes: Mapping[str, tuple[Array, np.ndarray]]) -> dict[str, dict[str, Any]]:
        """The descriptions of all arrays, those of the axes among them, as zarr has them."""
        described = {
            name: _node(array, (*self.grid.shape, *array.inner), (*self.grid.chunk, *array.inner), (*self.dims, *array.dims))
            for name, array in self.arrays.items()
        }
        return described | {n: _node(a, values.shape, values.shape, a.dims) for n, (a, values) in axes.items()}


def _node(array: Array, shape: tuple[int, ...], chunk: tuple[int, ...], dims: tuple[str, ...]) -> dict[str, Any]:
    text = array.dtype == TEXT
    fill = array.fill
    return {
        "zarr_format": 3,
        "node_type": "array",
        "shape": list(shape),
        "data_type": array.dtype,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [max(1, size) for size in chunk]}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "."}},
        "fill_value": "NaN" if fill != fill else bool(fill) if array.dtype == "bool" else fill,
        "codecs": [TEXTS if text else BYTES if np.dtype(array.dtype).itemsize == 1 else LITTLE],
        "attributes": array.about,
        "dimension_names": list(dims),
    }


def encoded_texts(texts: np.ndarray) -> bytes:
    """Texts as the codec `vlen-utf8` has them: how many there are, and each after its length."""
    parts = [struct.pack("<I", texts.size)]
    for text in texts.ravel().tolist():
        data = text.encode()
        parts += [struct.pack("<I", len(data)), data]
    return b"".join(parts)


def decoded_texts(data: bytes) -> np.ndarray:
    """The texts (n,) in such bytes, as objects."""
    (count,), at, texts = struct.unpack_from("<I", data), 4, []
    for _ in range(count):
        (length,) = struct.unpack_from("<I", data, at)
        texts.append(data[at + 4 : at + 4 + length].decode())
        at += 4 + length
    return np.array([*texts, ""], object)[:-1]


def _size(array: Array) -> int:
    return int(np.prod(array.inner)) * (16 if array.dtype == TEXT else np.dtype(array.dtype).itemsize)
