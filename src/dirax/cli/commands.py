"""The commands of the program `dirax`: list the gallery, run a system, compare schemes, reproduce the papers, measure speed."""

from pathlib import Path
from typing import Annotated

import typer

from dirax.cli.output import progress_bar, show_json, show_table, with_messages

app = typer.Typer(
    name="dirax",
    help="Geometric integrators from discrete Dirac mechanics: run a system, verify its structure, reproduce the papers.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

System = Annotated[str, typer.Argument(help="a name that `dirax list` shows, or a Python file", show_default=False)]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="change step, steps, save_every, engine, initial data (q=[0,1], v[0]=2) or a parameter; may be repeated",
        show_default=False,
    ),
]
Json = Annotated[bool, typer.Option("--json", help="print JSON instead of a table")]
SCHEME_HELP = (
    "plus, minus, midpoint, trapezoidal, method1, method2, gradient, poincare, "
    "or a class: \"Composition(LagrangeDAlembert(), 'suzuki4')\""
)


@app.command("list")
@with_messages
def list_systems(as_json: Json = False) -> None:
    """List the systems of the gallery, and the papers that can be reproduced."""
    from dirax import gallery
    from dirax.gallery.listing import listing
    from dirax.gallery.reproduction import papers

    if as_json:
        keys = ("name", "title", "source", "step", "steps")
        examples = [gallery.get(name) for name in gallery.names()]
        described = [{key: getattr(e, key) for key in keys} | {"scheme": repr(e.scheme)} for e in examples]
        show_json({"systems": described, "papers": list(papers())})
        return
    rows = listing()
    widths = [max(len(row[i]) for row in rows) for i in (0, 1)]
    text = "\n".join(f"{name:{widths[0]}}  {title:{widths[1]}}  {source}" for name, title, source in rows)
    show_table("", ("name", "system", "source"), rows, text)
    typer.echo(f"\ndirax run NAME runs one of them; dirax reproduce takes {', '.join(papers())} or all.")


@app.command()
@with_messages
def run(
    system: System,
    settings: Settings = None,
    scheme: Annotated[str | None, typer.Option(help=SCHEME_HELP, show_default=False)] = None,
    out: Annotated[Path | None, typer.Option(help="save the trajectory: PATH.zarr or PATH.nc", show_default=False)] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace the file that --out names")] = False,
    as_json: Json = False,
) -> None:
    """Run a system of the gallery, or of your own file, and verify the structure of the trajectory.

    A file defines `system` and `initial`, a dict of initial data (q= and v=, or another pair that dirax.simulate takes), and, if
    it likes, `scheme`, `step`, `steps`, `params`, `events`, `inputs` and the other arguments of dirax.simulate. The exit status
    is 1 when the trajectory failed or a structure is violated; a drifting energy is a finding, not a failure.
    """
    from dirax.cli.running import description, message, run_and_verify, saved, summary
    from dirax.cli.schemes import scheme_from_text
    from dirax.cli.subject import changed, subject
    from dirax.diagnostics.report import HEADER, VIOLATED

    example, options = changed(subject(system), settings or ())
    chosen = scheme_from_text(scheme) if scheme else example.scheme
    with progress_bar(f"{example.title}: compiling") as tell:
        sol, report = run_and_verify(example, chosen, options, out, overwrite, tell)
        unsaved = saved(sol, out, overwrite)
    if as_json:
        show_json(description(example, sol, report, None if unsaved else out))
    else:
        typer.echo(f"{summary(example, sol)}\n")
        show_table(report.title, HEADER, [line.cells() for line in report.lines], str(report))
        if out is not None and not unsaved:
            typer.echo(f"saved in {out}")
    for text in filter(None, (message(sol), unsaved)):
        typer.echo(f"dirax: {text}", err=True)
    if unsaved or any(line.verdict == VIOLATED for line in report.lines):
        raise typer.Exit(1)


