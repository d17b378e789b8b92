"""The tasks of a sweep to their ends: given out, run again where a worker died, given up after the third time."""

import warnings
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from typing import Any

from dirax.sweeps.axes import PointError, described
from dirax.sweeps.case import in_words
from dirax.sweeps.commit import StoreError
from dirax.sweeps.executors import Place, PlaceLost, own_processes, parallel
from dirax.sweeps.progress import State
from dirax.sweeps.task import Plan, Task

ATTEMPTS = 3
"""How often a task is tried."""

LOOK = 0.2
"""Seconds between looks at a place that does not answer."""


def drive(tasks: Iterable[Task], place: Place, executor: Any, plan: Plan, state: State, changed: Callable[[], None]) -> list[str]:
    """Run all tasks; what became of those that failed three times, in words.

    Raises `PointError`, `StoreError` and `PlaceLost`; what is under way then is given up.
    """
    waiting, running = deque(tasks), {}
    tries: dict[Any, int] = {}
    given_up: list[str] = []
    spare: Place | None = None
    try:
        while waiting or running:
            now = spare or place
            while waiting and len(running) < now.slots():
                task = waiting.popleft()
                try:
                    running[now.submit(task)] = task
                except now.lost:
                    waiting.appendleft(task)
                    spare = now = _spare(plan, executor)
            ended, _ = wait(running, timeout=LOOK, return_when=FIRST_COMPLETED)
            for future in ended:
                task = running.pop(future)
                error = _error(future)
                if error is None:
                    done = future.result()
                    state.done += done.ok + done.failed + done.refused
                    state.failed += done.failed + done.refused
                    changed()
                elif isinstance(error, PointError | StoreError):
                    raise error
                elif isinstance(error, CancelledError):
                    raise PlaceLost("the executor has gone: it, or its scheduler, was ended")
                elif isinstance(error, place.lost) and spare is None:
                    spare = _spare(plan, executor)
                    waiting.append(task)
                elif isinstance(error, place.lost):
                    waiting.append(task)
                else:
                    tries[task.index] = tries.get(task.index, 0) + (ATTEMPTS if _tried_elsewhere(error) else 1)
                    if tries[task.index] < ATTEMPTS:
                        waiting.append(task)
                        continue
                    state.given_up += task.points
                    first = {name: axis.ravel() for name, axis in task.values.items()}
                    given_up.append(f"{task.points} points from {described(first)} on: {in_words(error)}")
                    changed()
    finally:
        for future in running:
            future.cancel()
        for used in filter(None, (place, spare)):
            used.end()
    return given_up


def _error(future: Future) -> BaseException | None:
    try:
        return future.exception()
    except CancelledError as error:
        return error


def _tried_elsewhere(error: BaseException) -> bool:
    """Whether the scheduler of dask has tried a task on several workers itself, all of which died."""
    return type(error).__name__ == "KilledWorker"


def _spare(plan: Plan, executor: Any) -> Place:
    count = parallel(executor, False)
    warnings.warn(
        f"the executor that was given broke when one of its workers died: the sweep goes on in {count} processes of its own.",
        RuntimeWarning,
        stacklevel=2,
    )
    return own_processes(plan, count)
