"""Solutions in files: zarr and netCDF, written beside and moved into place, and read without executing anything."""

import json
import os
import shutil
import uuid
import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dirax.solution.dataset import check_format, from_dataset, to_dataset, with_code
from dirax.solution.solution import Solution

if TYPE_CHECKING:
    from xarray import Dataset

ENDINGS = {".zarr": "zarr", ".nc": "h5netcdf"}

LONGEST_ATTRIBUTE = 16_000
"""HDF5 holds attributes of up to 64 KB: longer ones go into a variable of bytes."""

MOVED = "attribute_"

CODECS = {"bytes", "zstd", "blosc", "gzip", "crc32c"}
TYPES = {"float64", "float32", "int64", "int32", "int8", "uint8", "bool"}
"""What dirax writes into a zarr store. Nothing else is opened: some other codecs unpickle, which runs code from the file."""


class Unreadable(ValueError):
    """What is wrong with a file, without its path."""


def save(
    sol: Solution,
    path: str | os.PathLike,
    overwrite: bool = False,
    units: Mapping[str, Any] | None = None,
    coordinates: Sequence[str] | None = None,
) -> Path:
    """Write a solution to `path`, a zarr store (`.zarr`) or a netCDF file (`.nc`), and return the path.

    The file appears complete or not at all: it is written beside its place and then moved there, so an interrupted save
    leaves an older file as it was. `units` and `coordinates` as in `Solution.to_xarray`.

    Raises `FileExistsError` unless `overwrite`, `FileNotFoundError` where the folder does not exist, `ValueError` for
    another ending and for a solution inside `jax.grad`, `jit` or `vmap`.
    """
    path = Path(path)
    engine = _engine(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"the folder {path.parent} does not exist: create it before saving {path.name}.")
    if os.path.lexists(path):
        if not overwrite:
            raise FileExistsError(f"{path} exists: pass overwrite=True to replace it, or choose another path.")
        if not (_is_store(path) if engine == "zarr" else path.is_file()):
            raise FileExistsError(f"{path} exists and is no {path.suffix} file, so it is not replaced: choose another path.")
    dataset = _to_file_form(to_dataset(sol, units, coordinates))
    beside = path.parent / f".{path.stem}-{uuid.uuid4().hex}{path.suffix}"
    try:
        if engine == "zarr":
            dataset.to_zarr(beside, mode="w-", consolidated=False, zarr_format=3, write_empty_chunks=True)
        else:
            unfilled = {name: {"_FillValue": None} for name in dataset.variables}
            dataset.to_netcdf(beside, mode="w", engine="h5netcdf", encoding=unfilled)
        _move_into_place(beside, path)
    finally:
        _remove(beside)
    return path


def load(path: str | os.PathLike, system: Any = None, scheme: Any = None, params: Any = None) -> Solution:
    """The solution in a file that `Solution.save` wrote, bit for bit.

    Code is not stored: `system` (and `scheme`, if it is not one of dirax with plain settings) supply it where it is needed,
    as for `dx.verify`; energies and constraint residuals are in the file. `params` replaces the stored parameters.
    Loading never executes anything from the file.

    Raises `FileNotFoundError`, or `ValueError` for a file that dirax did not write, cannot read, or that is damaged.
    """
    path = Path(path)
    engine = _engine(path)
    if not path.exists():
        raise FileNotFoundError(f"there is no file {path}: check the path.")
    try:
        (_check_store if engine == "zarr" else _check_hdf5)(path)
        dataset = _reading("it cannot be read, being damaged or incomplete", _read, path, engine)
        check_format(dataset)
        _check_sums(dataset)
        sol = _reading("its description is not one that dirax wrote", from_dataset, _from_file_form(dataset), params)
    except ValueError as error:
        raise ValueError(f"{path} cannot be loaded: {str(error).rstrip('.')}.") from error
    return with_code(sol, system, scheme)


def _reading(problem: str, read: Callable, *arguments: Any) -> Any:
    """`read(*arguments)`, where anything unexpected means that the file has this problem."""
    try:
        return read(*arguments)
    except Unreadable:
        raise
    except Exception as error:
        reason = (str(error).splitlines() or ["no reason given"])[0]
        raise Unreadable(f"{problem} ({type(error).__name__}: {reason.rstrip('.')})") from error


def _engine(path: Path) -> str:
    if path.suffix not in ENDINGS:
        raise ValueError(f"path must end in .zarr (a zarr store) or .nc (netCDF), but {str(path)!r} was given.")
    return ENDINGS[path.suffix]


# ------------------------------------------------------------------------------------------------------------- writing


