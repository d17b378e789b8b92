"""The one style of all figures of dirax: matplotlib's settings inside a block, never as global state.

Colours are those of Okabe and Ito, which the colour-blind can tell apart; reports on screen have them a shade darker or
lighter (show/assets/report.css).
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from dirax.solution.atomic_files import written

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BLUE, VERMILION, GREEN, PURPLE = "#0072B2", "#D55E00", "#009E73", "#CC79A7"
ORANGE, SKY, INK, YELLOW = "#E69F00", "#56B4E9", "#222222", "#F0E442"
COLOURS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, INK)

MARKERS = "osD^vP*"
"""One for each colour, so that curves are told apart without colours too."""

STYLE: dict[Any, Any] = {
    "font.size": 9.5,
    "axes.titlesize": 10.5,
    "axes.titlelocation": "left",
    "axes.labelcolor": INK,
    "axes.edgecolor": "#8a8a8a",
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.use_mathtext": True,
    "grid.color": "#e6e6e6",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.1,
    "lines.solid_joinstyle": "round",
    "xtick.color": "#555555",
    "ytick.color": "#555555",
    "xtick.major.width": 0.7,
    "ytick.major.width": 0.7,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "figure.dpi": 110,
    "savefig.dpi": 160,
    "path.simplify_threshold": 0.2,
    "agg.path.chunksize": 20_000,
}


@contextmanager
def style() -> Iterator[None]:
    """matplotlib's settings for dirax pictures, in force inside the block only."""
    import matplotlib
    from cycler import cycler

    with matplotlib.rc_context({**STYLE, "axes.prop_cycle": cycler(color=COLOURS)}):
        yield


def new_figure(rows: int = 1, columns: int = 1, size: tuple[float, float] = (5.6, 3.6), **grid: Any) -> "tuple[Figure, Any]":
    """A Figure in the style of dirax, and its Axes: one, or an array of shape (rows, columns) squeezed; size in inches."""
    from matplotlib.figure import Figure

    with style():
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.subplots(rows, columns, **grid)
    return figure, axes


@style()
def save_figure(figure: "Figure", path: Any) -> None:
    """Write a figure in the format that the ending of `path` names, 160 dots per inch."""
    with written(path):
        figure.savefig(path)


def given_or_new(ax: "Axes | None", size: tuple[float, float] = (5.6, 3.6), **kind: Any) -> "Axes":
    """The Axes that were given, or those of a new figure of this size."""
    return new_figure(size=size, subplot_kw=kind)[1] if ax is None else ax
