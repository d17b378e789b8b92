"""Solutions from files: everything is checked before it is believed, and nothing is executed."""

import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from dirax.schemes.step import Field
from dirax.solution.description import PARAMS_CODE
from dirax.solution.file_record import FileRecord, file_record
from dirax.solution.netcdf import open_netcdf
from dirax.solution.plain_forms import decode_params, decode_scheme
from dirax.solution.run_store import is_growing, open_growing
from dirax.solution.saving import MOVED, SEAL, checked_ending, path_of, seal
from dirax.solution.solution import Solution
from dirax.solution.stored import Stored, Unreadable, checksum, reading
from dirax.solution.stored_events import events_in
from dirax.solution.sweep_store import is_sweep, opened
from dirax.solution.trajectory import equation_of
from dirax.solution.zarr_store import open_store

MOST_ATTRIBUTE = 2**28
"""Bytes of a single attribute."""

SLACK, ROUNDINGS = 1e-6, 8
"""Part of a step, and last places of a time, by which saved times may be off those of their steps."""

NOT_OURS = "its description is not one that dirax wrote"


def load(
    path: str | os.PathLike, system: Any = None, scheme: Any = None, params: Any = None, inputs: Callable | None = None
) -> Any:
    """The Solution in a file that `Solution.save` wrote, bit for bit; the `xarray.Dataset` of a store that `dx.sweep` fills; the
    rows that are whole of a run that `dx.simulate(…, to=path)` writes or wrote, which are read where they are indexed.

    Code is not stored: `system` (and `scheme`, if it is not one of dirax with plain settings) supply it where it is needed,
    as for `dx.verify`, with the `inputs` of `dx.simulate`; energies and constraint residuals are in the file. `params` replaces
    the stored parameters: of a class of your own the file has the numbers, as a dict by the names of its fields, and with
    `system` they have to be given. Loading never executes anything from the file, and takes no more memory than its numbers need.

    Raises `FileNotFoundError`, `TypeError` for what is no path, or `ValueError` for a file that dirax did not write, cannot read,
    or that is damaged.
    """
    path = path_of(path)
    ending = checked_ending(path)
    if not _exists(path):
        raise FileNotFoundError(f"there is no file {path}: check the path.")
    try:
        if ending == ".zarr" and is_sweep(path):
            return opened(path)
        sol = reading("it cannot be read, being damaged or incomplete", _read, path, ending, params)
    except Unreadable as error:
        raise ValueError(f"{path} cannot be loaded: {str(error).rstrip('.')}.") from error
    if params is None and system is not None and (code := sol.metadata.get(PARAMS_CODE)):
        numbers = f", made of the numbers in the file, dx.load({str(path)!r}).params" if sol.params is not None else ""
        raise ValueError(
            f"the params of the run in {path} were made of {code}, which is code that no file holds: pass params=…{numbers}."
        )
    if inputs is not None:
        if system is None:
            raise ValueError("inputs= drives the system of the run, which dx.load was not given: pass system=… too.")
        system = system.with_inputs(inputs)
    sol.supplied = system is not None
    return with_code(sol, system, scheme)


def _exists(path: Path) -> bool:
    """Whether there is something at a path; False for a path that no file can have."""
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


def with_code(sol: Solution, system: Any, scheme: Any) -> Solution:
    """The solution with its system, scheme and equation; `ValueError` where they have other fields than were saved."""
    sol.system, sol.scheme = system, sol.scheme if scheme is None else scheme
    if sol.system is None or sol.scheme is None or not sol.initial:
        return sol
    sol.equation = equation_of(sol)
    made = {name: tuple(field.shape) for name, field in sol.equation.stages[0][0].fields.items()}
    saved = {name: tuple(field.shape) for name, field in sol.field_info.items()}
    if made != saved:
        raise ValueError(f"the file holds the fields {saved}, but the system and scheme that were given have {made}.")
    return sol


@contextmanager
def _opened(path: Path, ending: str) -> Iterator[Stored]:
    if ending == ".zarr":
        yield open_growing(path) if is_growing(path) else open_store(path)
    elif not path.is_file():
        raise Unreadable("it is a folder, or no file with contents, and not a netCDF file")
    else:
        with open_netcdf(path) as stored:
            yield stored


