"""The page itself: text as HTML, everything else as data for its script. Whatever comes from a user is escaped."""

import html
import json
import re
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from string import Template
from typing import Any

import numpy as np

from dirax.diagnostics.report import BAD, HEADER, NOT_CHECKED, Line, Report
from dirax.show import statement
from dirax.show.arrays import Arrays
from dirax.show.letters import Written
from dirax.show.series import Run, worst_time
from dirax.solution.solution import Solution
from dirax.text.tables import number, plain

TITLES = {"energy": "Energy", "momenta": "Conserved momenta", "constraint": "Constraint residual", "multipliers": "Multipliers"}


@cache
def asset(name: str) -> str:
    """A file that is part of every page."""
    return files("dirax.show").joinpath("assets", name).read_text("utf-8")


def text(
    *,
    title: str,
    solutions: Sequence[Solution],
    names: Sequence[str],
    runs: Sequence[Run],
    reports: Sequence[Report | None],
    provenance: Sequence[tuple[str, str]],
    plane: tuple[int, ...],
    source: str,
    data: dict[str, Any],
    arrays: Arrays,
    small: bool = False,
) -> str:
    """The whole page; of a `small` one only the motion and two plots are seen."""
    first = solutions[0]
    units = first.metadata.get("units", {})
    data = {
        **data,
        "title": title,
        "names": list(names),
        "unit": str(units.get("t", "")),
        "charts": _two(charts(runs, plane, units)) if small else charts(runs, plane, units),
        "bytes": arrays.size,
    }
    return Template(asset("page.html")).substitute(
        kind="small" if small else "whole",
        title=html.escape(title),
        subtitle=html.escape(_subtitle(solutions)),
        verdict=_chip(reports),
        statement=equations_html(first),
        runs=_runs(solutions, names, runs),
        verdicts="".join(_verdicts(report, names[k], k, runs, len(solutions)) for k, report in enumerate(reports)),
        details=_details(first, source),
        provenance=_definitions(provenance),
        style=asset("uplot.css") + asset("report.css"),
        script=asset("report.js"),
        data=embedded(data),
        arrays=arrays.text(),
    )


def embedded(data: Any) -> str:
    """JSON that can stand in a script element: nothing in it ends the element or opens a comment."""
    return json.dumps(plain(data), ensure_ascii=False).translate({ord(c): f"\\u{ord(c):04x}" for c in "<>&\u2028\u2029"})


def charts(runs: Sequence[Run], plane: tuple[int, ...], units: dict[str, Any]) -> list[dict[str, Any]]:
    """What is plotted: title, table and columns, and how it can be looked at."""
    tables = {name: table for run in reversed(runs) for name, table in run.tables.items()}
    found = []
    for name in ("energy", "momenta", "constraint"):
        if name in tables:
            count = len(tables[name].columns)
            modes = ["value", "log"] if name == "constraint" else ["change", "log", "value"]
            unit = str(units.get("energy", "")) if name == "energy" else ""
            found.append(_over_time(TITLES[name], name, range(count), modes, unit))
    if "state" in tables:
        columns = tables["state"].columns
        whole = max((run.tables["state"] for run in runs if "state" in run.tables), key=lambda table: len(table.columns))
        columns = whole.columns
        momenta = [k for k, name in enumerate(columns) if name.startswith("p_")]
        positions = [k for k in range(len(columns)) if k not in momenta]
        if len(positions) > 1 or (positions and momenta):
            found.append(_phase(columns, positions, momenta, plane))
        if positions:
            found.append(_over_time("Coordinates", "state", positions, ["value", "change", "log"]))
        if momenta:
            found.append(_over_time("Momenta", "state", momenta, ["value", "change", "log"]))
    for name, table in tables.items():
        if name not in ("energy", "momenta", "constraint", "state"):
            title = TITLES.get(name, name.replace("_", " ").capitalize())
            found.append(_over_time(title, name, range(len(table.columns)), ["value", "log"]))
    return found


