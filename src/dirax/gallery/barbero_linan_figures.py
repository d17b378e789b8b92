"""Figures 1–3 of [BLM]: the vortices' paths, and their energies over 10⁶ and over 500 steps."""

from typing import Any

import numpy as np

from dirax.solution.solution import Solution
from dirax.solution.style import BLUE, GREEN, PURPLE, VERMILION, new_figure


def path_figure(methods: dict[int, np.ndarray], runge_kutta: np.ndarray) -> Any:
    """Figure 1: the four paths by Methods 1, 2 and RK2, 300 steps."""
    panels = {**{f"Method {n}": q for n, q in methods.items()}, "RK2": runge_kutta}
    figure, axes = new_figure(len(panels), 1, size=(7.6, 6.4), sharex=True, sharey=True)
    for ax, (name, q) in zip(axes, panels.items(), strict=True):
        for j, colour in enumerate((BLUE, VERMILION, GREEN, PURPLE)):
            ax.plot(q[:, j], q[:, 4 + j], color=colour, lw=0.9)
            ax.plot(q[:1, j], q[:1, 4 + j], "o", ms=3.5, color=colour)
        ax.set(ylabel="y", title=f"Figure 1. Four vortices, h = 1, 300 steps: {name}" if name == "Method 1" else name)
    axes[-1].set(xlabel="x")
    return figure


def energy_figure(methods: dict[int, Solution], runge_kutta: np.ndarray, every: int) -> Any:
    """Figure 2: H(t) − H(0) to t = 10⁶ of each method beside RK2."""
    figure, axes = new_figure(1, 2, size=(9.6, 3.4), sharey=True)
    t = every * np.arange(len(runge_kutta))
    for ax, (number, sol) in zip(axes, methods.items(), strict=True):
        energy = np.asarray(sol.energy())
        ax.plot(t, runge_kutta - runge_kutta[0], color=VERMILION, lw=0.7, label="RK2")
        ax.plot(sol.t, energy - energy[0], color=BLUE, lw=0.7, label=f"Method {number}")
        ax.set(xlabel="t", title=f"Figure 2. Method {number} and RK2, h = 1")
        ax.legend(loc="best")
    axes[0].set(ylabel="H(t) − H(0)")
    return figure


def zoom_figure(methods: dict[int, Solution]) -> Any:
    """Figure 3: H(t) − H(0) of Methods 1 and 2 over 500 steps."""
    figure, ax = new_figure(size=(6.4, 3.6))
    for (number, sol), colour in zip(methods.items(), (VERMILION, BLUE), strict=True):
        energy = np.asarray(sol.energy())
        ax.plot(sol.t, energy - energy[0], color=colour, lw=0.9, label=f"Method {number}")
    ax.set(xlabel="t", ylabel="H(t) − H(0)", title="Figure 3. Energy of Methods 1 and 2, h = 1")
    ax.legend(loc="best")
    return figure
