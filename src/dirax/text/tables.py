"""Tables that print as aligned text, show as HTML in notebooks, and turn into plain Python values."""

import html
import math
from typing import Any


def text_table(header: tuple[str, ...], rows: list[tuple[str, ...]], title: str = "") -> str:
    """The rows under the header, columns aligned, with a rule between."""
    lines = [header, *rows]
    widths = [max(len(line[i]) for line in lines) for i in range(len(header))]
    text = ["  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in lines]
    rule = "  ".join("─" * width for width in widths)
    return "\n".join([*([title] if title else []), text[0], rule, *text[1:]])


def html_table(header: tuple[str, ...], rows: list[tuple[str, ...]], title: str = "", bold: tuple[str, ...] = ()) -> str:
    """The same as an HTML table; cells whose text is in `bold` stand out."""
    show = lambda cell: f"<b>{html.escape(cell)}</b>" if cell in bold else html.escape(cell)
    cells = lambda tag, line: "".join(f"<{tag} style='text-align:left'>{show(cell)}</{tag}>" for cell in line)
    body = "".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    top = f"<p>{html.escape(title)}</p>" if title else ""
    return f"{top}<table><thead><tr>{cells('th', header)}</tr></thead><tbody>{body}</tbody></table>"


def number(value: float | None, digits: int = 3) -> str:
    """A number for a cell: `digits` significant ones, empty for None and "–" for NaN."""
    return "" if value is None else "–" if math.isnan(value) else f"{value:.{digits}g}"


def plain(value: Any) -> Any:
    """Nested dicts and lists of plain Python values, fit for JSON: arrays as lists, NaN and infinity as None."""
    if isinstance(value, dict):
        return {str(name): plain(entry) for name, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(entry) for entry in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
