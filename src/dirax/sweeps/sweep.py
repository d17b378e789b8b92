"""sweep(): a study of many points, run in batches into a store, and gone on with by the same call after whatever ended it."""

import contextlib
import os
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from dirax.engines.engine import AbstractEngine
from dirax.program.user_functions import refuse_traced
from dirax.run.scalars import count, finite, flag, positive, whole_number
from dirax.run.validate import check_kinds, engine_from
from dirax.schemes.step import AbstractScheme
from dirax.solution.flushed_files import Hold, StoreError
from dirax.solution.saving import path_of
from dirax.solution.sweep_store import opened
from dirax.sweeps import executors
from dirax.sweeps.arrange import arranged, sized
from dirax.sweeps.axes import Axes
from dirax.sweeps.case import Case
from dirax.sweeps.driver import drive
from dirax.sweeps.grid import Grid
from dirax.sweeps.keep import Keep
from dirax.sweeps.layout import Layout
from dirax.sweeps.progress import State, reporting
from dirax.sweeps.ranks import ranks
from dirax.sweeps.settle import attributes_for, fingerprint_of, joined, settled
from dirax.sweeps.store import counts, open_points, refuse_place
from dirax.sweeps.task import Plan, Task
from dirax.sweeps.trial import check_points, tried
from dirax.systems.system import AbstractSystem

if TYPE_CHECKING:
    from xarray import Dataset


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
    gives none, and the other arguments are those of `simulate`; `events` are not looked for.

    What is kept are the saved rows, or with `keep(sol)`, of the Solution of one trajectory, the numbers and arrays that it
    returns by name. `status` says of each point whether it has not been run (0), ran to the end (1), failed (2: NaN from
    there on) or was refused before its first step (3), `message` why. `units` and `coordinates` are as in `sol.to_xarray`.

    **The same call again goes on** after a kill, a crash or Ctrl-C, and runs what is missing; more values on the axes are added,
    and points that are there not run again. Bits do not depend on interruptions, nor with the native engine on the executor and
    the size of tasks. The store opens, by any zarr library, while the sweep runs. A store that belongs to other functions,
    another scheme or step is refused, unless `overwrite`.

    `executor`: None for batches on all processors here, a number of processes, an executor of `concurrent.futures` (one that
    would fork is replaced by as many new processes), a client of `dask.distributed`, or "dask". Tasks are sized to about
    `task_seconds`; where `jax.distributed` is initialized all its processes make the same call, and each runs its share of
    them. A task whose worker dies is run again, and after the third time left open and reported by a `RuntimeWarning`.
    `progress`: None for a bar in a terminal, True, False, or a function of (points done, points in all).

    Raises `TypeError` and `ValueError` for wrong arguments; where `case` or `keep` is wrong, naming the point; and `OSError`
    where the store cannot be written or another call is filling it. What was done is kept.
    """
    refuse_traced("dx.sweep", over, params, step)
    path = path_of(to, "to", "study.zarr").absolute()
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
        "compensated": flag(compensated, "compensated"),
        "project": flag(project, "project"),
        "check_initial": flag(check_initial, "check_initial"),
        "engine": engine,
    }
    engine_from(engine)
    seed, overwrite = whole_number(seed, "seed"), flag(overwrite, "overwrite")
    task_seconds = positive(task_seconds, "task_seconds")
    whole = system if inputs is None else system.with_inputs(inputs)
    params = None if params is None else jax.tree.map(np.asarray, params)
    trial = tried(whole, scheme, axes, Case.of(case, tuple(axes.values), seed), Keep.of(keep), options, params)
    if params is not None and "params" in trial.case.like:
        raise ValueError("params is given and case returns params, too: let case return all of them, or none.")
    if isinstance(engine, str):
        options["engine"] = trial.engine  # the same on every machine
    layout, named = arranged(axes, trial, units, coordinates)
    marks = fingerprint_of(whole, scheme, axes, trial, options, params, seed)
    slots = executors.parallel(executor, trial.engine == "xla") if executor != "dask" else executors.parallel(None, False)
    group = ranks()
    grid = sized(axes, layout, trial, task_seconds, slots * group.count)
    layout = Layout(grid, layout.dims, layout.arrays)
    attributes = attributes_for(system, scheme, axes, layout, options, marks)
    check_points(axes, trial.case)

    hold = Hold()
    try:
        make = lambda: settled(path, hold, layout, axes, named, attributes, marks, overwrite)
        layout, axes = group.agreed(make, lambda: joined(path, axes, marks))
        plan = Plan(
            folder=path,
            layout=layout,
            system=whole,
            scheme=scheme,
            case=trial.case,
            keep=trial.keep.typed(layout),
            options=options,
            params=params,
            filled=trial.engine == "xla",
        )
        left = open_points(path, layout)
        before = counts(path)
        missing = [_task(axes, layout.grid, index, mask) for index, mask in left.items()]
        done = axes.size - sum(task.points for task in missing)
        tasks = group.share(missing)
        state = State(done + sum(task.points for task in tasks), done, before[2] + before[3])
        with reporting(progress if group.number == 0 else False, state, path.name) as changed, _going_on(path, state):
            given_up = _run(tasks, executor, plan, state, changed)
            group.wait("done")
    finally:
        hold.release(path)
    if given_up:
        warnings.warn(
            f"{len(given_up)} of {len(tasks)} tasks failed three times and were left open, which the same call again tries "
            f"anew: {'; '.join(given_up[:3])}",
            RuntimeWarning,
            stacklevel=2,
        )
    return opened(path)


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
    except executors.PlaceLost as error:
        raise executors.PlaceLost(f"{error}; {words()}.") from error
    except StoreError as error:
        raise StoreError(error.errno or 0, f"{error} ({state}).") from error
