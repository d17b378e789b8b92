"""Pictures of a Solution as matplotlib Axes and Figures, without pyplot and without global state.

Names and units of axes come from `solution.metadata` ("coordinates" and "units"), which gallery systems fill in; a
solution without them shows q0, q1, … The style is that of style.py.
"""

import functools
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from dirax.solution.labels import (
    entry,
    index_of,
    label,
    letter_and_index,
    names_of,
    position,
    state_names,
    state_symbol,
    symbol,
    time_label,
    units_of,
)
from dirax.solution.section import crossings, states_of
from dirax.solution.style import BLUE, COLOURS, given_or_new, new_figure, style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MANY = 12
"""A batch of more trajectories than this is drawn in one translucent colour."""

ENVELOPE = 1000
"""On a logarithmic scale, longer series are drawn by their largest value in each of this many pieces of time."""

ENERGY_ERROR = "$|E - E_0| \\,/\\, |E_0|$"


def picture(draw: Callable) -> Callable:
    """A function that draws a solution in the style of dirax. It raises `ValueError` inside of `jax.grad`, `jit` or `vmap`."""

    @functools.wraps(draw)
    def drawn(sol: Any, *how: Any, **named: Any) -> Any:
        sol.refuse_traced("draw it")
        with style():
            return draw(sol, *how, **named)

    return drawn


@picture
def plot_trajectory(
    sol: Any, x: int | str = 0, y: int | str | None = None, z: int | str | None = None, *, ax: "Axes | None" = None, **line: Any
) -> "Axes":
    """The path in the plane of two coordinates, or in the space of three, one curve a trajectory, a dot where each begins;
    equal scales where the coordinates have the same unit and are not angles. Of a system with one coordinate it is the one of
    `plot_coordinate`.

    `x`, `y`, `z`: index or name of an entry of q (of `sol.x` where there is no q), by default the first two. `ax`: for three
    coordinates one of matplotlib's projection "3d". Raises `ValueError` for unknown ones.
    """
    if y is None and z is None and len(names_of(sol)) == 1:
        return plot_coordinate(sol, x, ax=ax, **line)
    chosen = [index_of(sol, each) for each in (x, 1 if y is None else y, z) if each is not None]
    space = len(chosen) == 3
    ax = given_or_new(ax, projection="3d") if space else given_or_new(ax)
    if space and not hasattr(ax, "set_zlabel"):
        raise ValueError('ax must have the projection "3d" for a path in space: figure.add_subplot(projection="3d").')
    lanes = _lanes(sol, position(sol))
    for path, kwargs in zip(lanes, _lines(len(lanes), line), strict=True):
        (curve,) = ax.plot(*path[:, chosen].T, **kwargs)
        ax.plot(*path[:1, chosen].T, "o", ms=3.5, color=curve.get_color(), label="_start")
    names, units = names_of(sol), units_of(sol)
    labels = [label(symbol(names[i]), units[i]) for i in chosen]
    ax.set(**dict(zip(("xlabel", "ylabel", "zlabel"), labels, strict=False)))
    if {units[i] for i in chosen} == {units[chosen[0]]} != {"rad"}:
        ax.set_aspect("equal", adjustable="datalim")
    return ax


@picture
def plot_coordinate(sol: Any, i: int | str = 0, *, field: str = "q", ax: "Axes | None" = None, **line: Any) -> "Axes":
    """One entry of a saved field against time: `field` is "q" (x where there is none), "p" or another array of nodes.

    Raises `ValueError` for an unknown entry.
    """
    index = index_of(sol, i)
    ax = given_or_new(ax)
    field = "x" if field == "q" and "q" not in sol.fields else field
    lanes = _lanes(sol, np.asarray(sol.fields[field]))
    for t, values, kwargs in zip(sol.times, lanes, _lines(len(lanes), line), strict=True):
        ax.plot(t, values[:, index], **kwargs)
    placed = ("q" in sol.fields and field == "q") or field == "x"
    name = names_of(sol)[index]
    name = symbol(name) if placed else symbol(field, name)
    ax.set(xlabel=time_label(sol), ylabel=label(name, units_of(sol)[index] if placed else ""))
    return ax


