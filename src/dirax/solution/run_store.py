"""The store of a run that is written while the run goes on: arrays that grow by chunks of rows, and how far it got.

It is a zarr store as `Solution.save` writes it, of which the arrays over the rows have the size of the whole run, and NaN where
nothing has been written. The file REACHED is written after all others, by one renaming: what it does not speak of is not there.
"""

import io
import json
import os
import uuid
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dirax.solution.description import Variable
from dirax.solution.flushed_files import UNFINISHED, flushed, writing
from dirax.solution.saving import SEAL, seal
from dirax.solution.stored import Stored, Unreadable, checksum, reading
from dirax.solution.stored_rows import StoredRows, read_block
from dirax.solution.zarr_store import NODE, array_node, chunk_file, open_store, write_array, write_node

REACHED = "time/reached.npz"
"""The file of a store that says how far it got."""

CHUNK_BYTES, MOST_ROWS = 2**24, 2**16
"""Bytes and rows of a chunk of the largest array, at most; a row that is larger is a chunk of its own."""


class Growing(NamedTuple):
    """The shape of an array over the rows, of a batch of so many or of one trajectory; whether the last row has none."""

    batch: int | None
    inner: tuple[int, ...]
    ends_before: bool

    @property
    def axis(self) -> int:
        """The number of the axis of the rows."""
        return int(self.batch is not None)

    def shape(self, rows: int) -> tuple[int, ...]:
        """With so many rows."""
        return (*(() if self.batch is None else (self.batch,)), rows, *self.inner)


@dataclass
class Reached:
    """How far a run got: `steps` are done and `rows` are whole; `ended` where there are no more. `record` is what its engine goes
    on with; `said` what is said of it, by name; `marks` the fingerprint of the call; `sums` by array the checksum of each chunk
    and how many rows it is of."""

    arrays: dict[str, Growing]
    chunk: int
    marks: dict[str, Any]
    steps: int = 0
    rows: int = 0
    ended: bool = False
    said: dict[str, Any] = field(default_factory=dict)
    sums: dict[str, list[list[int]]] = field(default_factory=dict)
    record: tuple[np.ndarray, ...] = ()

    def to_bytes(self) -> bytes:
        """As a file of NumPy."""
        about = {name: value for name, value in vars(self).items() if name != "record"}
        text = np.frombuffer(json.dumps(about).encode(), np.uint8)
        file = io.BytesIO()
        record: dict[str, Any] = {f"record_{i}": a for i, a in enumerate(self.record)}
        np.savez(file, about=text, **record)
        return file.getvalue()

    @classmethod
    def of(cls, path: Path) -> "Reached":
        """What a store says, from no more memory than its file takes. Raises `Unreadable`."""
        return reading(f"its {REACHED} is damaged", cls._read, path / REACHED)

    @classmethod
    def _read(cls, path: Path) -> "Reached":
        with zipfile.ZipFile(path) as members:
            if any(member.compress_type != zipfile.ZIP_STORED for member in members.infolist()):
                raise Unreadable(f"its {REACHED} is damaged (it is compressed, which dirax does not do)")
        with np.load(path) as file:
            about = json.loads(file["about"].tobytes())
            about["arrays"] = {n: Growing(batch, tuple(inner), ends) for n, (batch, inner, ends) in about["arrays"].items()}
            return cls(**about, record=tuple(file[f"record_{i}"] for i in range(len(file.files) - 1)))


