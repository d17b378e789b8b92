"""The picture of a section: where trajectories go through a surface, one colour each."""

from typing import Any

import numpy as np

from dirax.solution.events import Events
from dirax.solution.style import COLOURS, new_figure, style


@style()
def draw_section(events: Events, x: str = "q[0]", y: str = "p[0]", *, title: str = "", ax: Any = None) -> Any:
    """The points of `sol.events` in the plane of two entries of their fields, such as "q[1]" and "p[1]"; a matplotlib Axes.

    Raises `ValueError` for a name that is no entry of a field.
    """
    if ax is None:
        _, ax = new_figure(size=(5.2, 4.8))
    across, up = entry(events, x), entry(events, y)
    for lane in np.unique(events.lane):
        own = events.lane == lane
        ax.plot(across[own], up[own], "o", ms=1.3, mew=0, color=COLOURS[int(lane) % len(COLOURS)], rasterized=True)
    ax.set(xlabel=_symbol(x), ylabel=_symbol(y), title=title)
    return ax


def entry(events: Events, name: str) -> np.ndarray:
    """The entry of a field at every event: "q[1]", or the name of a field of numbers."""
    field, _, index = name.rstrip("]").partition("[")
    values = events.fields.get(field)
    if values is None or (values.ndim == 2) != bool(index) or (index and not (index.isdigit() and int(index) < values.shape[1])):
        there = ", ".join(f"{key}[0] … {key}[{a.shape[1] - 1}]" if a.ndim == 2 else key for key, a in events.fields.items())
        raise ValueError(f"{name!r} is no entry of these events, which hold {there}.")
    return values[:, int(index)] if index else values


def _symbol(name: str) -> str:
    field, _, index = name.rstrip("]").partition("[")
    return f"${field}_{index}$" if index else f"${field}$"
