"""sweep(): a study of many points, run in batches into a store, and gone on with by the same call after whatever ended it."""

import contextlib
import json
import os
import shutil
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from dirax.engines.engine import AbstractEngine
from dirax.run.validate import check_kinds, count, engine_from, finite, positive
from dirax.schemes.step import AbstractScheme
from dirax.solution.description import Description, describe
from dirax.solution.placing import clear_leftovers
from dirax.solution.sweep_store import SWEEP, opened
from dirax.sweeps import executors, fingerprint
from dirax.sweeps.axes import Axes
from dirax.sweeps.case import Case
from dirax.sweeps.commit import StoreError
from dirax.sweeps.driver import PlaceLost, drive
from dirax.sweeps.grid import Grid, cut
from dirax.sweeps.keep import Keep
from dirax.sweeps.layout import FORMAT, MESSAGE, STATUS, TEXT, Array, Layout
from dirax.sweeps.progress import State, reporting
from dirax.sweeps.store import (
    Hold,
    attributes_of,
    axes_of,
    copy_points,
    counts,
    layout_of,
    made,
    open_points,
    refuse_place,
    write_description,
)
from dirax.sweeps.task import Plan, Task
from dirax.sweeps.trial import Trial, check_points, program_of, tried
from dirax.systems.system import AbstractSystem

if TYPE_CHECKING:
    from xarray import Dataset

TASK_BYTES = 2**26
"""Most bytes of a task, several of which are in memory at a time."""

TASKS_PER_SLOT = 4
"""Tasks that there are at least for everything that runs at a time, so that all end together."""

LANES = 8
"""Fewest points of a task, where there are so many."""

DEVICE_BATCH = 4096
"""The same for an engine that runs a batch on a device."""


class Interrupted(KeyboardInterrupt):
    """Ctrl-C, with the way to go on."""


