"""What `dirax run` does and shows: the run itself, its description, and a target that is refused before it."""

from pathlib import Path
from typing import Any

import numpy as np

from dirax.diagnostics.report import Report
from dirax.diagnostics.verify import verify
from dirax.gallery.example import Example
from dirax.schemes.step import AbstractScheme
from dirax.solution.atomic_files import checked_folder
from dirax.solution.saving import FORMATS
from dirax.solution.solution import Solution
from dirax.text.tables import plain


def run_and_verify(
    example: Example, scheme: AbstractScheme, options: dict[str, Any], out: Path | None, overwrite: bool, tell: Any
) -> tuple[Solution, Report]:
    """Run the example and verify it, if it could be saved in `out`; `tell(fraction, text)` hears of the progress."""
    if out is not None:
        refuse_target(out, overwrite)

    def steps_done(done: int, total: int) -> None:
        tell(done / total, f"{example.title}: {done} of {total} steps")

    sol = example.simulate(scheme, progress=steps_done, **options)
    tell(None, "verifying")
    return sol, verify(sol, symmetries=example.symmetries or None)


def saved(sol: Solution, out: Path | None, overwrite: bool) -> str:
    """Save a run where a path is given: why that is not done, empty if it is."""
    try:
        if out is not None:
            sol.save(out, overwrite=overwrite)
    except OSError as error:
        return str(error)
    return ""


def refuse_target(path: Path, overwrite: bool) -> None:
    """Raise before a run whose trajectory could not be saved in `path`."""
    if path.suffix not in FORMATS:
        raise ValueError(f"--out must end in {' or '.join(FORMATS)}, but {str(path)!r} was given.")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"the folder {path.parent} does not exist: create it, or choose another for --out.")
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} exists: pass --overwrite to replace it, or choose another path for --out.")
    checked_folder(path.parent)


def message(sol: Solution) -> str:
    """What went wrong in a run, empty if nothing did; of a batch, its first failure."""
    return sol.message if isinstance(sol.message, str) else next((text for text in sol.message if text), "")


def summary(example: Example, sol: Solution) -> str:
    """Three lines: the system, the scheme, how fast it ran."""
    stats = sol.stats
    unit = f" {example.time_unit}" if example.time_unit else ""
    speed = f", {1e6 * stats['run_seconds'] / stats['steps']:.3g} µs a step" if np.all(sol.ok) else ""
    done = f"{stats['steps']} steps of {float(sol.step):g}{unit} on the {stats['engine']} engine{speed}"
    source = "" if example.source == str(example.title) else f" ({example.source})"
    return f"{example.title}{source}\n{sol.scheme!r}\n{done}"


def description(example: Example, sol: Solution, report: Report, out: Path | None) -> dict[str, Any]:
    """The same and the report as plain Python values, fit for JSON."""
    field = "q" if "q" in sol.fields else "x"
    return plain(
        {
            "system": example.name,
            "title": example.title,
            "source": example.source,
            "scheme": repr(sol.scheme),
            "step": float(sol.step),
            "steps": sol.stats["steps"],
            "ok": np.asarray(sol.ok).tolist(),
            "message": sol.message,
            "t": sol.time_of(-1),
            field: np.asarray(sol.fields[field])[..., -1, :],
            "stats": sol.stats,
            "report": report.to_dict(),
            "saved": None if out is None else str(out),
        }
    )
