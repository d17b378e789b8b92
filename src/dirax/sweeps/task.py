"""A task: the trajectories of one block, run as one batch where it is executed, and written into the store."""

import contextlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dirax.engines.threads import at_most
from dirax.run.failure_messages import brief
from dirax.run.simulate import simulate
from dirax.solution.solution import Solution
from dirax.solution.sweep_store import MESSAGE, STATUS
from dirax.sweeps.case import Case, Values
from dirax.sweeps.commit import commit
from dirax.sweeps.grid import Index
from dirax.sweeps.keep import Keep
from dirax.sweeps.layout import FAILED, OK, OPEN, REFUSED, Layout


class Stopped(Exception):
    """A run that was given up because the sweep ends."""


@dataclass(frozen=True, eq=False)
class Plan:
    """What all tasks have in common. `options` are those of `simulate`, the engine among them; `filled` says that a batch is
    filled up to the size of a block, for an engine that compiles anew for every size; `threads` are those of one batch."""

    folder: Path
    layout: Layout
    system: Any
    scheme: Any
    case: Case
    keep: Keep
    options: dict[str, Any]
    params: Any = None
    filled: bool = False
    threads: int | None = 1


@dataclass(frozen=True, eq=False)
class Task:
    """A block, the values of its points on every axis, each with the axes of the block, and which of them are to be run: all
    without a mask."""

    index: Index
    values: dict[str, np.ndarray]
    left: np.ndarray | None = None

    @property
    def shape(self) -> tuple[int, ...]:
        """That of the block."""
        return next(iter(self.values.values())).shape

    @property
    def mask(self) -> np.ndarray:
        """Which of the block's points are to be run."""
        return np.ones(self.shape, bool) if self.left is None else self.left

    @property
    def points(self) -> int:
        """How many trajectories are to be run."""
        return int(np.sum(self.mask))


@dataclass(frozen=True)
class Done:
    """How a task ended: how many trajectories ran to the end, failed, or were refused, and the seconds that it took."""

    index: Index
    ok: int
    failed: int
    refused: int
    seconds: float


@dataclass
class Rows:
    """What becomes of the points of a batch: arrays (B, …) by name, `status` and `message` among them."""

    arrays: dict[str, np.ndarray] = field(default_factory=dict)


def run_task(plan: Plan, task: Task, stopping: Callable[[], bool] | None = None) -> Done:
    """Run the trajectories of a task and write them. Raises `PointError`, `StoreError`, and `Stopped` where `stopping()` says
    so."""
    started = time.perf_counter()
    shape, mask = task.shape, task.mask
    values = {name: axis[mask] for name, axis in task.values.items()}
    with _in_context(plan):
        found = _filled_up(plan, values, stopping) if plan.filled else results(plan, values, stopping)
    inside = tuple(map(slice, shape))
    blocks = {}
    for name in plan.layout.arrays:
        old = plan.layout.blank(name) if task.left is None else plan.layout.read(plan.folder, name, task.index)
        if task.left is None and shape == plan.layout.grid.chunk:
            blocks[name] = found[name].reshape(shape + found[name].shape[1:])
            continue
        part = old[inside]
        part[mask] = found[name]
        old[inside] = part
        blocks[name] = old
    commit(plan.folder, plan.layout, task.index, blocks)
    return _counted(task, found[STATUS], time.perf_counter() - started)


def finished(plan: Plan, task: Task) -> Done | None:
    """How a task ended that is in the store already, run by a worker that died before it could say so."""
    if not (plan.folder / plan.layout.file(STATUS, task.index)).exists():
        return None
    status = plan.layout.read(plan.folder, STATUS, task.index)[tuple(map(slice, task.shape))][task.mask]
    return None if np.any(status == OPEN) else _counted(task, status, 0.0)


def _counted(task: Task, status: np.ndarray, seconds: float) -> Done:
    counts = np.bincount(status, minlength=4).tolist()
    return Done(task.index, counts[OK], counts[FAILED], counts[REFUSED], seconds)


def results(plan: Plan, values: Values, stopping: Callable[[], bool] | None = None) -> dict[str, np.ndarray]:
    """The arrays (B, …) of trajectories at these points.

    A batch that is refused before its first step is halved until the points are found that are to blame; the others do not
    depend on them.
    """
    data, params = plan.case.at(values)
    batched = params is not None
    size = len(next(iter(data.values())))

    def part(low: int, high: int) -> dict[str, np.ndarray]:
        own = {name: axis[low:high] for name, axis in values.items()}
        given: dict[str, Any] = {name: array[low:high] for name, array in data.items()}
        shared = jax.tree.map(lambda leaf: leaf[low:high], params) if batched else plan.params
        try:
            sol = simulate(
                plan.system,
                plan.scheme,
                **given,
                params=shared,
                batch_params=batched,
                progress=_listener(stopping),
                **plan.options,
            )
        except ValueError as error:
            if high - low == 1:
                return _refused(plan, str(error))
            middle = (low + high) // 2
            halves = part(low, middle), part(middle, high)
            return {name: np.concatenate([half[name] for half in halves]) for name in halves[0]}
        if stopping is not None and stopping():
            raise Stopped
        return _kept(plan, sol, own)

    return part(0, size)


def _filled_up(plan: Plan, values: Values, stopping: Callable[[], bool] | None) -> dict[str, np.ndarray]:
    """The same with the last point repeated until the batch has the size of a block."""
    size = len(next(iter(values.values())))
    more = np.minimum(np.arange(max(size, plan.layout.grid.points)), size - 1)
    found = results(plan, {name: axis[more] for name, axis in values.items()}, stopping)
    return {name: array[:size] for name, array in found.items()}


def _kept(plan: Plan, sol: Solution, values: Values) -> dict[str, np.ndarray]:
    kept = plan.keep.at(sol, values)
    ok = np.asarray(sol.ok)
    texts = np.array([*sol.message, ""], object)[:-1]
    about = {STATUS: np.where(ok, OK, FAILED).astype(np.int8), MESSAGE: texts}
    return {name: kept[name] for name in plan.layout.arrays if name in kept} | about


def _refused(plan: Plan, message: str) -> dict[str, np.ndarray]:
    blank = {n: np.full((1, *a.inner), a.fill, a.dtype) for n, a in plan.layout.arrays.items() if n not in (STATUS, MESSAGE)}
    text = np.empty(1, object)
    text[0] = message
    return blank | {STATUS: np.full(1, REFUSED, np.int8), MESSAGE: text}


def _listener(stopping: Callable[[], bool] | None) -> Any:
    if stopping is None:
        return False

    def listen(done: int, total: int) -> None:
        if stopping():
            raise Stopped

    return listen


@contextlib.contextmanager
def _in_context(plan: Plan) -> Iterator[None]:
    tokens = at_most.set(plan.threads), brief.set(True)
    try:
        yield
    finally:
        at_most.reset(tokens[0])
        brief.reset(tokens[1])
