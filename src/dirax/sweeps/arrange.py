"""What the store of a sweep holds, and how its points are cut into tasks."""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from dirax.solution.description import Description, describe
from dirax.solution.export import axes_in_time
from dirax.solution.sweep_store import MESSAGE, STATUS
from dirax.sweeps.axes import Axes
from dirax.sweeps.grid import Grid, cut
from dirax.sweeps.keep import Keep
from dirax.sweeps.layout import TEXT, Array, Layout
from dirax.sweeps.trial import Trial

TASK_BYTES = 2**26
"""Most bytes of a task, several of which are in memory at a time."""

TASKS_PER_SLOT = 16
"""Tasks that there are at least for everything that runs at a time, so that all end together."""

LANES = 8
"""Fewest points of a task, where there are so many."""

DEVICE_BATCH = 4096
"""The same for an engine that runs a batch on a device."""


def arranged(axes: Axes, trial: Trial, units: Any, coordinates: Any) -> tuple[Layout, dict[str, tuple[Array, np.ndarray]]]:
    """What the store holds: its arrays over the points, not yet cut, and the axes with their values."""
    sol = trial.sol.replace(system=None)
    units = dict(units or {})
    kept = trial.keep.like or {}
    own = {name: str(units.pop(name)) for name in list(units) if name in axes.values or name in kept}
    said = describe(sol, units or None, coordinates)
    named = {}
    for name, values in axes.values.items():
        dims = axes.dims if axes.zipped else (name,)
        named[name] = (
            Array(dims, (), TEXT if values.dtype.kind == "U" else values.dtype.name, _unit(own.get(name, ""))),
            values,
        )
    arrays = _kept(trial.keep, own) if trial.keep.function is not None else _rows(sol, said)
    inner = {dim for array in arrays.values() for dim in array.dims}
    for dim, axis in axes_in_time(trial.sol, said.axes).items():
        if dim in inner:
            kind = TEXT if axis.values.dtype == object else "float64"
            named[dim] = Array((dim,), (), kind, dict(axis.about)), axis.values
    if both := sorted(arrays.keys() & named.keys()):
        raise ValueError(
            f"{both[0]!r} is the name of an axis and of what is kept: rename the axis in over, or what keep returns."
        )
    flags = {"flag_values": [0, 1, 2, 3], "flag_meanings": "not_run ok failed refused"}
    arrays[MESSAGE] = Array((), (), TEXT, {"long_name": "why a trajectory failed or was refused"})
    arrays[STATUS] = Array((), (), "int8", {"long_name": "what became of a point", **flags})
    return Layout(Grid(axes.shape, axes.shape), axes.dims, arrays), named


def _rows(sol: Any, said: Description) -> dict[str, Array]:
    names = json.loads(said.attributes["fields"])
    found = {}
    for entry in names:
        variable = said.variables[entry["variable"]]
        if variable.values.size:
            found[entry["variable"]] = Array(variable.dims[1:], variable.values.shape[1:], "float64", dict(variable.about))
    return found


def _kept(keep: Keep, units: Mapping[str, Any]) -> dict[str, Array]:
    found = {}
    for name, like in keep.like.items():
        if not like.size:
            raise ValueError(f"keep returned an empty array as {name}: leave it out.")
        dims = tuple(f"{name}_axis_{k}" for k in range(like.ndim))
        found[name] = Array(dims, like.shape, like.dtype.name, _unit(str(units.get(name, ""))))
    return found


def _unit(text: str) -> dict[str, str]:
    """What says the unit, nothing where there is none: xarray would label plots with empty brackets."""
    return {"units": text} if text else {}


def sized(axes: Axes, layout: Layout, trial: Trial, task_seconds: float, slots: int) -> Grid:
    """The grid cut into tasks of about so many seconds, as many as keep all slots busy, none too large for the memory."""
    least = DEVICE_BATCH if trial.engine == "xla" else LANES
    row_bytes = sum(array[0].nbytes for array in trial.sol.fields.values()) + layout.point_bytes
    by_time = task_seconds / max(trial.seconds, 1e-12)
    by_slots = axes.size / (TASKS_PER_SLOT * slots)
    points = max(min(by_time, max(by_slots, 0.1 * by_time)), least)
    return cut(axes.shape, int(max(1, min(points, TASK_BYTES / max(row_bytes, 1), axes.size))))
