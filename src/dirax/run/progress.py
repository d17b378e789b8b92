"""Progress of a run: a rich bar, the user's own function, or nothing."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


def reported(progress: Any) -> Any:
    """What a run is told of its progress= as it is. Raises `TypeError` for what says nothing."""
    if isinstance(progress, bool) or callable(progress):
        return progress
    raise TypeError(f"progress must be True, False or a function of (steps done, steps in all), but {progress!r:.80} was given.")


@contextmanager
def reporting(progress: bool | Callable[[int, int], None], steps: int) -> Iterator[Callable[[int, int], None] | None]:
    """A function of (steps done, steps in all) for an engine to call, or None."""
    if callable(progress):
        yield progress
    elif not progress:
        yield None
    else:
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (TextColumn("simulating"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        with Progress(*columns, transient=True) as bar:
            task = bar.add_task("", total=steps)
            yield lambda done, total: bar.update(task, completed=done, total=total)