def stored_run(path: Path) -> Solution:
    """The Solution of the store of a run, as far as it got. Raises `Unreadable`."""
    return reading("it cannot be read, being damaged or incomplete", _read, path, ".zarr", None)


def _read(path: Path, ending: str, params: Any) -> Solution:
    with _opened(path, ending) as stored:
        if SEAL in stored.attributes and stored.attributes[SEAL] != reading(NOT_OURS, seal, stored.attributes):
            raise Unreadable("its description is not what was saved: the file is damaged or was edited")
        said = reading(NOT_OURS, file_record, {**stored.attributes, **_moved(stored)}, stored.kinds)
        sums = said.checksums
        for name in sums.keys() - stored.kinds.keys():
            raise Unreadable(f"its variable {name} is missing: the file is incomplete")
        arrays = {}
        for name in sorted(stored.kinds, key=lambda name: name != "time"):
            values = stored.read(name)
            if name not in stored.later and sums.get(name) != checksum(values):
                raise Unreadable(f"its variable {name} is not what was saved: the file is damaged, incomplete or was edited")
            arrays[name] = values
    _check_times(arrays, said)
    return reading(NOT_OURS, _solution, said, arrays, params)


def _moved(stored: Stored) -> dict[str, str]:
    """The long attributes, which are stored as arrays of bytes."""
    found = {}
    for name, (shape, dtype) in stored.kinds.items():
        if name.startswith(MOVED):
            if dtype != np.uint8 or len(shape) != 1 or shape[0] > MOST_ATTRIBUTE:
                raise Unreadable(f"its variable {name} is not an attribute as dirax writes it")
            found[name.removeprefix(MOVED)] = stored.read(name).tobytes().decode()
    return found


def _check_times(arrays: dict[str, np.ndarray], said: FileRecord) -> None:
    """Rows are as many steps apart as the file says: the last one, and where the first step was given the second, are fewer."""
    t = arrays["time"]
    gaps = np.diff(t)
    if not np.all(np.isfinite(t)) or np.any(gaps < 0):
        raise Unreadable("its times do not increase")
    if "interval" in arrays and not np.array_equal(arrays["interval"], t[:-1]):
        raise Unreadable("its steps do not begin at its times")
    most, slack = said.save_every * said.step, SLACK * said.step + ROUNDINGS * np.spacing(np.max(np.abs(t)))
    if np.any(gaps > most + slack) or np.any(gaps[:-1] < said.step - slack) or np.any(gaps[1:-1] < most - slack):
        raise Unreadable(f"its times are not those of steps of {said.step:.6g} of which every {said.save_every}th was saved")


def _solution(said: FileRecord, arrays: dict[str, np.ndarray], params: Any) -> Solution:
    ok, message = said.ok, said.message
    if said.batched:
        ok = arrays["ok"].astype(bool)
        message = [said.message.get(str(lane), "") for lane in range(len(ok))]
    metadata = said.metadata
    if params is not None:
        metadata = {name: about for name, about in metadata.items() if name != PARAMS_CODE}
    elif said.params is not None:
        params = decode_params(json.loads(said.params))
    sol = Solution(
        t=arrays["time"],
        fields={e["name"]: arrays[e["variable"]] for e in said.fields},
        field_info={
            e["name"]: Field(
                tuple(e["shape"]), e["place"], tuple(e["dims"]), e["description"], e.get("composed", ""), e.get("chosen", False)
            )
            for e in said.fields
        },
        step=said.step,
        save_every=said.save_every,
        stats=said.stats,
        ok=ok,
        message=message,
        scheme=decode_scheme(said.scheme),
        params=params,
        batch_params=said.batch_params,
        initial={name: arrays[f"initial_{name}"] for name in said.initial},
        derived={name: arrays[name] for name in said.derived},
        metadata=metadata,
    )
    for kind, record in said.events.items():
        setattr(sol, kind, events_in(kind, record, arrays))
    return sol
