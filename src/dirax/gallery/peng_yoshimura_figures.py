"""Figures 9–20 of [PY]: the paper's quantities on the paper's axes, and beside each energy its error on a logarithmic scale."""

from typing import Any

import numpy as np

from dirax.gallery.peng_yoshimura_quantities import AXIS_END, SIGN, generalized_energy, path_energy
from dirax.solution.plotting import ENERGY_ERROR, plot_coordinate, plot_error, plot_trajectory
from dirax.solution.solution import Solution
from dirax.solution.style import BLUE, GREEN, VERMILION, new_figure, style


@style()
def disk_figures(sign: str, sol: Solution) -> dict[str, Any]:
    """Figures 9–12 for (+), 13–16 for (−), by file name."""
    first = {"+": 9, "-": 13}[sign]
    scheme = f"rolling disk, {SIGN[sign]}, h = {sol.step:g}"

    path, ax = new_figure(size=(5.4, 4.8))
    plot_trajectory(sol, "x", "y", ax=ax, lw=0.35)
    ax.set_title(f"Figure {first}. Trajectory: {scheme}")

    energy = _energy_figure(
        sol,
        generalized_energy(sol, sign),
        path_energy(sol),
        f"Figure {first + 1}. Energy: {scheme}",
        ylabel=f"$E_d^{sign}$",
    )
    energy.axes[0].set(xlim=(0, AXIS_END), ylim=(-1, 1))

    position, ax = new_figure(size=(5.4, 3.3))
    plot_coordinate(sol, "x", ax=ax)
    ax.set(xlim=(0, AXIS_END), ylim=(-25, 25), title=f"Figure {first + 2}. Position x: {scheme}")

    momentum, ax = new_figure(size=(5.4, 3.3))
    plot_coordinate(sol, "φ", field="p", ax=ax)
    ax.set(xlim=(0, AXIS_END), ylim=(-2, 2), title=f"Figure {first + 3}. Momentum $p_φ$: {scheme}")
    figures = (path, energy, position, momentum)
    return {f"figure_{first + k:02d}": figure for k, figure in enumerate(figures)}


@style()
def heisenberg_figures(sol: Solution) -> dict[str, Any]:
    """Figures 17–20, by file name."""
    h, q, t = sol.step, np.asarray(sol.q), np.asarray(sol.t)
    velocity = np.diff(q, axis=0) / h
    position = _components(t, q, "position", "Figure 17. Position: Heisenberg system", ("$x$", "$y$", "$z$"))
    position.axes[0].set(ylim=(-15000, 15000))
    names = ("$v_x$", "$v_y$", "$v_z$")
    speed = _components(t[:-1], velocity, "velocity", "Figure 18. Velocity: Heisenberg system", names)
    names = ("$p_x$", "$p_y$", "$p_z$")
    momentum = _components(t, np.asarray(sol.p), "momentum", "Figure 19. Momentum: Heisenberg system", names)
    for figure in (speed, momentum):
        figure.axes[0].set(ylim=(-15, 15))
    energies = np.sum(velocity**2, axis=1) / 2
    energy = _energy_figure(sol, energies, energies, "Figure 20. Energy: Heisenberg system", "$E_d$")
    energy.axes[0].set(ylim=(0, 200), xlim=(0, 1000))
    return {"figure_17": position, "figure_18": speed, "figure_19": momentum, "figure_20": energy}


def _energy_figure(sol: Solution, shown: np.ndarray, measured: np.ndarray, title: str, ylabel: str) -> Any:
    """Two panels: the paper's energy on the paper's axis, and the relative error of the energy itself."""
    t = np.asarray(sol.t)[:-1]
    figure, (left, right) = new_figure(1, 2, size=(9.6, 3.4))
    left.plot(t, shown, color=BLUE)
    left.set(xlabel="$t$", ylabel=ylabel, title=title)
    plot_error(right, t, measured, color=VERMILION)
    right.set(xlabel="$t$", ylabel=ENERGY_ERROR, xlim=(0, round(t[-1])), title="Error of the energy")
    return figure


def _components(t: np.ndarray, values: np.ndarray, ylabel: str, title: str, names: tuple[str, ...]) -> Any:
    figure, ax = new_figure(size=(5.4, 3.5))
    styles = ("-", "-", (0, (5, 2)))
    for k, (name, colour) in enumerate(zip(names, (BLUE, VERMILION, GREEN), strict=True)):
        ax.plot(t[::50], values[::50, k], color=colour, ls=styles[k], label=name, lw=1.5)
    ax.set(xlabel="$t$", ylabel=ylabel, title=title, xlim=(0, 1000))
    ax.legend(ncols=3, loc="upper left")
    return figure
