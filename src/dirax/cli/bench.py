"""What `dirax bench` times, and where its results go."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path

from dirax import gallery
from dirax.cli.subject import INITIAL
from dirax.diagnostics.bench.machines import Machines, bench_machines
from dirax.diagnostics.bench.measure import Bench, bench
from dirax.diagnostics.bench.subject import Subject
from dirax.gallery.example import Example
from dirax.solution.atomic_files import checked_place, write_text
from dirax.solution.style import save_figure

LONGEST = 2000
"""Most steps of a timed trajectory, unless others are asked for."""

QUICK, QUICK_STEPS, QUICK_REPEATS = ("kepler", "rolling-disk", "vortices"), 100, 2
"""What `--quick` times where nothing else is asked for."""

MACHINES = (
    *("bicycle", "euler-disk", "rattleback", "tippe-top", "chaplygin-sphere", "n-trailer", "trikke", "snakeboard-gait"),
    *("robot-arm", "andrews-squeezer", "four-bar", "bricard", "flyball-governor", "n-four-bar", "car-axis", "slider-crank"),
)
QUICK_MACHINES = ("car-axis", "euler-disk")

PICTURES = (".png", ".svg", ".pdf")


def run_bench(
    names: Sequence[str],
    repeats: int | None,
    quick: bool,
    tell: Callable[[float | None, str], None] | None = None,
    steps: int | None = None,
) -> Bench:
    """`bench` of the systems of the gallery of these names, of all of them without names; their runs are cut after `steps`.

    Raises `ValueError` for an unknown name, and for fewer than one repeat.
    """
    chosen = [gallery.get(name) for name in (names or (QUICK if quick else gallery.names()))]
    longest = steps or (QUICK_STEPS if quick else LONGEST)
    return bench([subject(e, longest) for e in chosen], repeats or (QUICK_REPEATS if quick else 7), tell)


def run_machines(
    names: Sequence[str],
    repeats: int | None,
    quick: bool,
    tell: Callable[[float | None, str], None] | None = None,
    steps: int | None = None,
) -> Machines:
    """`bench_machines` of these machines, of all of them without names.

    Raises `ValueError` for a system of the gallery that is no machine.
    """
    chosen = [gallery.get(name) for name in (names or (QUICK_MACHINES if quick else MACHINES))]
    others = [example.name for example in chosen if example.name not in MACHINES]
    if others:
        raise ValueError(f"{others[0]!r} is no machine of the gallery: there are {', '.join(MACHINES)}.")
    if "bicycle" in [example.name for example in chosen]:
        from dirax.gallery.bicycle import MANOEUVRES

        chosen += MANOEUVRES
    return bench_machines(chosen, repeats or (QUICK_REPEATS if quick else 5), steps or (QUICK_STEPS if quick else 1000), tell)


def subject(example: Example, longest: int) -> Subject:
    """The example's own run, cut after `longest` steps."""
    return Subject(
        name=example.name,
        system=example.system,
        scheme=example.scheme,
        initial={name: value for name, value in example.initial.items() if name in INITIAL},
        step=float(example.step),
        steps=min(example.steps, longest),
        params=example.params,
        project=bool(example.initial.get("project", False)),
    )


def check_targets(table: Path | None, picture: Path | None) -> None:
    """Raise before the measurement for files that could not be written."""
    if picture is not None and picture.suffix not in PICTURES:
        raise ValueError(f"--plot must end in {', '.join(PICTURES)}, but {str(picture)!r} was given.")
    for path in (table, picture):
        if path is not None:
            checked_place(path, True, lambda path: not path.is_dir())


def write_json(found: Bench | Machines, table: Path) -> None:
    """Everything measured, as JSON. Raises `OSError`."""
    write_text(table, json.dumps(found.to_dict(), indent=1, ensure_ascii=False) + "\n")


def store(found: Bench, table: Path | None, picture: Path | None) -> None:
    """Write the JSON file and the picture, each where a path is given."""
    if table is not None:
        write_json(found, table)
    if picture is not None:
        save_figure(found.plot(), picture)