@app.command()
@with_messages
def report(
    system: Annotated[
        str, typer.Argument(help="a name that `dirax list` shows, a Python file, or a saved solution", show_default=False)
    ],
    settings: Settings = None,
    scheme: Annotated[
        list[str] | None, typer.Option(help=f"a scheme, may be repeated: {SCHEME_HELP}", show_default=False)
    ] = None,
    out: Annotated[Path | None, typer.Option(help="the page [default: NAME.html]", show_default=False)] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace the file that exists")] = False,
    opened: Annotated[bool, typer.Option("--open", help="open the page in the browser")] = False,
) -> None:
    """Write one HTML file about a run: the motion in three dimensions, plots, verdicts, the system. Several schemes are
    shown side by side."""
    from dirax.cli.report import write_report

    with progress_bar("starting") as tell:
        path = write_report(system, settings or (), scheme or (), out, overwrite, tell)
    typer.echo(f"the report is in {path}")
    if opened:
        typer.launch(path.resolve().as_uri())


@app.command()
@with_messages
def export(
    kind: Annotated[str, typer.Argument(help="what to write: c", show_default=False)],
    system: System,
    settings: Settings = None,
    scheme: Annotated[str | None, typer.Option(help=SCHEME_HELP, show_default=False)] = None,
    out: Annotated[Path | None, typer.Option(help="the file [default: NAME.c]", show_default=False)] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace the file that exists")] = False,
) -> None:
    """Write the run of a system as one C file that depends on nothing, and prints the rows of the run with their bits."""
    from dirax.cli.export import write_c

    if kind != "c":
        raise ValueError(f"export writes c, but {kind!r} was asked for.")
    with progress_bar("writing"):
        path = write_c(system, settings or (), scheme, out, overwrite)
    typer.echo(f"the program is in {path}; its first lines say how it is compiled")


@app.command()
@with_messages
def compare(
    system: System,
    settings: Settings = None,
    scheme: Annotated[
        list[str] | None, typer.Option(help=f"a scheme to compare, may be repeated: {SCHEME_HELP}", show_default=False)
    ] = None,
    as_json: Json = False,
) -> None:
    """Compare schemes on a system: order, error, energy drift, constraint, time of a step."""
    from dirax.cli.comparison import compare_schemes
    from dirax.cli.subject import changed, subject
    from dirax.diagnostics.compare import HEADER

    example, options = changed(subject(system), settings or ())
    with progress_bar(f"{example.title}: comparing schemes"):
        found = compare_schemes(example, scheme or (), options)
    notes = [f"{entry.scheme}: {entry.note}" for entry in found.entries if entry.note]
    if as_json:
        show_json(found.to_dict())
    else:
        cells = [entry.cells() for entry in found.entries]
        show_table(f"{example.title}, {found.title}", HEADER, cells, str(found), notes)
    failed = [entry for entry in found.entries if entry.ended != "ok"]
    for entry in failed:
        typer.echo(f"dirax: {entry.scheme}: {entry.ended}.", err=True)
    if failed:
        raise typer.Exit(1)


@app.command()
@with_messages
def reproduce(
    paper: Annotated[str, typer.Argument(help="the short name of a paper that `dirax list` shows, or all")] = "all",
    out: Annotated[Path, typer.Option(help="the folder for the figures and the tables")] = Path("out"),
    as_json: Json = False,
) -> None:
    """Reproduce a paper: print a table of its quantities, theirs against computed, and draw its figures again.

    With `all`, index.html in the folder shows everything, and the systems of the gallery in motion.
    The exit status is 1 when a quantity differs from what it should be.
    """
    import json

    from dirax.gallery.exhibition import write_index
    from dirax.gallery.reproduction import HEADER, tables_as_json
    from dirax.gallery.reproduction import reproduce as reproductions
    from dirax.gallery.theorems import HEADER as THEOREMS

    shown = f"figures and tables are in {out}"
    with progress_bar("starting") as tell:
        results = reproductions(paper, out, tell)
        if paper.lower() == "all":
            shown += f", {write_index(results, out, tell)} shows them"
    if as_json:
        show_json(json.loads(tables_as_json(results)))
    else:
        for result in results:
            marks, notes = result.notes()
            cells = [(r.quantity, r.paper, r.computed, r.verdict, mark) for r, mark in zip(result.rows, marks, strict=True)]
            show_table(f"[{result.paper}] {result.title}", (*HEADER, "note"), cells, f"{result}\n", notes)
            if result.theorems:
                proved = [theorem.cells for theorem in result.theorems]
                show_table(f"[{result.paper}] theorems", THEOREMS, proved, "")
        typer.echo(shown)
    if not all(result.ok for result in results):
        typer.echo(
            "dirax: a quantity differs from what it should be, see DIFFERS in the table, or a theorem does not hold.", err=True
        )
        raise typer.Exit(1)