def sweep(
    system: AbstractSystem,
    scheme: AbstractScheme,
    *,
    over: Mapping[str, Any],
    case: Callable[..., Mapping[str, Any]],
    step: float,
    steps: int,
    to: str | os.PathLike,
    save_every: int = 1,
    keep: Callable[[Any], Mapping[str, Any]] | None = None,
    zip: bool = False,
    executor: Any = None,
    params: Any = None,
    seed: int = 0,
    engine: str | AbstractEngine = "auto",
    inputs: Callable | None = None,
    project: bool = False,
    check_initial: bool = True,
    t0: float = 0.0,
    max_iterations: int = 50,
    compensated: bool = False,
    units: Mapping[str, Any] | None = None,
    coordinates: Sequence[str] | None = None,
    progress: Any = None,
    overwrite: bool = False,
    task_seconds: float = 1.0,
) -> "Dataset":
    """Run `scheme` on `system` from every point of the axes in `over`, into the zarr store `to`, and return it as an
    `xarray.Dataset` that is read when it is used.

        data = dx.sweep(system, scheme, over={"mass": np.linspace(0.5, 2, 200), "angle": np.linspace(0, 3, 500)},
                        case=lambda mass, angle: {"q": [angle, 0.0], "v": [0.0, 0.0], "params": {"m": mass}},
                        step=1e-2, steps=10_000, save_every=100, to="study.zarr")

    `over`: values by name, whose outer product are the points; with `zip` the axes are taken side by side, along the dimension
    `point`. `case(**values)` gives the initial data and the params of one point as `simulate` takes them; it is written
    for numbers, in NumPy or JAX, and evaluated for many points at once where that gives the same. It may take `rng`, a
    generator of NumPy, or `key`, of JAX: random numbers that depend on the point and on `seed` alone. `params`, if `case`
    gives none, and the other arguments are those of `simulate`.

    What is kept are the saved rows, or with `keep(sol)`, of the Solution of one trajectory, the numbers and arrays that it
    returns by name. `status` says of each point whether it has not been run (0), ran to the end (1), failed (2: NaN from
    there on) or was refused before its first step (3), `message` why. `units` and `coordinates` are as in `sol.to_xarray`.

    **The same call again goes on** after a kill, a crash or Ctrl-C, and runs what is missing; more values on the axes are added,
    and points that are there not run again. Bits do not depend on interruptions, nor with the native engine on the executor and
    the size of tasks. The store opens, by any zarr library, while the sweep runs. A store that belongs to other functions,
    another scheme or step is refused, unless `overwrite`.

    `executor`: None for batches on all processors here, a number of processes, an executor of `concurrent.futures` (one that
    would fork is replaced by as many new processes), a client of `dask.distributed`, or "dask". Tasks are sized to about
    `task_seconds`; one whose worker dies is run again, and after the third time left open and reported by a `RuntimeWarning`.
    `progress`: None for a bar in a terminal, True, False, or a function of (points done, points in all).

    Raises `TypeError` and `ValueError` for wrong arguments; where `case` or `keep` is wrong, naming the point; and `OSError`
    where the store cannot be written or another call is filling it. What was done is kept.
    """
    path = Path(to).absolute()
    refuse_place(path)
    check_kinds(system, scheme)
    executor = executors.checked(executor)
    axes = Axes.of(over, zip)
    options = {
        "step": positive(step, "step"),
        "steps": count(steps, "steps"),
        "save_every": count(save_every, "save_every"),
        "t0": finite(t0, "t0"),
        "max_iterations": count(max_iterations, "max_iterations"),
        "compensated": bool(compensated),
        "project": bool(project),
        "check_initial": bool(check_initial),
        "engine": engine,
    }
    engine_from(engine)
    task_seconds = positive(task_seconds, "task_seconds")
    whole = system if inputs is None else system.with_inputs(inputs)
    params = None if params is None else jax.tree.map(np.asarray, params)
    trial = tried(whole, scheme, axes, Case.of(case, tuple(axes.values), int(seed)), Keep.of(keep), options, params)
    if params is not None and "params" in trial.case.like:
        raise ValueError("params is given and case returns params, too: let case return all of them, or none.")
    if isinstance(engine, str):
        options["engine"] = trial.engine  # the same on every machine
    layout, named = arranged(axes, trial, units, coordinates)
    marks = _fingerprint(whole, scheme, axes, trial, options, params, int(seed))
    slots = executors.parallel(executor, trial.engine == "xla") if executor != "dask" else executors.parallel(None, False)
    grid = sized(axes, layout, trial, task_seconds, slots)
    layout = Layout(grid, layout.dims, layout.arrays)
    attributes = _attributes(system, scheme, axes, layout, options, marks)
    check_points(axes, trial.case)

    hold = Hold()
    try:
        layout, axes = _settled(path, hold, layout, axes, named, attributes, marks, overwrite)
        plan = Plan(
            folder=path,
            layout=layout,
            system=whole,
            scheme=scheme,
            case=trial.case,
            keep=trial.keep,
            options=options,
            params=params,
            filled=trial.engine == "xla",
        )
        left = open_points(path, layout)
        tasks = [_task(axes, layout.grid, index, mask) for index, mask in left.items()]
        before = counts(path)
        missing = sum(task.points for task in tasks)
        state = State(axes.size, axes.size - missing, before[2] + before[3])
        with reporting(progress, state, path.name) as changed, _going_on(path, state):
            given_up = _run(tasks, executor, plan, state, changed)
    finally:
        hold.release(path)
    if given_up:
        warnings.warn(
            f"{len(given_up)} of {len(tasks)} tasks failed {'three times'} and were left open, which the same call again tries "
            f"anew: {'; '.join(given_up[:3])}",
            RuntimeWarning,
            stacklevel=2,
        )
    return opened(path)


def arranged(axes: Axes, trial: Trial, units: Any, coordinates: Any) -> tuple[Layout, dict[str, tuple[Array, np.ndarray]]]:
    """What the store holds: its arrays over the points, not yet cut, and the axes with their values."""
    sol = trial.sol.replace(system=None)
    units = dict(units or {})
    own = {name: str(units.pop(name)) for name in list(units) if name in axes.values}
    said = describe(sol, units or None, coordinates)
    named = {}
    for name, values in axes.values.items():
        dims = axes.dims if axes.zipped else (name,)
        named[name] = Array(dims, (), TEXT if values.dtype.kind == "U" else values.dtype.name, {"units": own.get(name, "")}), values
    arrays = _kept(trial.keep, units) if trial.keep.function is not None else _rows(sol, said)
    inner = {dim for array in arrays.values() for dim in array.dims}
    for dim in ("time", "interval", "coordinate"):
        if dim in said.axes and dim in inner:
            axis = said.axes[dim]
            kind = TEXT if axis.values.dtype == object else "float64"
            named[dim] = Array((dim,), (), kind, dict(axis.about)), axis.values
    if both := sorted(arrays.keys() & named.keys()):
        raise ValueError(f"{both[0]!r} is the name of an axis and of what is kept: rename the axis in over, or what keep returns.")
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
        found[name] = Array(dims, like.shape, like.dtype.name, {"units": str(units.get(name, ""))})
    return found


