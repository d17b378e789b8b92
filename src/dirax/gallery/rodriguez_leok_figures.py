"""Figures 1, 3 and 4 of [RL], and beside Figure 4 the energy itself."""

from typing import Any

import numpy as np

from dirax.gallery import charged_particle
from dirax.solution.plotting import ENERGY_ERROR, plot_error
from dirax.solution.solution import Solution
from dirax.solution.style import BLUE, INK, VERMILION, new_figure, style


@style()
def helix_figure(sol: Solution) -> Any:
    """Figure 1: the particle in space, exact and computed."""
    figure, ax = new_figure(size=(5.6, 5.0), subplot_kw={"projection": "3d"})
    times = np.linspace(0.0, charged_particle.END, 1000)
    exact = charged_particle.exact(times, **charged_particle.EXAMPLE.initial)
    q = np.asarray(sol.q)
    ax.plot(*exact[:, :3].T, color=INK, lw=0.9, label="exact")
    ax.plot(*q[:, :3].T, "o-", color=VERMILION, ms=2.2, lw=0.8, label=f"(+), h = {sol.step:g}")
    ax.set(xlabel="$x$", ylabel="$y$", zlabel="$z$", title="Figure 1. Charged particle")
    ax.set_box_aspect(None, zoom=0.86)
    ax.legend()
    return figure


@style()
def pendulum_figure(sol: Solution) -> Any:
    """Figure 3: φ1 against time, and the second mass seen from above."""
    figure, (left, right) = new_figure(1, 2, size=(9.6, 4.2))
    t, q = np.asarray(sol.t), np.asarray(sol.q)
    left.plot(t, q[:, 1], color=BLUE)
    left.set(xlabel="$t$ (s)", ylabel="$φ_1$ (rad)", xlim=(0, t[-1]), title="Figure 3. Double spherical pendulum: $φ_1$")
    place = second_mass(q, sol.params)
    right.plot(place[:, 0], place[:, 1], color=BLUE, lw=0.9)
    right.plot(*place[0, :2], "o", ms=3.5, color=BLUE)
    right.set(xlabel="$x$ (m)", ylabel="$y$ (m)", title="Second mass from above")
    right.set_aspect("equal", adjustable="datalim")
    return figure


def second_mass(q: np.ndarray, params: Any) -> np.ndarray:
    """The position of the second mass, (rows, 3), from q = (ϑ1, φ1, ϑ2, φ2) of shape (rows, 4)."""
    total = np.zeros((len(q), 3))
    for length, azimuth, angle in (
        (float(params["l1"]), q[:, 0] - q[:, 2], q[:, 1]),
        (float(params["l2"]), q[:, 0] + q[:, 2], q[:, 3]),
    ):
        across = np.sin(angle)
        total += length * np.stack([across * np.cos(azimuth), across * np.sin(azimuth), np.cos(angle)], axis=1)
    return total


@style()
def energy_figure(sol: Solution, reduced: np.ndarray, unreduced: np.ndarray) -> Any:
    """Figure 4: L_d, which the paper calls the discrete energy; its difference to the unreduced run; the error of the energy."""
    figure, (left, middle, right) = new_figure(1, 3, size=(13.2, 3.6))
    t = np.asarray(sol.t)
    left.plot(t[:-1], reduced, color=BLUE)
    left.set(xlabel="$t$ (s)", ylabel="$E_d = L_d$ (J s)", title="Figure 4. The paper's discrete energy")
    middle.plot(t[:-1], reduced - unreduced, color=BLUE, lw=0.5)
    middle.set(xlabel="$t$ (s)", ylabel="reduced − unreduced (J s)", title="Its difference to the unreduced run")
    plot_error(right, t, np.asarray(sol.energy()), color=VERMILION)
    right.set(xlabel="$t$ (s)", ylabel=ENERGY_ERROR, title="Error of the energy")
    for ax in (left, middle, right):
        ax.set_xlim(0, t[-1])
    return figure
