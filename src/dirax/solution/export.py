"""A Solution for other programs: an xarray Dataset, a pandas DataFrame, a CSV file."""

import csv
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dirax.solution.atomic_files import placed
from dirax.solution.description import Variable, describe
from dirax.solution.saving import path_of
from dirax.solution.trajectory import Trajectory

if TYPE_CHECKING:
    from pandas import DataFrame
    from xarray import Dataset

ROWS = {"time", "interval"}
"""The axes of rows, and of the steps that leave them."""

BLOCK = 2**14
"""Rows of a CSV file that are written at a time."""


def to_xarray(sol: Trajectory, units: Mapping[str, Any] | None = None, coordinates: Sequence[str] | None = None) -> "Dataset":
    """The solution as an `xarray.Dataset` with named dimensions, units, derived quantities and what was run.

    Dimensions: `trajectory` (in a batch), `time` (saved rows), `interval` (the step leaving a row), `coordinate`,
    `constraint`. Variables: every saved field, `energy`, `constraint_residual`, the initial data, and `ok` in a batch. With
    variable steps the trajectories of a batch have times of their own, `clock`, and `time` no values.
    `units`: a unit for "t", "energy" or the name of a field, one string or one per coordinate: {"t": "s", "q": ["m", "rad"]};
    `coordinates`: the names of the coordinates. Both default to what `sol.metadata` says.
    A table with one row a time is `sol.to_dataframe()`: `Dataset.to_dataframe()` has one for every combination of all
    dimensions.

    Raises `ValueError` for unknown or repeated names, wrong lengths, and inside `jax.grad`, `jit` or `vmap`.
    """
    import xarray as xr

    said = describe(sol, units, coordinates)
    as_xarray = lambda variables: {name: (v.dims, v.values, v.about) for name, v in variables.items()}
    return xr.Dataset(as_xarray(said.variables), as_xarray(axes_in_time(sol, said.axes)), said.attributes)


def axes_in_time(sol: Trajectory, axes: Mapping[str, Variable]) -> dict[str, Variable]:
    """The axes with the times of the rows, which number the steps of a run with variable ones otherwise; without them where every
    trajectory has its own."""
    if not sol.has_own_times:
        return dict(axes)
    found = {name: axis for name, axis in axes.items() if name not in ROWS}
    if sol.batch is None:
        t = np.asarray(sol.t)
        found |= {
            n: Variable(axes[n].dims, t[: len(axes[n].values)], {**axes[n].about, "long_name": "time"}) for n in axes if n in ROWS
        }
    return found


def to_dataframe(sol: Trajectory, coordinates: Sequence[str] | None = None) -> "DataFrame":
    """The solution as a `pandas.DataFrame` with one row a saved time and one column a component.

    Columns: `trajectory` (in a batch: the rows of one trajectory after those of another), `t`, then the fields,
    `energy` and `constraint_residual`. The components of a field are numbered, "q0", "multipliers1", or carry the names of
    the coordinates: "x", "θ" for q, "p_x", "p_θ" for p. What belongs to a step stands on the row that the step leaves, with
    NaN on the last row. `coordinates` defaults to what `sol.metadata` says.

    Raises `ValueError` for repeated names or a wrong number of them, and inside `jax.grad`, `jit` or `vmap`.
    """
    from pandas import DataFrame

    return DataFrame(_columns(sol, coordinates))


def to_csv(sol: Trajectory, path: str | os.PathLike, overwrite: bool = False, coordinates: Sequence[str] | None = None) -> Path:
    """Write the table of `to_dataframe` to `path`, with a line of names and empty cells for NaN, and return the path.

    Numbers are written with all digits that they need to be read back exactly. The file appears complete or not at all.
    Raises `FileExistsError` unless `overwrite`, `FileNotFoundError` where the folder does not exist, and what
    `to_dataframe` raises.
    """
    path, columns = path_of(path, such="run.csv"), _columns(sol, coordinates)
    rows = len(columns["t"])
    with placed(path, overwrite) as beside, open(beside, "w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        for first in range(0, rows, BLOCK):
            block = [_cells(column[first : first + BLOCK]) for column in columns.values()]
            writer.writerows(zip(*block, strict=True))
    return path


def _cells(column: np.ndarray) -> list:
    return ["" if value != value else value for value in column.tolist()]


def _columns(sol: Trajectory, coordinates: Sequence[str] | None) -> dict[str, np.ndarray]:
    """The columns of the table by name, each with one entry a row."""
    said = describe(sol, coordinates=coordinates)
    count = sol.batch or 1
    columns = {} if sol.batch is None else {"trajectory": np.repeat(np.arange(count), sol.rows)}
    columns["t"] = np.broadcast_to(np.asarray(sol.t), (count, sol.rows)).ravel()
    names = said.axes["coordinate"].values.tolist() if "coordinate" in said.axes else None
    position = "q" if "q" in said.variables else "x"
    lead = 1 if sol.batch is None else 2
    for field, variable in said.variables.items():
        inner = variable.dims[lead:]
        if not ROWS.intersection(variable.dims[lead - 1 : lead]):
            continue  # initial data and ok belong to no row
        values = np.asarray(variable.values, dtype=float).reshape(count, -1, int(np.prod(variable.values.shape[lead:])))
        if variable.dims[lead - 1] == "interval":
            values = np.concatenate([values, np.full((count, 1, values.shape[2]), np.nan)], axis=1)
        named = names if inner == ("coordinate",) else None
        labels = [*np.ndindex(*variable.values.shape[lead:])]
        for k, index in enumerate(labels):
            name = (
                f"{field}{'_'.join(map(str, index))}"
                if named is None
                else named[k]
                if field == position
                else f"{field}_{named[k]}"
            )
            if name in columns:
                raise ValueError(
                    f"two columns would be called {name!r}: pass coordinates= with names that are no names of other columns."
                )
            columns[name] = values[:, :, k].ravel()
    return columns
