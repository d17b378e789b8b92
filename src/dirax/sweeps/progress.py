"""How far a sweep is: a rich bar on standard error, the user's own function, or nothing."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from dirax.text.representation import counted


@dataclass
class State:
    """Points in all, done, failed among these, and left open because their task failed again and again."""

    points: int
    done: int
    failed: int = 0
    given_up: int = 0

    def __str__(self) -> str:
        parts = [f"{self.done} of {counted(self.points, 'point')} done"]
        parts += [f"{counted(self.failed, 'trajectory', 'trajectories')} failed"] * bool(self.failed)
        return ", ".join([*parts, *[f"{self.given_up} given up"] * bool(self.given_up)])


@contextmanager
def reporting(progress: Any, state: State, title: str) -> Iterator[Callable[[], None]]:
    """A function to be called whenever the state has changed. `progress`: None for a bar where standard error is a terminal,
    True, False, or a function of (points done, points in all)."""
    if callable(progress):

        def told() -> None:
            progress(state.done, state.points)

        yield told
        return
    if progress is False or (progress is None and not sys.stderr.isatty()):
        yield lambda: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TextColumn("{task.fields[counts]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=progress is None, speed_estimate_period=60) as bar:
        number = bar.add_task(title, total=state.points, completed=state.done, counts="")
        before = state.done

        def changed() -> None:
            task = bar.tasks[0]
            rate = (state.done - before) / max(task.elapsed or 0.0, 1e-9)
            counts = f"{state.done} done · {state.failed} failed · {state.points - state.done} left · {rate:.3g}/s"
            bar.update(number, completed=state.done, counts=counts)

        changed()
        yield changed
