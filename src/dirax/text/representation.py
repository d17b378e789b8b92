"""How systems, schemes and equations show themselves: one readable line in a terminal, a small table in a notebook."""

import dataclasses
from typing import Any

import numpy as np

from dirax.text.tables import html_table

LINE = 100
"""Longest representation that stays on one line."""


def module_fields(module: Any) -> dict[str, Any]:
    """The fields of a frozen record by name, in the order of its class, without those left at a plain default."""
    values = {field.name: (getattr(module, field.name), field.default) for field in dataclasses.fields(module)}
    left_out = lambda value, default: value is None is default or (isinstance(value, str) and value == default)
    return {name: value for name, (value, default) in values.items() if not left_out(value, default)}


def module_text(module: Any) -> str:
    """`Name(field=value, …)`, on several lines where one would be too long."""
    parts = [f"{name}={value_text(value)}" for name, value in module_fields(module).items()]
    name = type(module).__name__
    line = f"{name}({', '.join(parts)})"
    if len(line) <= LINE and "\n" not in line:
        return line
    inside = ",\n".join(parts).replace("\n", "\n  ")
    return f"{name}(\n  {inside},\n)"


def module_html(module: Any) -> str:
    """The fields of a record as a table."""
    return fields_html(type(module).__name__, {k: value_text(v) for k, v in module_fields(module).items()})


def value_text(value: Any) -> str:
    """One value: arrays by their entries if there are few and by their shape otherwise, functions by their name."""
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        small = np.size(value) <= 6 and isinstance(value, np.ndarray | np.generic)
        return str(np.asarray(value).tolist()) if small else f"{value.dtype}{list(np.shape(value))}"
    if callable(value) and hasattr(value, "__name__"):
        return "a lambda" if value.__name__ == "<lambda>" else value.__name__
    if isinstance(value, tuple) and len(value) > 8:
        return f"({', '.join(map(value_text, value[:3]))}, … {len(value)} in all)"
    return repr(value)


def fields_html(title: str, rows: dict[str, str]) -> str:
    """Names and texts as a table of two columns."""
    return html_table((), list(rows.items()), title)


def counted(number: int, noun: str, plural: str | None = None) -> str:
    """`1 step`, `50 000 steps`: a number with its noun, thousands set apart."""
    return f"{number:,}".replace(",", " ") + " " + (noun if number == 1 else plural or f"{noun}s")


def shortened(value: Any, most: int = 60) -> str:
    """The representation of a value that a user gave, cut after `most` characters."""
    text = repr(value)
    return text if len(text) <= most else f"{text[: most - 1]}…"


def error_text(error: BaseException) -> str:
    """The kind of an error and the first line of what it says."""
    return f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"
