"""Papers reproduced: runs, a table of what the paper says and what comes out, and the paper's figures drawn again."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from textwrap import fill
from typing import Any

from dirax.gallery.theorems import HEADER as THEOREMS
from dirax.gallery.theorems import HOLDS, Theorem
from dirax.solution.atomic_files import made_folder, write_text
from dirax.text.tables import plain, text_table

AGREES, DIFFERS, WRONG, NEW, NOT_OURS = "agrees", "DIFFERS", "paper is wrong", "not in paper", "not reproduced"
"""Verdicts. NOT_OURS is a number of the paper that belongs to its program and not to its mathematics.
DIFFERS is the one that must not occur: dirax does not reproduce what it should."""

NOTE_WIDTH = 120

HEADER = ("quantity", "paper", "computed", "verdict")

_PAPERS = {"PY": "peng_yoshimura", "RL": "rodriguez_leok", "BLM": "barbero_linan"}
"""Short name → the module here with `reproduction(progress) -> Reproduction`; a new paper is a module and a line."""

Progress = Callable[[float, str], None]
"""Called with (fraction done, what is being done)."""


@dataclass(frozen=True)
class Row:
    """One quantity: what the paper says, what was computed, the verdict, and in `numbers` the values behind the text."""

    quantity: str
    paper: str
    computed: str
    verdict: str
    note: str = ""
    numbers: dict[str, Any] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """The row as plain Python values, fit for JSON."""
        cells = {name: getattr(self, name) for name in (*HEADER, "note")}
        return {**cells, "numbers": {name: plain(value) for name, value in self.numbers.items()}}


@dataclass(frozen=True)
class Reproduction:
    """A paper's tables and figures; prints as the tables: what it measured, and what it proves. `figures` maps a file name
    without ending to a matplotlib Figure."""

    paper: str
    title: str
    rows: tuple[Row, ...]
    figures: dict[str, Any] = field(default_factory=dict, repr=False)
    theorems: tuple[Theorem, ...] = ()

    @property
    def ok(self) -> bool:
        """Whether every row says what it should: that dirax agrees with the paper, or shows where the paper is wrong; and every
        theorem holds."""
        return all(row.verdict != DIFFERS for row in self.rows) and all(row.verdict == HOLDS for row in self.theorems)

    def to_dict(self) -> dict[str, Any]:
        """The table as plain Python values, fit for JSON."""
        rows = [row.to_dict() for row in self.rows]
        theorems = [theorem.to_dict() for theorem in self.theorems]
        names = {"paper": self.paper, "title": self.title, "ok": self.ok}
        return {**names, "rows": rows, "theorems": theorems, "figures": sorted(self.figures)}

    def __str__(self) -> str:
        marks, notes = self.notes()
        rows = [(row.quantity, row.paper, row.computed, row.verdict, mark) for row, mark in zip(self.rows, marks, strict=True)]
        text = text_table((*HEADER, "note") if notes else HEADER, rows if notes else [row[:4] for row in rows])
        notes = [fill(note, NOTE_WIDTH, subsequent_indent="    ") for note in notes]
        proved = [text_table(THEOREMS, [theorem.cells for theorem in self.theorems]), ""] if self.theorems else []
        return "\n".join([f"[{self.paper}] {self.title}", "", text, "", *proved, *notes])

    def notes(self) -> tuple[list[str], list[str]]:
        """The mark of each row ("" without a note, else "[1]", …; equal notes share one) and the marked notes."""
        numbered: dict[str, int] = {}
        for row in self.rows:
            if row.note:
                numbered.setdefault(row.note, len(numbered) + 1)
        marks = [f"[{numbered[row.note]}]" if row.note else "" for row in self.rows]
        return marks, [f"[{number}] {note}" for note, number in numbered.items()]

    def save_figures(self, folder: Path) -> list[Path]:
        """Write every figure as PNG into `folder`, which is made if it is missing; returns the files."""
        from dirax.solution.style import save_figure

        made_folder(folder)
        paths = [folder / f"{name}.png" for name in self.figures]
        for path, figure in zip(paths, self.figures.values(), strict=True):
            save_figure(figure, path)
        return paths


def papers() -> tuple[str, ...]:
    """Short names of the papers that can be reproduced."""
    return tuple(_PAPERS)


def reproduce(paper: str = "all", out: Any = None, progress: Progress | None = None) -> list[Reproduction]:
    """Reproduce a paper, or all of them: its runs, its table, its figures.

    With `out`, a folder, the figures go to `out/<paper>/*.png` and the tables to `out/table.json` and `out/table.txt`.
    `progress` is called with (fraction, text). Raises `ValueError` for an unknown paper, and `OSError` for a folder that cannot
    be written to, before anything is run.
    """
    known = {name.lower(): name for name in _PAPERS}
    wanted = str(paper).lower()
    if wanted != "all" and wanted not in known:
        raise ValueError(f"no reproduction of {paper!r}: choose one of {', '.join(_PAPERS)} or all.")
    chosen = list(_PAPERS) if wanted == "all" else [known[wanted]]
    if out is not None:
        made_folder(Path(out))
    tell = progress or (lambda fraction, text: None)
    results = []
    for number, name in enumerate(chosen):
        module = import_module(f"dirax.gallery.{_PAPERS[name]}")
        inner = lambda fraction, text, number=number, name=name: tell((number + fraction) / len(chosen), f"{name}: {text}")
        results.append(module.reproduction(inner))
        if out is not None:
            inner(0.97, "writing figures")
            results[-1].save_figures(Path(out) / name)
    if out is not None:
        write_tables(results, Path(out))
    tell(1.0, "done")
    return results


def write_tables(results: Sequence[Reproduction], folder: Path) -> None:
    """`table.json` and `table.txt` in `folder`."""
    made_folder(folder)
    write_text(folder / "table.json", tables_as_json(results) + "\n")
    write_text(folder / "table.txt", "\n\n\n".join(map(str, results)) + "\n")


def tables_as_json(results: Sequence[Reproduction]) -> str:
    """The tables as a JSON array, one object a paper."""
    return json.dumps([result.to_dict() for result in results], indent=2, ensure_ascii=False)


def compared(quantity: str, paper: float, computed: float, tolerance: float, note: str = "", digits: int = 9) -> Row:
    """A row that compares two numbers: it agrees where they differ by at most `tolerance` (absolute)."""
    verdict = AGREES if abs(computed - paper) <= tolerance else DIFFERS
    numbers = {"paper": paper, "computed": computed, "difference": computed - paper, "tolerance": tolerance}
    return Row(quantity, f"{paper:.{digits}g}", f"{computed:.{digits}g}", verdict, note, numbers)
