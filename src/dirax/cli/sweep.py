"""What `dirax sweep` does: the sweep that a Python file defines, and how far the sweep of a store is."""

import contextlib
import inspect
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from dirax.cli.subject import namespace
from dirax.schemes.lagrange_dirac import LagrangeDAlembert
from dirax.solution.sweep_store import attributes_of
from dirax.sweeps.store import counts, layout_of
from dirax.sweeps.sweep import sweep

NEEDED = ("system", "over", "case", "step", "steps")
HERE = ("to", "executor", "progress", "overwrite")
"""Arguments of a sweep that the command line gives; the file may give `to`, too."""

STATUS_HEADER = ("points", "number")
NAMES = ("not run", "ok", "failed", "refused")


def run_file(file: Path | None, to: Path | None, workers: int | None, scheduler: str | None, overwrite: bool) -> dict[str, Any]:
    """Run the sweep of a file; its status afterwards. Raises `ValueError` for a file without one."""
    if file is None:
        raise ValueError("dirax sweep needs a Python file that defines a sweep, or --status STORE.")
    if workers is not None and scheduler is not None:
        raise ValueError("--workers and --scheduler exclude each other: the scheduler has workers of its own.")
    found = namespace(file)
    known = inspect.signature(sweep).parameters
    given = {name: value for name, value in found.items() if name in known and name not in HERE and not inspect.ismodule(value)}
    if missing := [name for name in NEEDED if name not in given]:
        raise ValueError(f"{file} does not define {', '.join(missing)}: a sweep needs {', '.join(NEEDED)}.")
    store = to or found.get("to")
    if store is None:
        raise ValueError("the store is not named: pass --to STORE.zarr, or define `to` in the file.")
    given.setdefault("scheme", LagrangeDAlembert())
    if given.get("zip") is zip:
        del given["zip"]
    with _executor(workers, scheduler) as executor, warnings.catch_warnings():
        warnings.showwarning = _shown
        sweep(**given, to=store, executor=executor, overwrite=overwrite)
    return status_of(Path(store))


def status_of(store: Path) -> dict[str, Any]:
    """How many points of a store have which status. Raises `ValueError` for what is no store of a sweep."""
    about, numbers = attributes_of(store), counts(store)
    found = {name: numbers[code] for code, name in enumerate(NAMES)}
    layout = layout_of(store)
    return {
        "store": str(store),
        "axes": dict(zip(layout.dims, layout.grid.shape, strict=True)),
        "points": sum(found.values()),
        **found,
        "scheme": about["scheme"],
        "steps": about["steps"],
    }


def status_rows(found: dict[str, Any]) -> list[tuple[str, str]]:
    """The same as lines of a table."""
    return [(name, f"{found[name]}") for name in ("points", *NAMES)]


@contextlib.contextmanager
def _executor(workers: int | None, scheduler: str | None) -> Iterator[Any]:
    if scheduler is None:
        yield workers
        return
    try:
        from distributed import Client
    except ImportError as error:
        raise ValueError("--scheduler needs dask.distributed: install dirax[dask].") from error
    try:
        client = Client(scheduler, timeout=20)
    except OSError as error:
        raise ValueError(f"the scheduler {scheduler} cannot be reached: {error}") from error
    with client:
        yield client


def _shown(message: Any, *_: Any, **__: Any) -> None:
    import sys

    print(f"dirax: {message}", file=sys.stderr)
