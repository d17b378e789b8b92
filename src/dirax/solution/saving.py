"""Solutions into files: zarr and netCDF, with checksums."""

import json
import os
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dirax.solution.atomic_files import checked_place, placed
from dirax.solution.description import Description, Variable, describe, type_of
from dirax.solution.netcdf import write_netcdf
from dirax.solution.stored import TYPES, checksum
from dirax.solution.trajectory import Trajectory
from dirax.solution.zarr_store import is_store, write_store

FORMATS = {".zarr": (write_store, is_store), ".nc": (write_netcdf, Path.is_file)}
"""Ending → how such a file is written, and whether a path is one."""

LONGEST_ATTRIBUTE = 16_000
"""HDF5 holds attributes of up to 64 KB: longer ones go into a variable of bytes."""

MOVED = "attribute_"

SEAL = "attributes_checksum"
"""The attribute that holds the checksum of all others; files of the first versions have none."""


def save(
    sol: Trajectory,
    path: str | os.PathLike,
    overwrite: bool = False,
    units: Mapping[str, Any] | None = None,
    coordinates: Sequence[str] | None = None,
) -> Path:
    """Write the solution to `path`, a zarr store (`.zarr`) or a netCDF file (`.nc`), and return the path; `dx.load` reads it.

    The file appears complete or not at all: it is written beside its place and then moved there, so an interrupted save
    leaves an older file as it was. `units` and `coordinates` as in `sol.to_xarray`.

    Raises `FileExistsError` unless `overwrite`, `FileNotFoundError` where the folder does not exist, `ValueError` for
    another ending or too long a name, and for a solution inside `jax.grad`, `jit` or `vmap`; `TypeError` for what is no path, and
    for arrays of other numbers than files hold.
    """
    path = path_of(path)
    write, is_one = FORMATS[checked_ending(path)]
    checked_place(path, overwrite, is_one)
    variables, attributes = file_form(describe(sol, units, coordinates))
    with placed(path, overwrite, is_one) as beside:
        write(beside, variables, attributes)
    return path


def path_of(path: Any, name: str = "path", such: str = "run.zarr") -> Path:
    """The path, an argument of this name, such as that one; `TypeError` for what is none."""
    try:
        return Path(path)
    except TypeError:
        raise TypeError(f'{name} must be a text or a pathlib.Path such as "{such}", but {path!r:.60} was given.') from None


def checked_ending(path: Path) -> str:
    """The ending of a path; `ValueError` if it is that of no format."""
    if path.suffix not in FORMATS:
        raise ValueError(f"path must end in .zarr (a zarr store) or .nc (netCDF), but {str(path)!r} was given.")
    return path.suffix


def seal(attributes: Mapping[str, Any]) -> int:
    """The CRC-32 of the attributes of a file, but for `SEAL` itself and those that netCDF adds."""
    ours = {name: value for name, value in attributes.items() if name != SEAL and not name.startswith("_")}
    return zlib.crc32(json.dumps(ours, sort_keys=True).encode())


def file_form(said: Description) -> tuple[dict[str, Variable], dict[str, Any]]:
    """Numbers only: names of coordinates stay in the attributes, long attributes become bytes; with checksums."""
    variables = {**said.variables, **{name: axis for name, axis in said.axes.items() if name != "coordinate"}}
    layout = json.loads(said.attributes["fields"])
    variables = {name: _numbers(variable, name, type_of(name, layout)) for name, variable in variables.items()}
    attributes = dict(said.attributes)
    for name, value in said.attributes.items():
        if isinstance(value, str) and len(value.encode()) > LONGEST_ATTRIBUTE:
            data = np.frombuffer(attributes.pop(name).encode(), dtype=np.uint8)
            variables[MOVED + name] = Variable((f"{MOVED}{name}_byte",), data)
    attributes["checksums"] = json.dumps({name: checksum(variable.values) for name, variable in variables.items()})
    attributes[SEAL] = seal(attributes)
    return variables, attributes


def _numbers(variable: Variable, name: str, dtype: str) -> Variable:
    values = variable.values.astype(np.int8) if variable.values.dtype == bool else variable.values
    if values.dtype != dtype or dtype not in TYPES:
        raise TypeError(f"the array {name} holds {values.dtype}, which files do not hold there: convert it by astype(float).")
    return Variable(variable.dims, values, variable.about)
