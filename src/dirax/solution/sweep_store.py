"""Stores of sweeps as datasets: told from other stores by an attribute, and read when they are used."""

import json
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dirax.solution.stored import plain_bytes
from dirax.solution.zarr_store import LONGEST_NODE, NODE

if TYPE_CHECKING:
    from xarray import Dataset

SWEEP = "dirax_sweep_format"
"""The attribute of the store of a sweep: the version of its layout."""

STATUS, MESSAGE = "status", "message"
"""The arrays that say what became of a point."""

FORMAT = 1
"""The version that is written; a store of a later one is refused."""


def is_sweep(path: Path) -> bool:
    """Whether a path is the store of a sweep."""
    try:
        return SWEEP in group_of(path)["attributes"]
    except (OSError, ValueError, KeyError, TypeError):
        return False


def group_of(path: Path) -> dict[str, Any]:
    """The description of a store of zarr, with those of its arrays. Raises `OSError` and `ValueError` for anything else."""
    return json.loads(plain_bytes(path / NODE, NODE, LONGEST_NODE))


def attributes_of(path: Path) -> dict[str, Any]:
    """What the store of a sweep says of itself. Raises `ValueError` for anything else at this path."""
    try:
        attributes = group_of(path).get("attributes", {})
    except (OSError, ValueError, AttributeError):
        attributes = {}
    form = attributes.get(SWEEP)
    if not isinstance(form, int):
        raise ValueError(f"{path} is not the store of a sweep, or is damaged: choose another path.")
    if form > FORMAT:
        raise ValueError(
            f"{path} was written by a later dirax ({attributes.get('dirax_version')}, format {form}; this one reads {FORMAT}): "
            "update dirax."
        )
    return attributes


def opened(path: Path) -> "Dataset":
    """The store as a Dataset whose arrays are read when they are used, as arrays of dask where that is installed.

    Raises `ValueError` for one that a later dirax wrote; the arrays raise `StoreReplaced` once another is in its place."""
    import xarray as xr

    from dirax.solution.same_store import SameStore  # imported when it is used

    about = attributes_of(path)
    for node in path.glob(f"*/{NODE}"):
        plain_bytes(node, node.relative_to(path), LONGEST_NODE)
    blocks = {*json.loads(about["arrays"])} - {MESSAGE}  # where there is no message there is no block
    store = SameStore(path, len(json.loads(about["dims"])), blocks, STATUS)
    return xr.open_zarr(store, chunks={} if find_spec("dask") else None)  # type: ignore[arg-type]
