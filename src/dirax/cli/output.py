"""What the commands show: progress, tables, errors. Results go to standard output, everything else to standard error."""

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import wraps
from typing import Any

import typer

REPORTED = (ValueError, TypeError, OSError)
"""Errors with a message for the user; any other is a mistake in dirax and shows its traceback."""

COLOURS = {
    "ok": "green",
    "agrees": "green",
    "holds": "green",
    "bounded": "green",
    "drifts": "yellow",
    "paper is wrong": "yellow",
    "VIOLATED": "bold red",
    "DIFFERS": "bold red",
    "DOES NOT HOLD": "bold red",
}


def with_messages(command: Callable) -> Callable:
    """A command whose errors become one or two sentences on standard error, and exit status 1."""

    @wraps(command)
    def run(*args: Any, **kwargs: Any) -> Any:
        try:
            return command(*args, **kwargs)
        except REPORTED as error:
            typer.echo(f"dirax: {_in_words(error)}", err=True)
            raise typer.Exit(1) from error
        except KeyboardInterrupt as end:
            typer.echo(f"dirax: {str(end) or 'interrupted.'}", err=True)
            raise typer.Exit(130) from None

    return run


def _in_words(error: Exception) -> str:
    """The message of an error; where it comes from the printing itself, as on a full disk, what it is about, too."""
    from dirax.solution.atomic_files import FULL, Unwritten  # imported when it is used

    if isinstance(error, OSError) and error.errno in FULL and not isinstance(error, Unwritten):
        return f"the results could not be written: {error.strerror}."
    return str(error)


@contextmanager
def progress_bar(task: str) -> Iterator[Callable[[float | None, str], None]]:
    """A bar on standard error, where that is a terminal: a function of (fraction done, or None if unknown; text)."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (BarColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        number = bar.add_task(task, total=None)

        def tell(fraction: float | None, text: str) -> None:
            bar.update(number, total=None if fraction is None else 1.0, completed=fraction or 0.0, description=text)

        yield tell


def show_table(title: str, header: Sequence[str], rows: Sequence[Sequence[str]], text: str, notes: Sequence[str] = ()) -> None:
    """A table that fits the terminal, verdicts coloured, and then the notes.

    Where the output is not a terminal, `text`, which says the same, is printed as it is.
    """
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console()
    if not console.is_terminal:
        typer.echo(text)
        return
    table = Table(title=title, title_justify="left", title_style="bold", box=SIMPLE_HEAD, pad_edge=False)
    for name in header:
        table.add_column(name, overflow="fold")
    for row in rows:
        table.add_row(*(Text(cell, style=COLOURS.get(cell, "")) for cell in row))
    console.print(table)
    for note in notes:
        console.print(Text(note))


def show_json(value: Any) -> None:
    """JSON on standard output, in ASCII where that cannot show everything."""
    everything = "utf" in (getattr(sys.stdout, "encoding", None) or "").lower()
    typer.echo(json.dumps(value, indent=2, ensure_ascii=not everything))
