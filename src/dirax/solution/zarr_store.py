"""Zarr stores of format 3 as dirax writes them: numbers in regular chunks, plain or compressed by zstd.

Any zarr library opens them. They are written and read here because that takes a hundredth of the time that importing such a
library does, and so that the sizes of arrays are known, and nothing but numbers is decoded, before memory is taken.
"""

import json
import os
from collections.abc import Mapping, Sequence
from importlib import import_module
from itertools import product
from math import ceil, prod
from pathlib import Path
from typing import Any

import numpy as np

from dirax.solution.description import Variable
from dirax.solution.stored import TYPES, Stored, Unreadable, plain_bytes, reading

CHUNK = 2**23
"""Bytes of a chunk; longer arrays are cut along their longest axis."""

SMALL = 2**20
"""Arrays of fewer bytes are not compressed."""

NODE = "zarr.json"
"""The file that describes an array or a group."""

LONGEST_NODE = 2**28
"""Bytes of such a file, at most."""

LITTLE = {"name": "bytes", "configuration": {"endian": "little"}}
BYTES = {"name": "bytes"}
ZSTD = {"name": "zstd", "configuration": {"level": 0, "checksum": False}}
CODECS = ("bytes", "zstd")
"""What is decoded. Nothing else is opened: some other codecs unpickle, which runs code from the file."""


def is_store(path: Path) -> bool:
    """Whether a path is a zarr store of format 3."""
    return (path / "zarr.json").is_file()


def write_store(path: Path, variables: Mapping[str, Variable], attributes: Mapping[str, Any]) -> None:
    """A new zarr store with these arrays, whose axes are named, and attributes."""
    path.mkdir()
    for name, variable in variables.items():
        write_array(path / name, variable)
    write_node(path, {"node_type": "group", "attributes": dict(attributes)})


def write_node(folder: Path, node: dict[str, Any]) -> None:
    """The description of an array or a group."""
    (folder / NODE).write_text(json.dumps({"zarr_format": 3, **node}, indent=1), "utf-8")


def array_node(variable: Variable, shape: Sequence[int], chunk: Sequence[int], fill: Any, compressed: bool) -> dict[str, Any]:
    """What is said of an array of this shape with the axes and the type of a variable."""
    first = BYTES if variable.values.itemsize == 1 else LITTLE
    return {
        "node_type": "array",
        "shape": list(shape),
        "data_type": variable.values.dtype.name,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": list(chunk)}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "fill_value": fill,
        "codecs": [first, ZSTD] if compressed else [first],
        "attributes": dict(variable.about),
        "dimension_names": list(variable.dims),
    }


def write_array(folder: Path, variable: Variable) -> None:
    """A whole array, in a new folder."""
    values = np.asarray(variable.values)
    chunk = _chunk_shape(values)
    compressed = values.nbytes >= SMALL
    folder.mkdir()
    write_node(folder, array_node(variable, values.shape, chunk, False if values.dtype == bool else 0, compressed))
    for index in _chunks(values.shape, chunk):
        part = values[tuple(slice(i * size, (i + 1) * size) for i, size in zip(index, chunk, strict=True))]
        if part.shape != chunk:
            part = np.pad(part, [(0, size - length) for size, length in zip(chunk, part.shape, strict=True)])
        data = np.ascontiguousarray(part, part.dtype.newbyteorder("<")).tobytes()
        file = chunk_file(folder, index)
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(_compress(data) if compressed else data)


def _chunk_shape(values: np.ndarray) -> tuple[int, ...]:
    shape = [max(1, size) for size in values.shape]
    if values.nbytes > CHUNK:
        longest = int(np.argmax(shape))
        pieces = ceil(values.nbytes / CHUNK)
        shape[longest] = max(1, ceil(shape[longest] / pieces))
    return tuple(shape)


def _chunks(shape: tuple[int, ...], chunk: tuple[int, ...]) -> product:
    return product(*(range(ceil(size / part)) for size, part in zip(shape, chunk, strict=True)))


def chunk_file(folder: Path, index: tuple[int, ...]) -> Path:
    """Where a chunk of an array is."""
    return folder.joinpath("c", *map(str, index))


def _compress(data: bytes) -> bytes:
    return bytes(import_module("numcodecs.zstd").compress(data, 0))


# ---------------------------------------------------------------------------------------------------------------- reading


