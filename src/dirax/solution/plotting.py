"""Pictures of a Solution as matplotlib Axes and Figures, without pyplot and without global state.

Names and units of axes come from `solution.metadata` ("coordinates" and "units"), which gallery systems fill in; a
solution without them shows q0, q1, … Colours are those of Okabe and Ito, which the colour-blind can tell apart;
reports on screen have them a shade darker or lighter (show/assets/report.css).
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BLUE, VERMILION, GREEN, PURPLE = "#0072B2", "#D55E00", "#009E73", "#CC79A7"
ORANGE, SKY, INK, YELLOW = "#E69F00", "#56B4E9", "#222222", "#F0E442"
COLOURS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, INK)

MANY = 12
"""A batch of more trajectories than this is drawn in one translucent colour."""

ENVELOPE = 1000
"""On a logarithmic scale, longer series are drawn by their largest value in each of this many pieces of time."""

ENERGY_ERROR = "$|E - E_0| \\,/\\, |E_0|$"

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
    figure.savefig(path)


@style()
def plot_trajectory(sol: Any, x: int | str = 0, y: int | str = 1, *, ax: "Axes | None" = None, **line: Any) -> "Axes":
    """The path in the plane of two coordinates, one curve a trajectory, a dot where each begins; equal scales where the
    coordinates have the same unit and are not angles.

    `x`, `y`: index or name of an entry of q (of `sol.x` where there is no q). Raises `ValueError` for unknown ones.
    """
    i, j = _index(sol, x), _index(sol, y)
    ax = _given_or_new(ax)
    lanes = _lanes(sol, _position(sol))
    for path, kwargs in zip(lanes, _lines(len(lanes), line), strict=True):
        (curve,) = ax.plot(path[:, i], path[:, j], **kwargs)
        ax.plot(path[:1, i], path[:1, j], "o", ms=3.5, color=curve.get_color(), label="_start")
    names, units = _names(sol), _units(sol)
    ax.set(xlabel=_label(_symbol(names[i]), units[i]), ylabel=_label(_symbol(names[j]), units[j]))
    if units[i] == units[j] != "rad":
        ax.set_aspect("equal", adjustable="datalim")
    return ax


@style()
def plot_coordinate(sol: Any, i: int | str = 0, *, field: str = "q", ax: "Axes | None" = None, **line: Any) -> "Axes":
    """One entry of a saved field against time: `field` is "q", "p", "x" or another name of an array at nodes.

    Raises `ValueError` for an unknown entry.
    """
    index = _index(sol, i)
    ax = _given_or_new(ax)
    lanes = _lanes(sol, np.asarray(sol.fields[field]))
    for values, kwargs in zip(lanes, _lines(len(lanes), line), strict=True):
        ax.plot(sol.t, values[:, index], **kwargs)
    position = ("q" in sol.fields and field == "q") or field == "x"
    name = _names(sol)[index]
    name = _symbol(name) if position else _symbol(field, name)
    ax.set(xlabel=_time_label(sol), ylabel=_label(name, _units(sol)[index] if position else ""))
    return ax


@style()
def plot_energy(sol: Any, *, figure: "Figure | None" = None, **line: Any) -> "Figure":
    """The energy against time, and beside it its error |E − E(0)| / |E(0)| on a logarithmic scale (absolute if E(0) = 0)."""
    if figure is None:
        figure, (left, right) = new_figure(1, 2, size=(9.2, 3.4))
    else:
        left, right = figure.axes if figure.axes else figure.subplots(1, 2)
    energies = np.atleast_2d(np.asarray(sol.energy()))
    for values, kwargs in zip(energies, _lines(len(energies), line), strict=True):
        left.plot(sol.t, values, **kwargs)
        plot_error(right, sol.t, values, **kwargs)
    relative = bool(np.all(energies[:, 0] != 0))
    unit = sol.metadata.get("units", {}).get("energy", "")
    left.set(xlabel=_time_label(sol), ylabel=_label("energy $E$", unit))
    right.set(xlabel=_time_label(sol), ylabel=ENERGY_ERROR if relative else _label("$|E - E_0|$", unit))
    return figure


@style()
def plot_error(ax: "Axes", t: Any, values: Any, **line: Any) -> None:
    """|values − values[0]| against `t` on a logarithmic scale, relative to |values[0]| unless that is 0; zeros are left out."""
    values = np.asarray(values)
    _plot_log(ax, np.asarray(t), np.abs(values - values[0]) / (abs(values[0]) or 1.0), **line)


@style()
def plot_phase(sol: Any, i: int | str = 0, *, ax: "Axes | None" = None, **line: Any) -> "Axes":
    """The path in the phase plane (q_i, p_i). Raises `ValueError` for an unknown coordinate or a solution without p."""
    index = _index(sol, i)
    if "q" not in sol.fields or "p" not in sol.fields:
        raise ValueError(
            f"a phase plane needs q and p, but this solution holds {', '.join(sol.fields)}: plot_trajectory shows x."
        )
    ax = _given_or_new(ax)
    lanes_q, lanes_p = _lanes(sol, np.asarray(sol.q)), _lanes(sol, np.asarray(sol.p))
    for q, p, kwargs in zip(lanes_q, lanes_p, _lines(len(lanes_q), line), strict=True):
        (curve,) = ax.plot(q[:, index], p[:, index], **kwargs)
        ax.plot(q[:1, index], p[:1, index], "o", ms=3.5, color=curve.get_color(), label="_start")
    name = _names(sol)[index]
    ax.set(xlabel=_label(_symbol(name), _units(sol)[index]), ylabel=_symbol("p", name))
    return ax


@style()
def plot_constraint(sol: Any, *, ax: "Axes | None" = None, **line: Any) -> "Axes":
    """The largest absolute constraint residual against time on a logarithmic scale; exact zeros are left out.

    Raises `ValueError` for a system without constraints.
    """
    residual = np.asarray(sol.constraint_residual())
    if residual.shape[-1] == 0:
        raise ValueError("this system has no constraints, so there is no residual to plot.")
    ax = _given_or_new(ax)
    worst = np.atleast_2d(np.max(np.abs(residual), axis=-1))
    for values, kwargs in zip(worst, _lines(len(worst), line), strict=True):
        _plot_log(ax, np.asarray(sol.t)[: values.size], values, **kwargs)
    ax.set(xlabel=_time_label(sol), ylabel="largest constraint residual")
    return ax


def _given_or_new(ax: "Axes | None") -> "Axes":
    return new_figure()[1] if ax is None else ax


def _plot_log(ax: "Axes", t: np.ndarray, values: np.ndarray, **line: Any) -> None:
    if len(values) > 2 * ENVELOPE:
        starts = np.linspace(0, len(values), ENVELOPE, endpoint=False).astype(int)
        values, t = np.fmax.reduceat(values, starts), t[starts]
    ax.set_yscale("log")
    ax.plot(t, np.where(values > 0, values, np.nan), **line)


def _position(sol: Any) -> np.ndarray:
    return np.asarray(sol.fields["q"] if "q" in sol.fields else sol.fields["x"])


def _lanes(sol: Any, values: np.ndarray) -> np.ndarray:
    """Values with a batch axis in front, of length 1 for one trajectory."""
    return values if sol.batch is not None else values[None]


def _lines(count: int, line: dict) -> list[dict]:
    """Keywords of each of `count` curves: one label for all, and one translucent colour if they are many."""
    many = {"color": BLUE, "alpha": max(0.06, min(0.5, 6 / count)), "lw": 0.7} if count > MANY else {}
    label = line.get("label")
    return [{**many, **line, **({"label": label if k == 0 else "_more"} if label else {})} for k in range(count)]


def _names(sol: Any) -> list[str]:
    size = _position(sol).shape[-1]
    field = "q" if "q" in sol.fields else "x"
    names = list(sol.metadata.get("coordinates", ()))
    return names if len(names) == size else [f"{field}{k}" for k in range(size)]


def _units(sol: Any) -> list[str]:
    size = _position(sol).shape[-1]
    units = list(sol.metadata.get("units", {}).get("q", ()))
    return units if len(units) == size else [""] * size


def _index(sol: Any, which: int | str) -> int:
    names = _names(sol)
    if which in names:
        return names.index(str(which))
    if isinstance(which, int | np.integer) and -len(names) <= which < len(names):
        return int(which) % len(names)
    raise ValueError(f"no coordinate {which!r}: give an index from 0 to {len(names) - 1} or one of {', '.join(names)}.")


def _symbol(name: str, index: str = "") -> str:
    """A name in mathematical type, its digits at the end as an index: θ1 becomes θ₁."""
    letters = name.rstrip("0123456789")
    index = index or name[len(letters) :]
    return f"${letters}_{{{index}}}$" if index else f"${letters}$" if len(letters) == 1 else letters


def _label(name: str, unit: str) -> str:
    return f"{name} ({unit})" if unit else name


def _time_label(sol: Any) -> str:
    return _label("$t$", sol.metadata.get("units", {}).get("t", ""))
