"""The tasks that wait, and how many of them make one call."""

from collections import deque
from collections.abc import Iterable

from dirax.sweeps.task import Task

LAST_CALLS = 2
"""Into so many calls for everything that runs at a time the last tasks are parted, so that all end together."""


class Queue:
    """Tasks in their order; those that may have ended a worker make a call of their own."""

    def __init__(self, tasks: Iterable[Task]):
        self._tasks, self._alone = deque(tasks), deque[Task]()
        self._seconds, self._ended = 0.0, 0

    def __len__(self) -> int:
        return len(self._tasks) + len(self._alone)

    def took(self, seconds: float) -> None:
        """Note the time of a task that has ended."""
        self._seconds += seconds
        self._ended += 1

    def taken(self, call_seconds: float, slots: int) -> list[Task]:
        """The tasks of the next call, which takes about so many seconds as far as is known; the queue must hold some."""
        if not self._tasks:
            return [self._alone.popleft()]
        size = 1
        if self._seconds > 0:
            size = min(call_seconds * self._ended / self._seconds, len(self._tasks) / (LAST_CALLS * slots))
        return [self._tasks.popleft() for _ in range(max(1, int(size)))]

    def put_back(self, tasks: list[Task]) -> None:
        """Tasks that were not run, in front of the others."""
        self._tasks.extendleft(reversed(tasks))

    def put_alone(self, tasks: list[Task]) -> None:
        """Tasks to be tried one a call."""
        self._alone.extend(tasks)
