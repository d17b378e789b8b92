"""The tasks of a sweep to their ends: given out, run again where a worker died, given up after the third time."""

import warnings
from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from typing import Any

from dirax.solution.flushed_files import StoreError
from dirax.sweeps.axes import PointError, described
from dirax.sweeps.case import in_words
from dirax.sweeps.executors import Place, PlaceLost, own_processes, parallel
from dirax.sweeps.progress import State
from dirax.sweeps.queue import Queue
from dirax.sweeps.task import Done, Plan, Task

ATTEMPTS = 3
"""How often a task is tried."""

LOOK = 0.2
"""Seconds between looks at a place that does not answer."""


def drive(tasks: Iterable[Task], place: Place, executor: Any, plan: Plan, state: State, changed: Callable[[], None]) -> list[str]:
    """Run all tasks; what became of those that failed three times, in words.

    Raises `PointError`, `StoreError` and `PlaceLost`; what is under way then is given up.
    """
    waiting, running = Queue(tasks), dict[Future, list[Task]]()
    tries: dict[Any, int] = {}
    given_up: list[str] = []
    spare: Place | None = None

    def ended(task: Task, outcome: Done | BaseException) -> None:
        if isinstance(outcome, Done):
            waiting.took(outcome.seconds)
            state.done += outcome.ok + outcome.failed + outcome.refused
            state.failed += outcome.failed + outcome.refused
        elif isinstance(outcome, PointError | StoreError):
            raise outcome
        else:
            tries[task.index] = tries.get(task.index, 0) + (ATTEMPTS if _tried_elsewhere(outcome) else 1)
            if tries[task.index] < ATTEMPTS:
                waiting.put_alone([task])
                return
            state.given_up += task.points
            first = {name: axis.ravel() for name, axis in task.values.items()}
            given_up.append(f"{task.points} points from {described(first)} on: {in_words(outcome)}")
        changed()

    try:
        while waiting or running:
            now = spare or place
            while waiting and len(running) < (slots := now.slots()):
                call = waiting.taken(now.call_seconds, slots)
                try:
                    running[now.submit(call)] = call
                except now.lost:
                    waiting.put_back(call)
                    spare = now = _spare(plan, executor)
            for future in wait(running, timeout=LOOK, return_when=FIRST_COMPLETED).done:
                call = running.pop(future)
                error = _error(future)
                if error is None:
                    for task, outcome in zip(call, future.result(), strict=True):
                        ended(task, outcome)
                elif isinstance(error, CancelledError):
                    raise PlaceLost("the executor has gone: it, or its scheduler, was ended")
                elif isinstance(error, place.lost):
                    spare = spare or _spare(plan, executor)
                    waiting.put_back(call)
                elif len(call) > 1:  # one of them is to blame
                    waiting.put_alone(call)
                else:
                    ended(call[0], error)
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