def sized(axes: Axes, layout: Layout, trial: Trial, task_seconds: float, slots: int) -> Grid:
    """The grid cut into tasks of about so many seconds, as many as keep all slots busy, none too large for the memory."""
    least = DEVICE_BATCH if trial.engine == "xla" else LANES
    row_bytes = sum(array[0].nbytes for array in trial.sol.fields.values()) + layout.point_bytes
    by_time = task_seconds / max(trial.seconds, 1e-12)
    by_slots = axes.size / (TASKS_PER_SLOT * slots)
    points = max(min(by_time, max(by_slots, 0.1 * by_time)), least)
    return cut(axes.shape, int(max(1, min(points, TASK_BYTES / max(row_bytes, 1), axes.size))))


def _settled(
    path: Path, hold: Hold, layout: Layout, axes: Axes, named: Any, attributes: dict, marks: dict, overwrite: bool
) -> tuple[Layout, Axes]:
    """The store, held by this call: made, gone on with, or grown; its layout and axes."""
    if not path.exists():
        clear_leftovers(path)
    if path.exists():
        attributes_of(path) if not overwrite else None
        _take(path, hold)
        clear_leftovers(path)
        if not overwrite:
            there = _compared(path, axes, marks)
            if there is None:
                return layout_of(path), axes_of(path)
            old, places = layout_of(path), there
            _refuse_more_than_disk(path, layout, axes.size)
            with made(path, True) as beside:
                write_description(beside, layout, named, attributes)
                copy_points(path, old, beside, layout, places)
                hold.take(beside)
            return layout, axes
    _refuse_more_than_disk(path, layout, axes.size)
    try:
        with made(path, overwrite) as beside:
            write_description(beside, layout, named, attributes)
            hold.take(beside)
    except StoreError:
        if path.exists() and not overwrite:  # another call was quicker
            _take(path, hold)
        raise
    return layout, axes


def _take(path: Path, hold: Hold) -> None:
    if not os.access(path, os.W_OK):
        raise StoreError(f"the store {path} cannot be written (permission denied): make it writable, or choose another path.")
    try:
        mine = hold.take(path)
    except OSError as error:
        raise StoreError(f"the store {path} cannot be written ({error.strerror}): choose another path.") from error
    if not mine:
        raise StoreError(
            f"another call is filling the store {path} at this moment: wait until it has ended, or stop it; then the same call "
            "again goes on from there."
        )


def _compared(path: Path, axes: Axes, marks: dict[str, Any]) -> tuple[np.ndarray, ...] | None:
    """None where the store is that of this very call; the places of its points among those of this call where this one has
    more. Raises `ValueError` for the store of another sweep, with what differs."""
    there, old = attributes_of(path), axes_of(path)
    found = fingerprint.differences(json.loads(there["fingerprint"]), marks)
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


def _refuse_more_than_disk(path: Path, layout: Layout, points: int) -> None:
    wanted, free = points * layout.point_bytes, shutil.disk_usage(path.parent).free
    if wanted > free:
        raise StoreError(
            f"the store {path} would take {wanted / 2**30:.3g} GiB, and {free / 2**30:.3g} GiB of the disk are free: save fewer "
            "rows with save_every=, keep less with keep=, or choose another disk for to=."
        )


def _task(axes: Axes, grid: Grid, index: tuple[int, ...], mask: np.ndarray | None) -> Task:
    numbers = grid.numbers(index)
    values = axes.at(numbers.ravel())
    return Task(index, {name: axis.reshape(numbers.shape) for name, axis in values.items()}, mask)


def _run(tasks: list[Task], executor: Any, plan: Plan, state: State, changed: Callable[[], None]) -> list[str]:
    if not tasks:
        return []
    with executors.place(executor, plan) as place:
        return drive(tasks, place, executor, plan, state, changed)


@contextlib.contextmanager
def _going_on(path: Path, state: State) -> Iterator[None]:
    """Errors that end the sweep say how to go on."""
    words = lambda: f"{state}, kept in {path}: the same call again goes on from there"
    try:
        yield
    except KeyboardInterrupt:
        raise Interrupted(f"interrupted; {words()}.") from None
    except PlaceLost as error:
        raise PlaceLost(f"{error}; {words()}.") from error
    except StoreError as error:
        raise StoreError(error.errno or 0, f"{error} ({state}).") from error


def _fingerprint(
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
        "case": fingerprint.of_case(trial.case, axes.at(np.array([0]))),
        "keep": fingerprint.of_keep(trial.keep),
        "params": fingerprint.of_value(jax.tree.leaves(params)) if params is not None else "of case",
        "seed": seed,
        "engine": engine,
        **settings,
    }


def _attributes(system: Any, scheme: Any, axes: Axes, layout: Layout, options: dict, marks: dict[str, Any]) -> dict[str, Any]:
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
