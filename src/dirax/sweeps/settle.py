"""The store of a call: made, gone on with, grown by more points, or refused; and what says whose it is."""

import json
import re
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dirax.solution import fingerprint
from dirax.solution.atomic_files import clear_leftovers
from dirax.solution.flushed_files import Hold, StoreError, refuse_more_than_disk, taken
from dirax.solution.sweep_store import FORMAT, SWEEP, attributes_of
from dirax.sweeps.axes import Axes
from dirax.sweeps.fingerprint import of_case, of_keep
from dirax.sweeps.layout import Layout
from dirax.sweeps.store import axes_of, copy_points, layout_of, made, write_description
from dirax.sweeps.trial import Trial, program_of

FEWER = "save fewer rows with save_every=, keep less with keep="
"""How a sweep takes less room."""


def settled(
    path: Path, hold: Hold, layout: Layout, axes: Axes, named: Any, attributes: dict, marks: dict, overwrite: bool
) -> tuple[Layout, Axes]:
    """The store, held by this call: made, gone on with, or grown; its layout and axes."""
    if not path.exists():
        clear_leftovers(path)
    if path.exists():
        attributes_of(path) if not overwrite else None
        taken(path, hold)
        clear_leftovers(path)
        if not overwrite:
            there = _compared(path, axes, marks)
            if there is None:
                return layout_of(path), axes_of(path)
            old, places = layout_of(path), there
            layout = layout.beside(old)
            refuse_more_than_disk(path, axes.size * layout.point_bytes, FEWER)
            with made(path, True) as beside:
                write_description(beside, layout, named, attributes)
                copy_points(path, old, beside, layout, places)
                hold.take(beside)
            return layout, axes
    refuse_more_than_disk(path, axes.size * layout.point_bytes, FEWER)
    try:
        with made(path, overwrite) as beside:
            write_description(beside, layout, named, attributes)
            hold.take(beside)
    except StoreError:
        if path.exists() and not overwrite:  # another call was quicker
            taken(path, hold)
        raise
    return layout, axes


def joined(path: Path, axes: Axes, marks: dict) -> tuple[Layout, Axes]:
    """The store that another process of the same call has settled. Raises `ValueError` where the calls differ."""
    if _compared(path, axes, marks) is not None:
        raise ValueError(f"the processes of jax.distributed have other points for {path} each: give all of them the same.")
    return layout_of(path), axes_of(path)


def _compared(path: Path, axes: Axes, marks: dict[str, Any]) -> tuple[np.ndarray, ...] | None:
    """None where the store is that of this very call; the places of its points among those of this call where this one has
    more. Raises `ValueError` for the store of another sweep, with what differs."""
    there, old = attributes_of(path), axes_of(path)
    if _parts(there["dirax_version"]) > _parts(_version()):
        raise ValueError(
            f"{path} was written by a later dirax ({there['dirax_version']}; this one is {_version()}): update dirax, choose "
            "another path for to=, or pass overwrite=True to begin anew."
        )
    found = fingerprint.differences(json.loads(there["fingerprint"]), marks)
    kinds = {name: (old.values[name].dtype, values.dtype) for name, values in axes.values.items() if name in old.values}
    if found and (other := [f"{name} ({was} there, {now} here)" for name, (was, now) in kinds.items() if was.kind != now.kind]):
        found = [f"the type of the values of {', '.join(other)}"]
    if found:
        raise ValueError(
            f"{path} belongs to another sweep, which differs in {'; '.join(found)}: choose another path for to=, or pass "
            "overwrite=True to begin anew."
        )
    places = old.positions_in(axes)
    if places is None:
        raise ValueError(
            f"{path} has points that are not among those of this call, which may add points but leave out none: pass the values "
            "that are there as well, with np.union1d for instance, choose another path for to=, or pass overwrite=True."
        )
    same = all(np.array_equal(place, np.arange(size)) for place, size in zip(places, axes.shape, strict=True))
    return None if same else places


def fingerprint_of(
    system: Any, scheme: Any, axes: Axes, trial: Trial, options: dict[str, Any], params: Any, seed: int
) -> dict[str, Any]:
    """Everything on which the bits of the store depend, but the values of the axes."""
    settings = {name: value for name, value in options.items() if name != "engine"}
    engine = options["engine"] if isinstance(options["engine"], str) else repr(options["engine"])
    return {
        "dirax": _version(),
        "dtype": "float64",
        "axes": list(axes.values),
        "zip": axes.zipped,
        "system": program_of(trial.sol, options),
        "scheme": fingerprint.of_scheme(scheme),
        "case": of_case(trial.case, axes.at(np.array([0]))),
        "keep": of_keep(trial.keep),
        "params": fingerprint.of_value(jax.tree.leaves(params)) if params is not None else "of case",
        "seed": seed,
        "engine": engine,
        **settings,
    }


def attributes_for(system: Any, scheme: Any, axes: Axes, layout: Layout, options: dict, marks: dict[str, Any]) -> dict[str, Any]:
    return {
        "title": "dirax sweep",
        SWEEP: FORMAT,
        "dirax_version": _version(),
        "system": repr(system),
        "scheme": repr(scheme),
        **{name: value for name, value in options.items() if name in ("step", "steps", "save_every", "t0")},
        "axes": json.dumps(list(axes.values)),
        "dims": json.dumps(list(axes.dims)),
        "arrays": json.dumps(list(layout.arrays)),
        "zip": int(axes.zipped),
        "fingerprint": json.dumps(marks),
    }


def _version() -> str:
    try:
        return version("dirax")
    except PackageNotFoundError:
        return "unknown"


def _parts(text: str) -> tuple[int, ...]:
    """The numbers of a version."""
    return tuple(int(part) for part in re.findall(r"\d+", text)[:3])
