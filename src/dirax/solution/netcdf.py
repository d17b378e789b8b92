"""netCDF files as dirax writes them: numbers as they are, uncompressed, in one HDF5 file."""

import hashlib
import subprocess
import sys
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from dirax.solution.description import Variable
from dirax.solution.stored import TYPES, Stored, Unreadable, reading

SEAL = b"dirax-crc32:"
"""What stands behind the end of the HDF5 file, where HDF5 does not look, before the checksum of all bytes up to it. Files of
the first versions, and those that another program has written to since, have none."""

BLOCK = 2**20
"""Bytes that are read at a time."""

LIMIT, SLOWEST = 20.0, 2e6
"""Seconds that the HDF5 library may take over what describes a file, and bytes of it in a second more."""

LOOK = """
import sys, h5py
with h5py.File(sys.argv[1], "r") as file:
    dict(file.attrs)
    for name in file:
        if isinstance(file.get(name, getlink=True), h5py.HardLink):
            entry = file[name]
            dict(entry.attrs), entry.shape, entry.dtype, entry.id.get_create_plist().get_nfilters(), entry.id.get_storage_size()
            if entry.chunks and not entry.id.get_create_plist().get_nfilters() and entry.id.get_storage_size() == entry.nbytes:
                entry[()]
"""
"""All of it, in a process of its own: a checksum says that a file is what someone wrote, and not who did."""

_known: set[bytes] = set()
"""Digests of the files that this process has written, or looked at in one of its own: there is an end of these."""

DIMENSION = b"This is a netCDF dimension but not a netCDF variable"
"""How netCDF marks the HDF5 arrays that stand for axes without numbers."""


def write_netcdf(path: Path, variables: Mapping[str, Variable], attributes: Mapping[str, Any]) -> None:
    """A new netCDF file with these arrays, whose axes are named, and attributes."""
    import h5netcdf

    with h5netcdf.File(path, "w") as file:
        for variable in variables.values():
            for name, size in zip(variable.dims, np.shape(variable.values), strict=True):
                if name not in file.dimensions:
                    file.dimensions[name] = size
        for name, variable in variables.items():
            made = file.create_variable(name, variable.dims, variable.values.dtype, data=np.asarray(variable.values))
            made.attrs.update(variable.about)
        file.attrs.update(attributes)
    crc, digest = _sums(path, path.stat().st_size)
    with open(path, "ab") as raw:
        raw.write(SEAL + crc.to_bytes(4, "little"))
    _known.add(digest)


@contextmanager
def open_netcdf(path: Path) -> Iterator[Stored]:
    """Attributes, sizes and arrays of a netCDF file. Raises `Unreadable` for one with anything that dirax does not write."""
    import h5py

    if (digest := _checked(path)) not in _known:
        _look_apart(path)
        _known.add(digest)
    with reading("it is not a netCDF file, or incomplete", h5py.File, path, "r") as file:
        yield reading("it cannot be read, being damaged or incomplete", _stored, file)


def _checked(path: Path) -> bytes:
    """The digest of what was written; `Unreadable` where it has another checksum than stands behind it."""
    whole = path.stat().st_size
    size = max(0, whole - len(SEAL) - 4)
    with open(path, "rb") as raw:
        raw.seek(size)
        end = raw.read()
    if not end.startswith(SEAL):
        return _sums(path, whole)[1]
    crc, digest = _sums(path, size)
    if end[len(SEAL) :] != crc.to_bytes(4, "little"):
        raise Unreadable("it is not what was saved: the file is damaged or was edited")
    return digest


def _look_apart(path: Path) -> None:
    """`Unreadable` for a file in which the HDF5 library runs for ever, or that ends the process."""
    command, limit = [sys.executable, "-I", "-c", LOOK, str(path.absolute())], LIMIT + path.stat().st_size / SLOWEST
    try:
        ended = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, timeout=limit)
    except subprocess.TimeoutExpired:
        raise Unreadable(f"it is damaged: the HDF5 library did not come to an end of it within {limit:.3g} s") from None
    if ended.returncode < 0:
        raise Unreadable("it is damaged: the HDF5 library ends the process that reads it")


def _sums(path: Path, size: int) -> tuple[int, bytes]:
    """The CRC-32 and the digest of the first `size` bytes of a file."""
    found, digest = 0, hashlib.blake2b(digest_size=32)
    with open(path, "rb") as raw:
        while size > 0 and (block := raw.read(min(size, BLOCK))):
            digest.update(block)
            found, size = zlib.crc32(block, found), size - len(block)
    return found, digest.digest()


def _stored(file: Any) -> Stored:
    import h5py

    kinds = {}
    for name in file:
        if not isinstance(file.get(name, getlink=True), h5py.HardLink):
            raise Unreadable(f"its entry {name} is a link, which dirax does not write")
        entry = file[name]
        if not isinstance(entry, h5py.Dataset) or entry.is_virtual or entry.external:
            raise Unreadable(f"its entry {name} is not an array inside the file")
        if bytes(entry.attrs.get("NAME", b"")).startswith(DIMENSION):
            continue
        if entry.dtype.name not in TYPES or entry.dtype != np.dtype(entry.dtype.name).newbyteorder("<"):
            raise Unreadable(f"its variable {name} has the type {entry.dtype}, which dirax does not write")
        if entry.id.get_create_plist().get_nfilters() or entry.id.get_storage_size() != entry.nbytes:
            raise Unreadable(f"its variable {name} is compressed or has no numbers, which dirax does not write")
        kinds[name] = (entry.shape, entry.dtype)
    attributes = {name: _plain(value) for name, value in file.attrs.items()}
    return Stored(attributes, kinds, lambda name: np.asarray(file[name][()]))


def _plain(value: Any) -> Any:
    value = value.item() if isinstance(value, np.generic | np.ndarray) and np.size(value) == 1 else value
    return value.decode() if isinstance(value, bytes) else value