@app.command()
@with_messages
def bench(
    names: Annotated[
        list[str] | None, typer.Argument(help="systems that `dirax list` shows; all of them without a name", show_default=False)
    ] = None,
    repeats: Annotated[int | None, typer.Option(min=1, help="interleaved repeats [default: 7]", show_default=False)] = None,
    steps: Annotated[
        int | None, typer.Option(min=1, help="most steps of a timed trajectory [default: 2000]", show_default=False)
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="three systems, 100 steps, 2 repeats, unless given")] = False,
    machines: Annotated[
        bool, typer.Option("--machines", help="machines alone: time, end error, drift of energy and constraints")
    ] = False,
    table: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="store everything measured in FILE", show_default=False)
    ] = None,
    picture: Annotated[
        Path | None, typer.Option("--plot", metavar="FILE", help="draw it: FILE.png, .svg or .pdf", show_default=False)
    ] = None,
) -> None:
    """Time the engines beside other programs: plain JAX, C generated by CasADi, heyoka, SciPy's DOP853 and diffrax.

    Each is a column if it is installed, as a ratio to one lane of the native engine. The libraries for ordinary
    differential equations run at the end error of the scheme. What cannot run is left out, and the reason said. The whole
    gallery takes about a quarter of an hour. The exit status is 1 when a system could not be timed.
    With --machines MuJoCo, Exudyn and pinocchio are columns where they are installed, which say what they cannot state.
    """
    from dirax.cli.bench import check_targets, run_bench, run_machines, store, write_json

    check_targets(table, picture)
    if machines:
        if picture is not None:
            raise ValueError("--machines is a table, which --plot does not draw: leave --plot out.")
        with progress_bar("starting") as tell:
            measured = run_machines(names or (), repeats, quick, tell, steps)
        show_table(measured.title, measured.header, measured.cells(), str(measured), measured.notes())
        if table is not None:
            write_json(measured, table)
        return
    with progress_bar("starting") as tell:
        found = run_bench(names or (), repeats, quick, tell, steps)
    show_table(found.title, found.header, found.cells(), str(found), found.notes())
    store(found, table, picture)
    untimed = [row.name for row in found.rows if not row.seconds]
    if untimed:
        typer.echo(f"dirax: {', '.join(untimed)} could not be timed.", err=True)
        raise typer.Exit(1)


@app.command()
@with_messages
def sweep(
    file: Annotated[
        Path | None, typer.Argument(help="a Python file that defines what dx.sweep takes", show_default=False)
    ] = None,
    to: Annotated[Path | None, typer.Option(help="the store that is filled: PATH.zarr", show_default=False)] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="processes on this machine", show_default=False)] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="a scheduler of dask, tcp://HOST:PORT", show_default=False)
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="begin anew where a store exists")] = False,
    status: Annotated[
        Path | None,
        typer.Option("--status", metavar="STORE", help="show how far a sweep is, and run nothing", show_default=False),
    ] = None,
    as_json: Json = False,
) -> None:
    """Run a study of many points into a store; the same command again goes on where it ended.

    The file defines `system`, `over`, `case`, `step` and `steps`, and whatever else dx.sweep takes by these names: scheme,
    save_every, keep, params, seed … The exit status is 1 where tasks were left open.
    """
    from dirax.cli.sweep import STATUS_HEADER, run_file, status_of, status_rows

    found = status_of(status) if status is not None else run_file(file, to, workers, scheduler, overwrite)
    if as_json:
        show_json(found)
    else:
        rows = status_rows(found)
        show_table(found["store"], STATUS_HEADER, rows, "\n".join(f"{name:10} {value}" for name, value in rows))
    if status is None and found["not run"]:
        raise typer.Exit(1)


@app.command()
@with_messages
def cache(
    clear: Annotated[bool, typer.Option("--clear", help="remove all kernels")] = False,
    as_json: Json = False,
) -> None:
    """Show the compiled kernels that are kept on the disk: where, how many, how large; or remove them."""
    from dirax.cli.cache import cleared, described, sentence

    found = cleared() if clear else described()
    if as_json:
        show_json(found)
    else:
        typer.echo(sentence(found))