def _to_file_form(dataset: "Dataset") -> "Dataset":
    """Numbers only: names of coordinates stay in the attributes, long attributes become bytes; with checksums."""
    import xarray as xr

    dataset = dataset.drop_vars("coordinate", errors="ignore").copy()
    for name in [name for name, value in dataset.attrs.items() if isinstance(value, str) and len(value) > LONGEST_ATTRIBUTE]:
        data = np.frombuffer(dataset.attrs.pop(name).encode(), dtype=np.uint8)
        dataset[MOVED + name] = xr.Variable((f"{MOVED}{name}_byte",), data)
    for variable in dataset.variables.values():
        if variable.dtype == bool:
            variable.values = variable.values.astype(np.int8)
    dataset.attrs["checksums"] = json.dumps({str(name): _checksum(v.values) for name, v in dataset.variables.items()})
    return dataset


def _from_file_form(dataset: "Dataset") -> "Dataset":
    for name in [str(name) for name in dataset.variables if str(name).startswith(MOVED)]:
        dataset.attrs[name.removeprefix(MOVED)] = dataset[name].values.tobytes().decode()
    return dataset


def _checksum(values: np.ndarray) -> int:
    return zlib.crc32(np.ascontiguousarray(values).tobytes())


def _is_store(path: Path) -> bool:
    return (path / "zarr.json").is_file()


def _move_into_place(beside: Path, path: Path) -> None:
    """Files are replaced in one action; a folder is first moved aside, and back if its successor cannot be moved in."""
    if not path.is_dir():
        os.replace(beside, path)
        return
    old = beside.with_name(f"{beside.stem}-old{beside.suffix}")
    os.rename(path, old)
    try:
        os.rename(beside, path)
    except BaseException:
        os.rename(old, path)
        raise
    _remove(old)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


# ------------------------------------------------------------------------------------------------------------- reading


def _read(path: Path, engine: str) -> "Dataset":
    """Everything in the file as it is stored, without interpreting attributes."""
    import xarray as xr

    options = {"consolidated": False, "zarr_format": 3} if engine == "zarr" else {}
    with xr.open_dataset(path, engine=engine, decode_cf=False, cache=False, **options) as dataset:
        for name, variable in dataset.variables.items():
            if variable.dtype.kind not in "fiub":
                raise Unreadable(f"its variable {name} has the type {variable.dtype}, which dirax does not write")
        return dataset.load()


def _check_sums(dataset: "Dataset") -> None:
    sums = _reading("its description is not one that dirax wrote", lambda: json.loads(dataset.attrs["checksums"]))
    for name in set(sums) - set(map(str, dataset.variables)):
        raise Unreadable(f"its variable {name} is missing: the file is incomplete")
    for name, variable in dataset.variables.items():
        if sums.get(str(name)) != _checksum(variable.values):
            raise Unreadable(f"its variable {name} is not what was saved: the file is damaged, incomplete or was edited")


def _check_store(path: Path) -> None:
    """`ValueError` for a zarr store with anything in it that dirax does not write."""
    if not _is_store(path):
        raise Unreadable("it is not a zarr store of format 3 (it has no zarr.json)")
    for file in path.rglob("*"):
        if file.name in (".zarray", ".zgroup", ".zmetadata"):
            raise Unreadable(f"it is a zarr store of format 2 ({file.relative_to(path)}), which dirax does not write")
        if file.name == "zarr.json":
            where = str(file.relative_to(path))
            _check_zarr_metadata(_reading(f"{where} is damaged", json.loads, file.read_bytes()), where)


def _check_zarr_metadata(node: Any, where: str) -> None:
    if not isinstance(node, dict) or node.get("node_type") not in ("group", "array"):
        raise Unreadable(f"{where} describes neither a group nor an array")
    if node["node_type"] == "group":
        return
    if str(node.get("data_type")) not in TYPES:
        raise Unreadable(f"{where} has the data type {node.get('data_type')!r}, which dirax does not write")
    codecs = [codec.get("name") if isinstance(codec, dict) else codec for codec in node.get("codecs", [])]
    if unknown := [codec for codec in codecs if codec not in CODECS]:
        raise Unreadable(f"{where} is encoded by {unknown[0]!r}, which dirax does not write")
    if node.get("storage_transformers"):
        raise Unreadable(f"{where} has storage transformers, which dirax does not write")


def _check_hdf5(path: Path) -> None:
    """`ValueError` for an HDF5 file that refers to other files."""
    import h5py

    with _reading("it is not a netCDF file, or incomplete", h5py.File, path, "r") as file:
        for name in file:
            if not isinstance(file.get(name, getlink=True), h5py.HardLink):
                raise Unreadable(f"its entry {name} is a link, which dirax does not write")
            entry = file[name]
            if not isinstance(entry, h5py.Dataset) or entry.is_virtual or entry.external:
                raise Unreadable(f"its entry {name} is not an array inside the file")
