"""The picture of the README: what a scheme does to a disk that rolls for a while."""

from typing import Any

import numpy as np

from dirax.gallery.rolling_disk import EXAMPLE, exact
from dirax.schemes.lagrange_dirac import LagrangeDAlembert, MinusLagrangeDirac, PlusLagrangeDirac
from dirax.solution.plotting import ENERGY_ERROR, plot_error
from dirax.solution.style import BLUE, GREEN, INK, VERMILION, new_figure, save_figure, style

SCHEMES = {
    "(+) Lagrange–Dirac": (PlusLagrangeDirac(), VERMILION, 0.7),
    "(−) Lagrange–Dirac": (MinusLagrangeDirac(), BLUE, 0.7),
    "midpoint Lagrange–d’Alembert": (LagrangeDAlembert("midpoint", "midpoint"), GREEN, 2.6),
}


def picture(path: Any, step: float = 0.01, end: float = 60.0) -> None:
    """Draw the rolling disk's path and energy error by three schemes, with the exact path, into a file.

    `path`: any format that matplotlib writes, by its ending; `step` and `end` in the disk's unit of time.
    """
    save_figure(draw(step, end), path)


@style()
def draw(step: float, end: float) -> Any:
    """The picture as a matplotlib Figure."""
    figure, (left, right) = new_figure(1, 2, size=(9.6, 4.4), width_ratios=(1, 1.15))
    for name, (scheme, colour, width) in SCHEMES.items():
        sol = EXAMPLE.simulate(scheme, step=step, steps=round(end / step))
        left.plot(sol.q[:, 0], sol.q[:, 1], color=colour, lw=width, label=name)
        plot_error(right, sol.t, sol.energy(), color=colour, lw=1.3, label=name)
    path = exact(np.arange(0, 2 * np.pi, 0.01), **EXAMPLE.initial)  # once round; every turn is nearly the same
    left.plot(path[:, 0], path[:, 1], color=INK, lw=0.9, ls=(0, (4, 3)), label="exact")
    left.set(xlabel="$x$", ylabel="$y$", title=f"Path of a rolling disk, h = {step:g}")
    left.set_aspect("equal", adjustable="datalim")
    right.set(xlabel="$t$", ylabel=ENERGY_ERROR, title="Error of its energy", xlim=(0, end))
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure
