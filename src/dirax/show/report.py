"""report(): solutions as one HTML file that needs nothing else: motion, plots, verdicts, the system as stated."""

import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from html import escape
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from dirax.diagnostics.report import Report
from dirax.diagnostics.verify import verify
from dirax.show import frames, page, series
from dirax.show.arrays import Arrays
from dirax.show.series import Run
from dirax.solution.atomic_files import checked_place, placed
from dirax.solution.saving import path_of
from dirax.solution.solution import Solution
from dirax.text.representation import shortened

PAGES = (".html", ".htm")
"""Endings of a page."""

SMALL = 1500
"""Rows and frames of a view in a notebook."""

VIEW_HEIGHT = 590
"""Of a view in a notebook, in dots."""


def report(
    solutions: Solution | Sequence[Solution],
    path: str | os.PathLike,
    *,
    scene: Any = None,
    names: Sequence[str] | None = None,
    title: str | None = None,
    symmetries: Mapping[str, Callable] | None = None,
    exact: Callable | bool = True,
    verdicts: bool | Report | Sequence[Report] = True,
    overwrite: bool = True,
) -> Path:
    """Write a page about a solution, or about several of one system side by side, and return its path.

    The file stands alone: it opens in any browser of today, from disk, without a network. It shows the motion (`scene`: a
    `dx.scene.Scene` or a list of its parts, the gallery's own by default), plots that move with it, the verdicts of
    `dx.verify` (`verdicts`: False for none, or reports made before), the system as stated and what was run.

    `names`: what to call the solutions, by default their schemes. `symmetries`: generators ξ(q) -> (n,) by name, as for
    `dx.verify`. `exact(t, params=…, **initial) -> (rows, n)`: a closed solution drawn beside; the gallery's own unless False.

    Raises `TypeError` for something that is not a Solution, `ValueError` for an ending other than .html, too long a name,
    solutions of different sizes or inside `jax.grad`, `jit` or `vmap`, `FileNotFoundError` where the folder does not exist,
    `FileExistsError` for a file that exists with overwrite=False.

        sol.report("disk.html")
        dx.report([plus, minus], "both.html", names=["(+)", "(−)"])
    """
    path = path_of(path, such="run.html")
    checked_path(path, PAGES, overwrite)
    several = checked_solutions(solutions)
    text = html(several, scene=scene, names=names, title=title, symmetries=symmetries, exact=exact, verdicts=verdicts)
    with placed(path, overwrite) as beside:
        beside.write_text(text, encoding="utf-8")
    return path


def html(
    solutions: Sequence[Solution],
    *,
    scene: Any = None,
    names: Sequence[str] | None = None,
    title: str | None = None,
    symmetries: Mapping[str, Callable] | None = None,
    exact: Callable | bool = True,
    verdicts: bool | Report | Sequence[Report] = True,
    small: bool = False,
) -> str:
    """The text of the page that `report` writes; a `small` one has the motion and two plots, of fewer rows."""
    first, example = solutions[0], getattr(solutions[0], "example", None)
    symmetries = symmetries or (dict(example.symmetries) if example is not None and not small else None)
    names = _names(solutions, names)
    labels = names if len(solutions) > 1 else ["computed" if first.batch is None else "trajectory"]
    runs = [run for k, sol in enumerate(solutions) for run in series.runs_of(sol, labels[k], k, symmetries)]
    if closed := _exact_run(first, exact, example):
        runs.append(closed)
    arrays = Arrays()
    budget = 0 if small else series.EXACT_BYTES // len(runs)
    described = [series.described(run, arrays, budget, SMALL if small else series.ROWS) for run in runs]
    main = np.asarray(first.fields.get("q", first.fields.get("x", next(iter(first.fields.values())))))
    given = scene if scene is not None else getattr(example, "scene", None)
    drawn = frames.scene_of(given, main.shape[-1])
    picture = frames.described(drawn, arrays, [(run.rows, run.params) for run in runs], SMALL if small else None)
    return page.text(
        title=title or str(first.metadata.get("title") or type(first.system).__name__),
        solutions=solutions,
        names=names,
        runs=runs,
        reports=_reports(solutions, verdicts, symmetries),
        provenance=provenance(solutions),
        plane=tuple(getattr(example, "plane", (0, 1))),
        source=str(getattr(example, "source", "")),
        data={"runs": described, "scene": picture},
        arrays=arrays,
        small=small,
    )


def notebook_view(sol: Solution) -> str:
    """A solution in a notebook: the motion and two plots, in a frame of their own."""
    text = html([sol], exact=False, verdicts=False, small=True)
    title = escape(f"The motion of {sol.metadata.get('title') or type(sol.system).__name__}")
    return (
        f'<iframe srcdoc="{escape(text)}" title="{title}" sandbox="allow-scripts" '
        f'style="width: 100%; height: {VIEW_HEIGHT}px; border: 0"></iframe>'
    )


def checked_path(path: Path, endings: Sequence[str], overwrite: bool) -> None:
    """Raise before the work for a path that cannot be written."""
    if path.suffix not in endings:
        raise ValueError(f"path must end in {' or '.join(e for e in endings if e != '.htm')}, but {str(path)!r} was given.")
    checked_place(path, overwrite)


def checked_solutions(solutions: Any) -> list[Solution]:
    """One solution, or several of one system, as a list."""
    several = [solutions] if isinstance(solutions, Solution) else list(solutions) if isinstance(solutions, Sequence) else []
    others = [sol for sol in several if not isinstance(sol, Solution)]
    if others or not several:
        what = f"{shortened(others[0])} in it" if others else shortened(solutions)
        raise TypeError(f"solutions must be a dirax Solution (from dx.simulate or dx.load) or a list of them, but got {what}.")
    for sol in several:
        sol.refuse_traced("make the report")
    sizes = {tuple((k, sol.fields[k].shape[-1]) for k in ("q", "x") if k in sol.fields) for sol in several}
    if len(sizes) > 1:
        raise ValueError(f"solutions side by side must be of one system, but they have {' and '.join(map(str, sizes))}.")
    return several


def _names(solutions: Sequence[Solution], names: Sequence[str] | None) -> list[str]:
    if names is None:
        whole = [page.scheme_text(sol) for sol in solutions]
        short = [text.partition("(")[0] for text in whole]
        return short if len(set(short)) == len(short) else whole
    if isinstance(names, str) or len(names) != len(solutions):
        raise ValueError(f"names must be one string for each of {len(solutions)} solutions, but {names!r} was given.")
    return [str(name) for name in names]


def _exact_run(sol: Solution, exact: Callable | bool, example: Any) -> Run | None:
    """The closed solution at the saved times of a single run."""
    function = exact if callable(exact) else getattr(example, "exact", None) if exact else None
    if function is None or sol.batch is not None or "q" not in sol.fields:
        return None
    initial = {name: np.asarray(value) for name, value in sol.initial.items() if name in ("q", "v")}
    if set(initial) != {"q", "v"}:
        return None
    t = np.asarray(sol.t)
    try:
        values = np.asarray(function(t - t[0], params=sol.params, **initial))
    except (ValueError, TypeError):
        if callable(exact):
            raise
        return None
    count = sol.fields["q"].shape[-1]
    if values.shape != (len(t), count):
        return None
    table = series.Table("state", series.coordinate_names(sol, count), values)
    return Run("exact", t, {"q": values, "t": t}, sol.params, {"state": table}, group=-1)


def _reports(solutions: Sequence[Solution], verdicts: Any, symmetries: Any) -> list[Report | None]:
    if verdicts is False:
        return [None] * len(solutions)
    if verdicts is True:
        return list[Report | None](verify(sol, symmetries=symmetries if "p" in sol.fields else None) for sol in solutions)
    given: list[Report | None] = [verdicts] if isinstance(verdicts, Report) else list(verdicts)
    if len(given) != len(solutions):
        raise ValueError(f"verdicts must be one report for each of {len(solutions)} solutions, but there are {len(given)}.")
    return given


def provenance(solutions: Sequence[Solution]) -> list[tuple[str, str]]:
    """What made the numbers, and a fingerprint of them: SHA-256 of all saved arrays, the first 16 hexadecimal digits."""
    try:
        installed = version("dirax")
    except PackageNotFoundError:  # a source tree that is not installed
        installed = "unknown"
    engines = dict.fromkeys(str(sol.stats.get("engine", "unknown")) for sol in solutions)
    versions = dict.fromkeys(str(sol.metadata.get("dirax_version", installed)) for sol in solutions)
    return [
        ("dirax", ", ".join(versions)),
        ("engine", ", ".join(engines)),
        ("fingerprint", ", ".join(fingerprint(sol) for sol in solutions)),
    ]


def fingerprint(sol: Solution) -> str:
    """The first 16 hexadecimal digits of SHA-256 over the times and the saved arrays with their names."""
    digest = hashlib.sha256(np.ascontiguousarray(sol.t, "<f8").tobytes())
    for name in sorted(sol.fields):
        digest.update(name.encode() + np.ascontiguousarray(sol.fields[name], "<f8").tobytes())
    return digest.hexdigest()[:16]