class RunStore:
    """A store that this call writes."""

    def __init__(self, path: Path, reached: Reached):
        self.path, self.reached = path, reached
        self._blocks: dict[str, tuple[int, np.ndarray]] = {}

    @classmethod
    def made(cls, path: Path, variables: Mapping[str, Variable], attributes: Mapping[str, Any], reached: Reached, rows: int):
        """A new store for so many rows, in a new folder."""
        path.mkdir()
        store = cls(path, reached)
        for name, variable in variables.items():
            if name not in reached.arrays:
                write_array(path / name, variable)
                continue
            array = reached.arrays[name]
            shape, chunk = array.shape(rows - array.ends_before), [max(1, size) for size in array.shape(reached.chunk)]
            (path / name).mkdir()
            write_node(path / name, array_node(variable, shape, chunk, "NaN", False))
        store.describe(attributes)
        return store

    def describe(self, attributes: Mapping[str, Any]) -> None:
        """Write the attributes, under their seal."""
        attributes = {name: value for name, value in attributes.items() if name != SEAL}
        node = {"zarr_format": 3, "node_type": "group", "attributes": {**attributes, SEAL: seal(attributes)}}
        self._place(self.path / NODE, json.dumps(node, indent=1).encode())

    def grow(self, rows: int) -> None:
        """Have room for so many rows."""
        with writing(self.path):
            for name, array in self.reached.arrays.items():
                node = json.loads((self.path / name / NODE).read_bytes())
                if node["shape"] != (shape := list(array.shape(rows - array.ends_before))):
                    self._place(self.path / name / NODE, json.dumps({**node, "shape": shape}, indent=1).encode())

    def keep(self, rows: int) -> None:
        """Forget what was written of rows from this one on."""
        for name, array in self.reached.arrays.items():
            kept = []
            for index, (total, count) in enumerate(self.reached.sums[name]):
                left = min(count, rows - index * self.reached.chunk)
                if left == count:
                    kept.append([total, count])
                elif left > 0:
                    kept.append([checksum(_part(array, self._block(name, index), 0, left)), left])
            self.reached.sums[name] = kept
        self.reached.rows = rows
        self.mark()

    def put(self, first: int, values: Mapping[str, np.ndarray]) -> None:
        """Write rows from `first` on, of every array. They are there once `mark` has been called."""
        size = self.reached.chunk
        for name, rows in values.items():
            array, sums = self.reached.arrays[name], self.reached.sums.setdefault(name, [])
            last = first + rows.shape[array.axis]
            for index in range(first // size, -(-last // size)):
                low, high = max(first, index * size), min(last, (index + 1) * size)
                block = self._block(name, index)
                _part(array, block, low - index * size, high - index * size)[...] = _part(array, rows, low - first, high - first)
                if block.size:
                    file = chunk_file(self.path / name, tuple(index if i == array.axis else 0 for i in range(block.ndim)))
                    file.parent.mkdir(parents=True, exist_ok=True)
                    self._place(file, np.ascontiguousarray(block, "<f8").data)
                del sums[index:]
                sums.append([checksum(_part(array, block, 0, high - index * size)), high - index * size])

    def mark(self) -> None:
        """Have the file that says how far the run got say `reached`."""
        # a file system with a journal has the names of the files before it on the disk when this one is
        self._place(self.path / REACHED, self.reached.to_bytes())

    def finish(self) -> None:
        """Have the attributes say for other programs what `reached` says at the end."""
        said = dict(self.reached.said)
        if lanes := said.pop("lanes_ok"):
            self._place(chunk_file(self.path / "ok", (0,)), bytes(lanes))
        with writing(self.path):
            self.describe(json.loads((self.path / NODE).read_bytes())["attributes"] | said)

    def _place(self, file: Path, data: Any) -> None:
        with writing(self.path):
            bench = self.path / UNFINISHED
            bench.mkdir(exist_ok=True)
            beside = bench / uuid.uuid4().hex
            try:
                flushed(beside, data)
                os.replace(beside, file)
            except BaseException:
                beside.unlink(missing_ok=True)
                raise

    def _block(self, name: str, index: int) -> np.ndarray:
        """The rows of a chunk, the last one from memory."""
        if name in self._blocks and self._blocks[name][0] == index:
            return self._blocks[name][1]
        array, sums = self.reached.arrays[name], self.reached.sums.get(name, [])
        shape = array.shape(self.reached.chunk)
        there = index < len(sums) and 0 not in shape
        block = read_block(self.path / name, index, shape, array.axis).copy() if there else np.full(shape, np.nan)
        self._blocks[name] = index, block
        return block


def _part(array: Growing, rows: np.ndarray, low: int, high: int) -> np.ndarray:
    return rows[(slice(None),) * array.axis + (slice(low, high),)]


def is_growing(path: Path) -> bool:
    """Whether a path is the store of a run that is, or was, written while it went on."""
    return (path / REACHED).is_file()


def open_growing(path: Path) -> Stored:
    """What such a store holds, with the rows that are whole. Raises `Unreadable`."""
    whole, reached = open_store(path), Reached.of(path)
    if whole.attributes.get(SEAL) != seal(whole.attributes):
        raise Unreadable("its description is not what was saved: the store is damaged or was edited")
    ok = np.array(reached.said.pop("lanes_ok"), np.int8)
    attributes = {**whole.attributes, **reached.said}
    attributes[SEAL] = seal(attributes)
    rows = {}
    for name, array in reached.arrays.items():
        shape = array.shape(reached.rows - array.ends_before)
        rows[name] = StoredRows(path / name, shape, reached.chunk, reached.sums[name], array.axis)
    kinds = whole.kinds | {name: (a.shape, a.dtype) for name, a in rows.items()}
    axes = {"time", "interval"} & rows.keys()
    own = {**rows, **{name: rows[name][...] for name in axes}, "ok": ok}
    return Stored(attributes, kinds, lambda name: own[name] if name in own else whole.read(name), frozenset(own))