def open_store(path: Path) -> Stored:
    """Attributes, sizes and arrays of a zarr store. Raises `Unreadable` for one with anything that dirax does not write."""
    if not os.path.lexists(path / NODE):
        raise Unreadable("it is not a zarr store of format 3 (it has no zarr.json)")
    nodes: dict[str, dict[str, Any]] = {}
    for file in sorted(path.rglob("*")):
        where = file.relative_to(path)
        if file.is_symlink() or not (file.is_dir() or file.is_file()):
            plain_bytes(file, where, 0)  # says what it is
        if file.name in (".zarray", ".zgroup", ".zmetadata"):
            raise Unreadable(f"it is a zarr store of format 2 ({where}), which dirax does not write")
        if file.name == "zarr.json":
            node = reading(f"{where} is damaged", json.loads, plain_bytes(file, where, LONGEST_NODE))
            nodes[where.parent.as_posix()] = reading(f"{where} is not one that dirax wrote", _checked_node, node, str(where))
    group = nodes.pop(".")
    if group["node_type"] != "group":
        raise Unreadable("zarr.json describes no group")
    if nested := next((name for name, node in nodes.items() if "/" in name or node["node_type"] == "group"), None):
        raise Unreadable(f"its entry {nested} is not an array of the store")
    kinds = {name: (tuple(node["shape"]), np.dtype(node["data_type"])) for name, node in nodes.items()}
    return Stored(group["attributes"], kinds, lambda name: _read_array(path / name, nodes[name]))


def _checked_node(node: Any, where: str) -> dict[str, Any]:
    if not isinstance(node, dict) or node.get("node_type") not in ("group", "array"):
        raise Unreadable(f"{where} describes neither a group nor an array")
    if not isinstance(node.get("attributes", {}), dict):
        raise Unreadable(f"{where} has attributes that are no table")
    if node["node_type"] == "group":
        return {"attributes": {}, **node}
    if node.get("data_type") not in TYPES:
        raise Unreadable(f"{where} has the data type {node.get('data_type')!r:.60}, which dirax does not write")
    codecs = node.get("codecs")
    if not isinstance(codecs, list) or not codecs:
        raise Unreadable(f"{where} does not say how its numbers are stored")
    names = [codec.get("name") if isinstance(codec, dict) else codec for codec in codecs]
    if unknown := [name for name in names if name not in CODECS]:
        raise Unreadable(f"{where} is encoded by {unknown[0]!r:.60}, which dirax does not write")
    if names[0] != "bytes" or "bytes" in names[1:] or codecs[0].get("configuration", {}).get("endian", "little") != "little":
        raise Unreadable(f"{where} stores its numbers in an order that dirax does not write")
    if node.get("storage_transformers"):
        raise Unreadable(f"{where} has storage transformers, which dirax does not write")
    grid, keys = node["chunk_grid"], node["chunk_key_encoding"]
    chunk = grid["configuration"]["chunk_shape"]
    whole = lambda sizes, least: isinstance(sizes, list) and all(type(size) is int and size >= least for size in sizes)
    if not whole(node["shape"], 0) or not whole(chunk, 1) or len(chunk) != len(node["shape"]) or grid["name"] != "regular":
        raise Unreadable(f"{where} has sizes that dirax does not write")
    if keys["name"] != "default" or keys.get("configuration", {}).get("separator", "/") != "/":
        raise Unreadable(f"{where} names its chunks as dirax does not")
    return node


def _read_array(folder: Path, node: dict[str, Any]) -> np.ndarray:
    shape, chunk = tuple(node["shape"]), tuple(node["chunk_grid"]["configuration"]["chunk_shape"])
    dtype = np.dtype(node["data_type"]).newbyteorder("<")
    compressed, size = len(node["codecs"]) - 1, prod(chunk) * dtype.itemsize
    parts = {}
    for index in _chunks(shape, chunk):
        file = chunk_file(folder, index)
        if not file.exists():
            raise Unreadable(f"a part of its variable {folder.name} is missing: the file is incomplete")
        data = plain_bytes(file, file.relative_to(folder.parent), size + size // 128 + 1024)  # what zstd may add
        for _ in range(compressed):
            data = _decompress(data, size)
        if len(data) != size:
            raise Unreadable(f"a part of its variable {folder.name} has {len(data)} bytes instead of {size}")
        parts[index] = np.frombuffer(data, dtype).reshape(chunk)
    values = np.empty(shape, dtype.newbyteorder("="))
    for index, part in parts.items():
        place = tuple(slice(i * step, (i + 1) * step) for i, step in zip(index, chunk, strict=True))
        values[place] = part[tuple(slice(length) for length in values[place].shape)]
    return values


def _decompress(data: bytes, size: int) -> bytes:
    """A zstd frame of `size` bytes, which its header must declare: no other is unpacked."""
    if _declared(data) != size:
        raise Unreadable("a part of it is not compressed as dirax does")
    return bytes(import_module("numcodecs.zstd").decompress(data))


def _declared(data: bytes) -> int | None:
    """The size that the header of a zstd frame declares (RFC 8878, 3.1.1.1), None where it does not."""
    if data[:4] != b"\x28\xb5\x2f\xfd":
        return None
    kind, single = data[4] >> 6, data[4] >> 5 & 1
    length = (int(single), 2, 4, 8)[kind]
    start = 5 + (1 - single) + (0, 1, 2, 4)[data[4] & 3]
    field = data[start : start + length]
    return None if not length or len(field) < length else int.from_bytes(field, "little") + 256 * (length == 2)
