"""Stores of sweeps as datasets: told from other stores by an attribute, and read when they are used."""

import json
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from xarray import Dataset

SWEEP = "dirax_sweep_format"
"""The attribute of the store of a sweep: the version of its layout."""


def is_sweep(path: Path) -> bool:
    """Whether a path is the store of a sweep."""
    try:
        return SWEEP in json.loads((path / "zarr.json").read_bytes()).get("attributes", {})
    except (OSError, ValueError, AttributeError):
        return False


def opened(path: Path) -> "Dataset":
    """The store as a Dataset whose arrays are read when they are used, as arrays of dask where that is installed."""
    import xarray as xr

    return xr.open_zarr(path, chunks={} if find_spec("dask") else None)  # type: ignore[arg-type]
