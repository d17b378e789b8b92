"""Tables that print as aligned text, show as HTML in notebooks, and turn into plain Python values."""

import html
import math
from collections.abc import Sequence
from typing import Any


def text_table(header: tuple[str, ...], rows: Sequence[tuple[str, ...]], title: str = "") -> str:
    """The rows under the header, columns aligned, with a rule between."""
    lines = [header, *rows]
    widths = [max(len(line[i]) for line in lines) for i in range(len(header))]
    text = ["  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in lines]
    rule = "  ".join("─" * width for width in widths)
    return "\n".join([*([title] if title else []), text[0], rule, *text[1:]])


def html_table(header: tuple[str, ...], rows: Sequence[tuple[str, ...]], title: str = "", bold: tuple[str, ...] = ()) -> str:
    """The same as an HTML table; cells whose text is in `bold` stand out. An empty header leaves its row out."""
    show = lambda cell: f"<b>{html.escape(cell)}</b>" if cell in bold else html.escape(cell)
    cells = lambda tag, line: "".join(f"<{tag} style='text-align:left'>{show(cell)}</{tag}>" for cell in line)
    body = "".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    top = f"<caption style='text-align:left'>{html.escape(title)}</caption>" if title else ""
    head = f"<thead><tr>{cells('th', header)}</tr></thead>" if header else ""
    return f"<table>{top}{head}<tbody>{body}</tbody></table>"


def number(value: float | None, digits: int = 3) -> str:
    """A number for a cell: `digits` significant ones, empty for None and "–" for NaN."""
    return "" if value is None else "–" if math.isnan(value) else f"{value:.{digits}g}"


def plain(value: Any, nonfinite: bool = False) -> Any:
    """Nested dicts and lists of plain Python values, fit for JSON: arrays as lists, what is no plain value as text, NaN and
    infinity as None unless `nonfinite`."""
    if isinstance(value, dict):
        return {str(name): plain(entry, nonfinite) for name, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(entry, nonfinite) for entry in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist(), nonfinite)
    if isinstance(value, float) and not (nonfinite or math.isfinite(value)):
        return None
    return value if value is None or isinstance(value, (str, bool, int, float)) else str(value)
