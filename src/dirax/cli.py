"""The command line: `dirax list | run | compare | reproduce`."""

import json as jsonlib
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

app = typer.Typer(
    name="dirax", no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False,
    help="Geometric integrators from discrete Dirac mechanics: run systems, compare schemes, reproduce the papers.",
)  # fmt: skip

Json = Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="NAME=VALUE", help="step, steps, initial data or a parameter; may be repeated."),
]
Scheme = Annotated[
    str | None,
    typer.Option(help='plus, minus, midpoint, trapezoidal, method1, method2, or a call such as "DiscreteDirac(map=Theta(0.5))".'),
]


@app.command("list")
def list_systems(json: Json = False) -> None:
    """List the systems of the gallery."""
    from dirax import gallery
    from dirax.diagnostics.table import text_table

    examples = [gallery.get(name) for name in gallery.names()]
    rows = [(e.name, e.title, str(len(e.coordinates)), type(e.scheme).__name__, e.source) for e in examples]
    header = ("name", "system", "n", "scheme", "source")
    print(
        jsonlib.dumps([dict(zip(header, row, strict=True)) for row in rows], ensure_ascii=False)
        if json
        else text_table(header, rows)
    )


@app.command()
def run(
    target: Annotated[
        str, typer.Argument(metavar="NAME|FILE.py", help="A system of the gallery, or a file defining `system` and `initial`.")
    ],
    settings: Settings = None,
    scheme: Scheme = None,
    out: Annotated[Path | None, typer.Option(help="Save the trajectory here (.zarr or .nc).")] = None,
    json: Json = False,
) -> None:
    """Run a system and verify the trajectory."""
    import dirax
    from dirax.cli_input import changed, find_example, parse_scheme, parse_settings

    with refusals():
        example = find_example(target)
        keywords = changed(example, parse_settings(settings or []))
        chosen = parse_scheme(scheme) if scheme else None
        if out is not None and out.exists():
            raise ValueError(f"{out} exists already: choose another --out, or remove it.")
        with progress_bar(f"running {example.name}") as tell:
            sol = example.simulate(chosen, progress=tell, **keywords)
        report = dirax.verify(sol, symmetries=dict(example.symmetries) or None)
        if out is not None:
            sol.save(out)
    if json:
        stats = {name: value for name, value in sol.stats.items() if isinstance(value, (int, float, str))}
        result = {"name": example.name, "ok": bool(sol.ok), "message": sol.message, "stats": stats, "report": report.to_dict()}
        print(jsonlib.dumps(result, ensure_ascii=False))
    else:
        print(f"{example.title} ({example.source})\n{sol!r}\n\n{report}")
        if out is not None:
            print(f"\nsaved in {out}")
    if not sol.ok:
        stop(str(sol.message))


@app.command()
def compare(
    target: Annotated[str, typer.Argument(metavar="NAME|FILE.py", help="A system of the gallery, or your own file.")],
    settings: Settings = None,
    scheme: Annotated[list[str] | None, typer.Option(help="A scheme to compare; may be repeated.")] = None,
    json: Json = False,
) -> None:
    """Compare schemes on a system: order, error, energy drift, constraint, time per step."""
    import dirax
    from dirax.cli_input import changed, find_example, parse_scheme, parse_settings

    with refusals():
        example = find_example(target)
        names = scheme or default_schemes(example.system)
        schemes = {name: parse_scheme(name) for name in names} or {type(example.scheme).__name__: example.scheme}
        keywords: dict[str, Any] = {"step": example.step, "steps": example.steps, "params": example.params, **example.initial}
        changes = changed(example, parse_settings(settings or []))
        keywords["params"] = {**(example.params or {}), **changes.pop("params", {})} or None
        keywords.update(changes)
        with progress_bar(f"comparing on {example.name}"):
            table = dirax.compare(example.system, schemes, **keywords)
    print(jsonlib.dumps(table.to_dict(), ensure_ascii=False) if json else table)
    failed = [entry.scheme for entry in table.entries if entry.ended != "ok"]
    if failed:
        stop(f"{', '.join(failed)} did not reach the end: {table[failed[0]].note or table[failed[0]].ended}")


def default_schemes(system: Any) -> list[str]:
    """Names of the schemes that discretize a system."""
    import dirax

    if isinstance(system, dirax.LagrangeDirac):
        return ["plus", "minus", "midpoint", "method1", "method2"] if system.one_forms else ["plus", "midpoint", "trapezoidal"]
    if isinstance(system, dirax.NonholonomicMechanics | dirax.PhaseSpaceLagrangian):
        return ["method1", "method2"]
    return []


@app.command()
def reproduce(
    paper: Annotated[str, typer.Argument(metavar="PAPER|all", help="PY, RL, BLM or all.")] = "all",
    out: Annotated[Path, typer.Option(help="Folder for the figures and the tables.")] = Path("out"),
    json: Json = False,
) -> None:
    """Draw a paper's figures again and print a table: quantity, paper, computed, verdict."""
    from dirax.gallery.reproduction import reproduce as reproduced
    from dirax.gallery.reproduction import tables_as_json

    with refusals(), progress_bar("reproducing", fractions=True) as tell:
        results = reproduced(paper, out, tell)
    print(tables_as_json(results) if json else "\n\n\n".join(map(str, results)))
    if not json:
        print(f"\nfigures and tables are in {out}")
    if not all(result.ok for result in results):
        stop("a number differs from the paper's where dirax should reproduce it: see the verdicts.")


@contextmanager
def refusals() -> Iterator[None]:
    """Show a refusal — wrong input, a file that cannot be read or written — as its sentence, with exit status 1."""
    try:
        yield
    except (ValueError, TypeError, OSError) as error:
        stop(str(error))


def stop(message: str) -> None:
    """End with a message on standard error and exit status 1."""
    print(f"dirax: {message}", file=sys.stderr)
    raise typer.Exit(1)


@contextmanager
def progress_bar(text: str, fractions: bool = False) -> Iterator[Any]:
    """A function of (done, in all), or of (fraction, text), that shows a bar on standard error once a second has passed."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    bar = Progress(
        TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), console=Console(stderr=True), transient=True
    )
    task, started = bar.add_task(text, total=1.0), time.monotonic()

    def tell(done: float, detail: Any) -> None:
        if time.monotonic() - started > 1.0:
            bar.start()
        if fractions:
            bar.update(task, completed=done, description=str(detail))
        else:
            bar.update(task, completed=done / detail)

    try:
        yield tell
    finally:
        bar.stop()


def main() -> None:
    """The entry point `dirax`."""
    app()


if __name__ == "__main__":
    main()
