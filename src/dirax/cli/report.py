"""What `dirax report` does: a solution, run or loaded, as a page for a browser."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dirax import gallery
from dirax.cli.schemes import scheme_from_text
from dirax.cli.subject import changed, subject
from dirax.show.report import PAGES, checked_path, report
from dirax.solution.loading import load
from dirax.solution.saving import FORMATS
from dirax.solution.solution import Solution


def write_report(
    name: str, settings: Sequence[str], schemes: Sequence[str], out: Path | None, overwrite: bool, tell: Any
) -> Path:
    """Run the named system, or load the named file, and write the page; `tell(fraction, text)` hears of the progress."""
    stem = Path(name).stem
    path = Path(f"{stem}.html") if out is None else out
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} exists: pass --overwrite to replace it, or choose another path for --out.")
    checked_path(path, PAGES, True)
    if Path(name).suffix in FORMATS:
        if settings or schemes:
            raise ValueError(f"{name} holds a trajectory that was run already: --set and --scheme are for systems.")
        solutions = [loaded(Path(name))]
    else:
        solutions = runs(name, settings, schemes, tell)
    tell(None, "verifying and drawing")
    return report(solutions, path, names=list(schemes) if len(schemes) > 1 else None)


def loaded(path: Path) -> Solution:
    """The solution in a file, with its system where that is one of the gallery."""
    sol = load(path)
    name = sol.metadata.get("example")
    if name not in gallery.names():
        return sol
    example = gallery.get(str(name))
    sol = load(path, system=example.system)
    sol.example = example
    return sol


def runs(name: str, settings: Sequence[str], schemes: Sequence[str], tell: Any) -> list[Solution]:
    """One solution a scheme."""
    example, options = changed(subject(name), settings)
    chosen = [scheme_from_text(text) for text in schemes] or [example.scheme]
    solutions = []
    for scheme in chosen:
        tell(None, f"{example.title}: {type(scheme).__name__}")
        solutions.append(example.simulate(scheme, **options))
    return solutions