@picture
def plot_energy(sol: Any, *, figure: "Figure | None" = None, ax: Any = None, **line: Any) -> "Figure":
    """The energy against time, and beside it its error |E − E(0)| / |E(0)| on a logarithmic scale (absolute if E(0) = 0).

    `ax`: an Axes for the energy alone, or two for both.
    """
    if ax is not None:
        axes = list(np.ravel(ax))
    elif figure is not None:
        axes = list(figure.axes if figure.axes else figure.subplots(1, 2))
    else:
        axes = list(new_figure(1, 2, size=(9.2, 3.4))[1])
    left, *others = axes
    right = others[0] if others else None
    energies = np.atleast_2d(np.asarray(sol.energy()))
    for t, values, kwargs in zip(sol.times, energies, _lines(len(energies), line), strict=True):
        left.plot(t, values, **kwargs)
        if right is not None:
            plot_error(right, t, values, **kwargs)
    relative = bool(np.all(energies[:, 0] != 0))
    unit = sol.metadata.get("units", {}).get("energy", "")
    left.set(xlabel=time_label(sol), ylabel=label("energy $E$", unit))
    if right is not None:
        right.set(xlabel=time_label(sol), ylabel=ENERGY_ERROR if relative else label("$|E - E_0|$", unit))
    return left.figure  # type: ignore[return-value]


@style()
def plot_error(ax: "Axes", t: Any, values: Any, **line: Any) -> None:
    """|values − values[0]| against `t` on a logarithmic scale, relative to |values[0]| unless that is 0; zeros are left out."""
    values = np.asarray(values)
    _plot_log(ax, np.asarray(t), np.abs(values - values[0]) / (abs(values[0]) or 1.0), **line)


@picture
def plot_phase(sol: Any, i: int | str = 0, *, ax: "Axes | None" = None, **line: Any) -> "Axes":
    """The path in the phase plane (q_i, p_i). Raises `ValueError` for an unknown coordinate or a solution without p."""
    index = index_of(sol, i)
    if "q" not in sol.fields or "p" not in sol.fields:
        raise ValueError(
            f"a phase plane needs q and p, but this solution holds {', '.join(sol.fields)}: plot_trajectory shows x."
        )
    ax = given_or_new(ax)
    lanes_q, lanes_p = _lanes(sol, np.asarray(sol.q)), _lanes(sol, np.asarray(sol.p))
    for q, p, kwargs in zip(lanes_q, lanes_p, _lines(len(lanes_q), line), strict=True):
        (curve,) = ax.plot(q[:, index], p[:, index], **kwargs)
        ax.plot(q[:1, index], p[:1, index], "o", ms=3.5, color=curve.get_color(), label="_start")
    name = names_of(sol)[index]
    ax.set(xlabel=label(symbol(name), units_of(sol)[index]), ylabel=symbol("p", name))
    return ax


@picture
def plot_constraint(sol: Any, *, ax: "Axes | None" = None, **line: Any) -> "Axes":
    """The largest absolute constraint residual against time on a logarithmic scale; exact zeros are left out.

    Raises `ValueError` for a system without constraints.
    """
    residual = np.asarray(sol.constraint_residual())
    if residual.shape[-1] == 0:
        raise ValueError("this system has no constraints, so there is no residual to plot.")
    ax = given_or_new(ax)
    worst = np.atleast_2d(np.max(np.abs(residual), axis=-1))
    for t, values, kwargs in zip(sol.times, worst, _lines(len(worst), line), strict=True):
        _plot_log(ax, t[: values.size], values, **kwargs)
    ax.set(xlabel=time_label(sol), ylabel="largest constraint residual")
    return ax


