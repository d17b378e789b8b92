"""Report: what `dx.verify` found, one line a quantity, readable as text, as HTML and as a dict."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from dirax.solution.style import BLUE, INK, ORANGE, SKY, VERMILION, given_or_new, style
from dirax.text.tables import html_table, number, plain, text_table

if TYPE_CHECKING:
    from matplotlib.axes import Axes

OK, VIOLATED, BOUNDED, DRIFTS, NOT_CHECKED = "ok", "VIOLATED", "bounded", "drifts", "not checked"
BAD = (VIOLATED, DRIFTS)
"""Verdicts that make a report not ok."""

COLOUR_OF = {OK: BLUE, BOUNDED: SKY, DRIFTS: ORANGE, VIOLATED: VERMILION, NOT_CHECKED: "#9a9a9a"}

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
    """The lines of a verification, in order; prints as a table, and as HTML in a notebook; `plot()` draws it.

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

    @style()
    def plot(self, ax: "Axes | None" = None) -> "Axes":
        """A bar a line on a logarithmic axis, as long as the measured value and of the colour of its verdict, with a mark at the
        tolerance; what was not checked is named in grey."""
        axes = given_or_new(ax, size=(7.2, 1.2 + 0.27 * len(self.lines)))
        rows, values, tolerances = np.arange(len(self.lines)), _sizes(self.lines, "value"), _sizes(self.lines, "tolerance")
        numbers = np.concatenate([values, tolerances])
        logs = np.log10(numbers[np.isfinite(numbers) & (numbers > 0)])
        left, right = (10.0 ** np.floor(logs.min() - 0.5), 10.0 ** np.ceil(logs.max() + 0.5)) if logs.size else (1e-16, 1.0)
        for verdict, colour in COLOUR_OF.items():
            chosen = np.array([line.verdict == verdict for line in self.lines], bool)
            ends = np.clip(np.nan_to_num(values[chosen], posinf=right), left, right)
            if np.any(chosen):
                axes.barh(rows[chosen], ends - left, left=left, height=0.62, color=colour, label=verdict)
            for row in rows[chosen & ~(values > 0)]:
                text = "0" if values[row] == 0 else verdict
                axes.annotate(text, (left, row), (4, 0), textcoords="offset points", va="center", color=colour)
        axes.plot(tolerances, rows, "|", color=INK, ms=13, mew=1.6, label="tolerance")
        axes.set(
            xscale="log",
            xlim=(left, right),
            ylim=(len(self.lines) - 0.5, -0.5),
            xlabel="measured",
            title=self.title.replace(": ", "\n", 1),
        )
        axes.set_yticks(rows, [line.quantity for line in self.lines])
        for label, line in zip(axes.get_yticklabels(), self.lines, strict=True):
            label.set_color(COLOUR_OF[NOT_CHECKED] if line.verdict == NOT_CHECKED else INK)
        axes.tick_params(axis="y", length=0)
        axes.grid(visible=False, axis="y")
        axes.legend(loc="upper left", bbox_to_anchor=(1, 1))
        return axes


def _sizes(lines: tuple[Line, ...], name: str) -> np.ndarray:
    """A number of every line, NaN where it has none."""
    return np.array([np.nan if (x := getattr(line, name)) is None else abs(x) for line in lines], float)
