"""A store on the disk: made at once, held by one caller at a time, cleared of what was left there, grown by more points."""

import contextlib
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dirax.solution.atomic_files import checked_place, placed
from dirax.solution.flushed_files import flush_folder, flushed, writing
from dirax.solution.sweep_store import STATUS, attributes_of, group_of
from dirax.solution.zarr_store import is_store
from dirax.sweeps.axes import Axes
from dirax.sweeps.grid import Grid, Index
from dirax.sweeps.layout import OPEN, TEXT, Array, Layout, decoded_texts, encoded_texts

NODE = "zarr.json"


@contextlib.contextmanager
def made(path: Path, overwrite: bool) -> Iterator[Path]:
    """A folder beside `path` for a new store, which is moved there at the end of the block. Raises as `placed`."""
    with writing(path), placed(path, overwrite, is_store) as beside:
        beside.mkdir()
        yield beside


def write_description(folder: Path, layout: Layout, axes: Mapping[str, tuple[Array, np.ndarray]], attributes: dict) -> None:
    """Everything but the blocks: descriptions, attributes and the values of the axes."""
    nodes = layout.nodes(axes)
    for name, node in nodes.items():
        (folder / name).mkdir()
        flushed(folder / name / NODE, _json(node))
    for name, (array, values) in axes.items():
        values = np.asarray(values)
        data = encoded_texts(values) if array.dtype == TEXT else np.ascontiguousarray(values, array.dtype).tobytes()
        flushed(folder / name / "c.0", data)
    consolidated = {"kind": "inline", "must_understand": False, "metadata": nodes}
    group = {"zarr_format": 3, "node_type": "group", "attributes": attributes, "consolidated_metadata": consolidated}
    flushed(folder / NODE, _json(group))
    flush_folder(folder)


def _json(value: Any) -> bytes:
    return json.dumps(value, indent=1).encode()


def layout_of(path: Path) -> Layout:
    """The layout that a store was written with."""
    nodes, about = group_of(path)["consolidated_metadata"]["metadata"], attributes_of(path)
    dims = tuple(json.loads(about["dims"]))
    arrays, lead = {}, len(dims)
    for name in json.loads(about["arrays"]):
        node = nodes[name]
        inner = tuple(node["shape"][lead:])
        arrays[name] = Array(tuple(node["dimension_names"][lead:]), inner, node["data_type"], node["attributes"])
    status = nodes[STATUS]
    grid = Grid(tuple(status["shape"]), tuple(status["chunk_grid"]["configuration"]["chunk_shape"]))
    return Layout(grid, dims, arrays)


def axes_of(path: Path) -> Axes:
    """The axes of the points of a store."""
    about = attributes_of(path)
    nodes = group_of(path)["consolidated_metadata"]["metadata"]
    values = {}
    for name in json.loads(about["axes"]):
        data = (path / name / "c.0").read_bytes()
        kind = nodes[name]["data_type"]
        values[name] = (
            decoded_texts(data).astype(str)
            if kind == TEXT
            else np.frombuffer(data, np.dtype(kind).newbyteorder("<")).astype(kind)
        )
    return Axes(values, bool(about["zip"]))


def open_points(path: Path, layout: Layout) -> dict[Index, np.ndarray | None]:
    """The blocks that are not finished: with None where all of a block is to be run, else with a mask of what is."""
    found: dict[Index, np.ndarray | None] = {}
    for index in layout.grid:
        if not (path / layout.file(STATUS, index)).exists():
            found[index] = None
            continue
        region = tuple(slice(0, s.stop - s.start) for s in layout.grid.region(index))
        left = layout.read(path, STATUS, index)[region] == OPEN
        if np.any(left):
            found[index] = None if np.all(left) else left
    return found


def counts(path: Path) -> dict[int, int]:
    """How many points have each status."""
    layout, total = layout_of(path), np.zeros(4, int)
    for index in layout.grid:
        region = tuple(slice(0, s.stop - s.start) for s in layout.grid.region(index))
        total += np.bincount(layout.read(path, STATUS, index)[region].ravel(), minlength=4)[:4]
    return dict(enumerate(total.tolist()))


def copy_points(old: Path, before: Layout, new: Path, after: Layout, places: tuple[np.ndarray, ...]) -> None:
    """Write the blocks of a new store that have points of an older one; `places` are those of its values on the new axes."""
    by_block = [
        [np.flatnonzero(place // part == block) for block in range(count)]
        for place, part, count in zip(places, after.grid.chunk, after.grid.blocks, strict=True)
    ]
    for index in after.grid:
        mine = [by_block[axis][block] for axis, block in enumerate(index)]
        if any(not len(chosen) for chosen in mine):
            continue
        target = tuple(
            place[chosen] - k * part for place, chosen, k, part in zip(places, mine, index, after.grid.chunk, strict=True)
        )
        status = _gathered(old, before, STATUS, mine)
        if not np.any(status):
            continue
        for name in after.arrays:
            block = after.blank(name)
            block[np.ix_(*target)] = _gathered(old, before, name, mine)
            temporary = new / f"{name}-block"
            flushed(temporary, after.encoded(name, block))
            os.replace(temporary, new / after.file(name, index))


def _gathered(path: Path, layout: Layout, name: str, chosen: list[np.ndarray]) -> np.ndarray:
    """The entries of an array at these numbers along every axis of the grid."""
    array = layout.arrays[name]
    found = np.empty((*map(len, chosen), *array.inner), object if array.dtype == TEXT else array.dtype)
    blocks = [np.unique(numbers // part) for numbers, part in zip(chosen, layout.grid.chunk, strict=True)]
    for index in np.array(np.meshgrid(*blocks, indexing="ij")).reshape(len(blocks), -1).T.tolist():
        at = [np.flatnonzero(numbers // part == k) for numbers, part, k in zip(chosen, layout.grid.chunk, index, strict=True)]
        inside = [numbers[a] - k * part for numbers, a, part, k in zip(chosen, at, layout.grid.chunk, index, strict=True)]
        found[np.ix_(*at)] = layout.read(path, name, tuple(index))[np.ix_(*inside)]
    return found


def refuse_place(path: Path) -> None:
    """Raise where no store could be made."""
    if path.suffix != ".zarr":
        raise ValueError(f"to must be the path of a zarr store that ends in .zarr, but {str(path)!r} was given.")
    checked_place(path, True, is_store)