@picture
def plot_momenta(sol: Any, symmetries: Mapping[str, Callable] | None = None, *, ax: "Axes | None" = None, **line: Any) -> "Axes":
    """How far the momenta of symmetries have moved since the start, J(t) − J(0) with J = ⟨p, ξ(q)⟩, against time.

    `symmetries`: generators ξ(q) -> (n,) by name, by default those of the gallery's system; where there are none, the
    momenta p themselves are drawn. Raises `ValueError` for a solution without p.
    """
    if "p" not in sol.fields:
        raise ValueError(f"momenta need p, but this solution holds {', '.join(sol.fields)}.")
    symmetries = symmetries or dict(getattr(getattr(sol, "example", None), "symmetries", {}))
    ax = given_or_new(ax)
    if symmetries:
        curves = {symbol(*letter_and_index(name)): np.asarray(sol.momentum_map(xi)) for name, xi in symmetries.items()}
        curves = {name: values - values[..., :1] for name, values in curves.items()}
        ylabel = "$J - J(0)$"
    else:
        curves = {symbol("p", name): np.asarray(sol.p)[..., k] for k, name in enumerate(names_of(sol))}
        ylabel = "momentum $p$"
    for k, (name, values) in enumerate(curves.items()):
        lanes = np.atleast_2d(values)
        lines = _lines(len(lanes), {"label": name, "color": COLOURS[k % len(COLOURS)], **line})
        for t, one, kwargs in zip(sol.times, lanes, lines, strict=True):
            ax.plot(t, one, **kwargs)
    ax.set(xlabel=time_label(sol), ylabel=ylabel)
    ax.legend()
    return ax


@picture
def plot_section(
    sol: Any,
    x: int | str = 0,
    y: int | str = 1,
    *,
    through: int | str | None = None,
    value: float = 0.0,
    direction: int = 1,
    points: Any = None,
    ax: "Axes | None" = None,
    **marks: Any,
) -> "Axes":
    """A Poincaré section: the states in which the coordinate `through` passes `value`, in the plane of `x` and `y`.

    `x`, `y`, `through`: index or name of an entry of the state, the q (or x) and after them the momenta p_NAME.
    `direction`: 1 counts passages upwards, −1 downwards, 0 both; they are interpolated between the saved rows. `points`:
    states (k, n) found elsewhere, or a list of such arrays, one a trajectory, drawn instead.
    Raises `ValueError` for unknown coordinates, and where neither `through` nor `points` is given.
    """
    names = state_names(sol)
    i, j = entry(names, x), entry(names, y)
    if points is None:
        if through is None:
            raise ValueError(f"give through=, one of {', '.join(names)}, or the points= of a section.")
        k = entry(names, through)
        lanes = [crossings(t, lane, k, value, direction) for t, lane in zip(sol.times, _lanes(sol, states_of(sol)), strict=True)]
    else:
        lanes = [np.atleast_2d(lane) for lane in (points if isinstance(points, list | tuple) else [points])]
    if any(lane.shape[-1] != len(names) for lane in lanes):
        raise ValueError(f"points must be states ({', '.join(names)}), {len(names)} numbers, but they have {lanes[0].shape[-1]}.")
    ax = given_or_new(ax)
    for lane, kwargs in zip(lanes, _lines(len(lanes), marks), strict=True):
        look: dict[str, Any] = {"ms": 2.0, "mew": 0, **kwargs, "lw": 0}
        ax.plot(lane[:, i], lane[:, j], "o", **look)
    units = [*units_of(sol), *[""] * len(names)]
    ax.set(xlabel=label(state_symbol(names[i]), units[i]), ylabel=label(state_symbol(names[j]), units[j]))
    if through is not None:
        ax.set_title(f"where {state_symbol(names[entry(names, through)])} passes {value:g}")
    return ax


def _plot_log(ax: "Axes", t: np.ndarray, values: np.ndarray, **line: Any) -> None:
    if len(values) > 2 * ENVELOPE:
        starts = np.linspace(0, len(values), ENVELOPE, endpoint=False).astype(int)
        values, t = np.fmax.reduceat(values, starts), t[starts]
    ax.set_yscale("log")
    ax.plot(t, np.where(values > 0, values, np.nan), **line)


def _lanes(sol: Any, values: np.ndarray) -> np.ndarray:
    """Values with a batch axis in front, of length 1 for one trajectory."""
    return values if sol.batch is not None else values[None]


def _lines(count: int, line: dict) -> list[dict]:
    """Keywords of each of `count` curves: one label for all, and one translucent colour if they are many."""
    many = {"color": BLUE, "alpha": max(0.06, min(0.5, 6 / count)), "lw": 0.7} if count > MANY else {}
    called = line.get("label")
    return [{**many, **line, **({"label": called if k == 0 else "_more"} if called else {})} for k in range(count)]