def _two(found: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The first plot over time, which is of the energy where there is one, and the phase plane."""
    return [*[chart for chart in found if chart["kind"] == "time"][:1], *[chart for chart in found if chart["kind"] == "phase"]]


def _over_time(title: str, table: str, columns: Any, modes: list[str], unit: str = "") -> dict[str, Any]:
    return {"kind": "time", "title": title, "table": table, "columns": list(columns), "modes": modes, "unit": unit}


def _phase(columns: Sequence[str], positions: list[int], momenta: list[int], plane: tuple[int, ...]) -> dict[str, Any]:
    """Planes: of the two chosen coordinates, and of every coordinate with its momentum."""
    chosen = [positions[k] for k in plane if k < len(positions)]
    pairs = [chosen] if len(set(chosen)) == 2 and momenta == [] else []
    pairs += [[i, j] for i, j in zip(positions, momenta, strict=False)]
    pairs += [chosen] if len(set(chosen)) == 2 and momenta else []
    if not momenta:
        pairs += [[i, j] for i in positions for j in positions if i < j and [i, j] not in pairs][:20]
    return {
        "kind": "phase",
        "title": "Phase plane",
        "table": "state",
        "pairs": [{"columns": pair, "label": f"{columns[pair[0]]}, {columns[pair[1]]}"} for pair in pairs],
    }


def _subtitle(solutions: Sequence[Solution]) -> str:
    first = solutions[0]
    unit = f" {u}" if (u := first.metadata.get("units", {}).get("t", "")) else ""
    steps = f"step {float(first.step):g}{unit}, t = {first.time_of(0):g} to {first.time_of(-1):g}{unit}"
    batch = f", {first.batch} trajectories" if first.batch is not None else ""
    what = scheme_text(first) if len(solutions) == 1 else f"{len(solutions)} solutions side by side"
    return f"{what} · {steps}{batch}"


def scheme_text(sol: Solution) -> str:
    """The scheme on one line."""
    text = repr(sol.scheme) if sol.scheme is not None else str(sol.metadata.get("scheme", "unknown"))
    return " ".join(text.split())


def _chip(reports: Sequence[Report | None]) -> str:
    lines = [line for report in reports if report is not None for line in report.lines]
    if not lines:
        return ""
    bad = [line for line in lines if line.verdict in BAD]
    if not bad:
        checked = sum(line.verdict != NOT_CHECKED for line in lines)
        return f'<a class="chip good" href="#verdicts">✓ structure holds: {checked} checks</a>'
    named = list(dict.fromkeys(f"{line.quantity} {line.verdict}" for line in bad))
    return f'<a class="chip bad" href="#verdicts">! {html.escape(", ".join(named[:3]))}{" …" if len(named) > 3 else ""}</a>'


def math(parts: Sequence[Written]) -> str:
    """A formula in pieces between which a line may break."""
    piece = lambda part: f'<math displaystyle="true" aria-label="{html.escape(part.text)}"><mrow>{part.mathml}</mrow></math>'
    return " ".join(map(piece, parts))


def equations_html(sol: Solution) -> str:
    """The system in formulas, empty where there are no short ones."""
    equal = Written("=", "<mo>=</mo>")
    rows = [
        f'<div class="equation">{math([*equation.left, equal, *equation.right])}</div>' for equation in statement.equations(sol)
    ]
    return f'<div class="equations" role="group" aria-label="The system">{"".join(rows)}</div>' if rows else ""


def _details(sol: Solution, source: str) -> str:
    system = type(sol.system).__name__ if sol.system is not None else str(sol.metadata.get("system", "unknown"))
    rows = [("system", system), *([("source", source)] if source else [])]
    rows += [(f"{name} at the start", values) for name, values in statement.initial_values(sol)]
    body = _definitions(rows)
    if parameters := statement.parameters(sol.params_of_one):
        body += f"<h3>Parameters</h3>{_definitions(parameters, 'parameters')}"
    code = "\n\n\n".join(text for _, text in statement.sources(sol.system))
    if code:
        body += f'<h3>As stated</h3><pre tabindex="0"><code>{html.escape(code)}</code></pre>'
    return body


def _definitions(rows: Sequence[tuple[str, str]], kind: str = "") -> str:
    items = "".join(f"<div><dt>{html.escape(name)}</dt><dd>{html.escape(value)}</dd></div>" for name, value in rows)
    return f'<dl class="{kind}">{items}</dl>'


def _runs(solutions: Sequence[Solution], names: Sequence[str], runs: Sequence[Run]) -> str:
    """One row a solution: what was run, and its energy to the last digit."""
    rows = []
    for k, sol in enumerate(solutions):
        mine = [run for run in runs if run.group == k]
        energy, change, when = "", "", None
        if "energy" in mine[0].tables:
            values = [run.tables["energy"].values[:, 0] for run in mine]
            energy = repr(float(values[0][0]))
            worst = max(range(len(mine)), key=lambda i: np.nanmax(np.abs(values[i] - values[i][0])))
            change = f"{np.nanmax(np.abs(values[worst] - values[worst][0])):.3g}"
            when = worst_time(mine[worst], "energy", None, change=True)
        ended = "" if np.all(sol.ok) else f' <strong class="bad">{html.escape(_message(sol))}</strong>'
        cells = [
            f'<th scope="row"><span class="swatch" data-group="{k}"></span>{html.escape(names[k])}{ended}</th>',
            f"<td><code>{html.escape(scheme_text(sol))}</code></td>",
            f'<td class="number">{float(sol.step):g}</td>',
            f'<td class="number">{sol.rows}</td>',
            f'<td class="number">{energy}</td>',
            f'<td class="number">{_seek(change, when, None)}</td>',
        ]
        rows.append(f"<tr>{''.join(cells)}</tr>")
    heads = ("solution", "scheme", "step", "rows", "energy at the start", "largest change")
    return _table("What was run", heads, rows)


def _message(sol: Solution) -> str:
    return sol.message if isinstance(sol.message, str) else next((m for m in sol.message if m), "")


def _table(caption: str, heads: Sequence[str], rows: Sequence[str]) -> str:
    head = "".join(f'<th scope="col">{html.escape(name)}</th>' for name in heads)
    label = html.escape(caption)
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{label}"><table><caption>{label}</caption>'
        f"<thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table></div>"
    )


def _seek(label: str, time: float | None, table: str | None) -> str:
    """A button that takes the page to a time, where there is one."""
    if time is None:
        return html.escape(label)
    return (
        f'<button type="button" class="seek" data-time="{time!r}" data-table="{html.escape(table or "")}" '
        f'title="go to t = {time:.6g}">{html.escape(label)}</button>'
    )


def _verdicts(report: Report | None, name: str, group: int, runs: Sequence[Run], count: int) -> str:
    if report is None:
        return ""
    rows = []
    for line in report.lines:
        table, time = _worst(line, [run for run in runs if run.group == group])
        kind = "bad" if line.verdict in BAD else "none" if line.verdict == NOT_CHECKED else "good"
        cells = [
            f'<th scope="row">{_seek(line.quantity, time, table)}</th>',
            f'<td class="number">{number(line.value)}</td>',
            f'<td class="number">{number(line.tolerance)}</td>',
            f'<td><span class="verdict {kind}">{html.escape(line.verdict)}</span></td>',
            f"<td>{html.escape(line.explanation)}</td>",
        ]
        rows.append(f"<tr>{''.join(cells)}</tr>")
    return _table(report.title if count == 1 else f"{name}: {report.title}", HEADER, rows)


def _worst(line: Line, runs: Sequence[Run]) -> tuple[str | None, float | None]:
    """The table that shows a line's quantity, and the time at which it is worst."""
    said = _said_time(line)
    for table, change in (("energy", True), ("constraint", False)):
        if table in line.quantity.lower():
            time = next((w for run in runs if (w := worst_time(run, table, None, change)) is not None), None)
            return (table if time is not None else None), (time if said is None else said)
    for run in runs:
        if "momenta" in run.tables:
            for k, name in enumerate(run.tables["momenta"].columns):
                if name in line.quantity:
                    return "momenta", worst_time(run, "momenta", k, change=True)
    return None, said


def _said_time(line: Line) -> float | None:
    """The time that a line itself names as its worst, in its details or in its explanation."""
    given = line.details.get("t", line.details.get("time"))
    if isinstance(given, int | float):
        return float(given)
    found = re.search(r"\bat t = (-?[\d.]+(?:e[-+]?\d+)?)", line.explanation)
    return float(found[1].rstrip(".")) if found else None
