"""Report: what `dx.verify` found, one line a quantity, readable as text, as HTML and as a dict."""

from dataclasses import dataclass, field
from typing import Any

from dirax.text.tables import html_table, number, plain, text_table

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
            "value": plain(self.value),
            "tolerance": plain(self.tolerance),
            "verdict": self.verdict,
            "explanation": self.explanation,
            "details": {name: plain(value) for name, value in self.details.items()},
        }

    def cells(self) -> tuple[str, str, str, str, str]:
        """The line as text, one string a column."""
        return self.quantity, number(self.value), number(self.tolerance), self.verdict, self.explanation


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
        return text_table(HEADER, [line.cells() for line in self.lines], self.title)

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return html_table(HEADER, [line.cells() for line in self.lines], self.title, bold=BAD)
