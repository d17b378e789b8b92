"""Report: what `dx.verify` found, one line a quantity, readable as text, as HTML and as a dict."""

import html
import math
from dataclasses import dataclass, field
from typing import Any

OK, VIOLATED, BOUNDED, DRIFTS, NOT_CHECKED = "ok", "VIOLATED", "bounded", "drifts", "not checked"
BAD = (VIOLATED, DRIFTS)
"""Verdicts that make a report not ok."""

HEADER = ("quantity", "measured", "tolerance", "verdict", "explanation")


@dataclass(frozen=True)
class Line:
    """One quantity: the measured value (the worst of a batch), the tolerance, the verdict and a short explanation.

    `verdict` is "ok", "VIOLATED", "bounded", "drifts" or "not checked". `details` holds further numbers by name, and in
    a batch `per_trajectory` the value of each trajectory.
    """

    quantity: str
    value: float | None
    tolerance: float | None
    verdict: str
    explanation: str
    details: dict[str, Any] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """The line as plain Python values, fit for JSON."""
        return {
            "quantity": self.quantity,
            "value": _plain(self.value),
            "tolerance": _plain(self.tolerance),
            "verdict": self.verdict,
            "explanation": self.explanation,
            "details": {name: _plain(value) for name, value in self.details.items()},
        }

    def cells(self) -> tuple[str, str, str, str, str]:
        """The line as text, one string a column."""
        return self.quantity, _number(self.value), _number(self.tolerance), self.verdict, self.explanation


@dataclass(frozen=True)
class Report:
    """The lines of a verification, in order; prints as a table, and as HTML in a notebook.

    `report[quantity]` is the line of that name; `report.ok` is whether no line is VIOLATED and no energy drifts.
    """

    title: str
    lines: tuple[Line, ...]

    @property
    def ok(self) -> bool:
        """Whether no verdict is "VIOLATED" or "drifts"; what could not be checked does not count against it."""
        return not any(line.verdict in BAD for line in self.lines)

    def __getitem__(self, quantity: str) -> Line:
        for line in self.lines:
            if line.quantity == quantity:
                return line
        raise KeyError(f"no line {quantity!r}; there are {', '.join(repr(line.quantity) for line in self.lines)}.")

    def to_dict(self) -> dict[str, Any]:
        """The report as plain Python values, fit for JSON."""
        return {"title": self.title, "ok": self.ok, "lines": [line.to_dict() for line in self.lines]}

    def __str__(self) -> str:
        rows = [HEADER, *(line.cells() for line in self.lines)]
        widths = [max(len(row[i]) for row in rows) for i in range(4)]
        text = ["  ".join([*(cell.ljust(width) for cell, width in zip(row, widths, strict=False)), row[4]]) for row in rows]
        rule = "  ".join("─" * width for width in [*widths, len(HEADER[4])])
        return "\n".join([self.title, text[0].rstrip(), rule, *(line.rstrip() for line in text[1:])])

    __repr__ = __str__

    def _repr_html_(self) -> str:
        head = "".join(f"<th style='text-align:left'>{name}</th>" for name in HEADER)
        body = ""
        for line in self.lines:
            cells = [f"<td style='text-align:left'>{html.escape(cell)}</td>" for cell in line.cells()]
            if line.verdict in BAD:
                cells[3] = f"<td style='text-align:left'><b>{html.escape(line.verdict)}</b></td>"
            body += f"<tr>{''.join(cells)}</tr>"
        return f"<p>{html.escape(self.title)}</p><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}"


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(name): _plain(entry) for name, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
