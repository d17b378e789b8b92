"""The figure of Hénon and Heiles: where orbits of one energy go through the plane x = 0, islands in a chaotic sea.

M. Hénon, C. Heiles, The applicability of the third integral of motion, Astron. J. 69 (1964) 73–79, figures 4 to 6.
"""

from typing import Any

import numpy as np

from dirax.gallery.henon_heiles import ENERGY, EXAMPLE
from dirax.run.event import Event
from dirax.run.simulate import simulate
from dirax.schemes.collocation import Collocation
from dirax.solution.solution import Solution
from dirax.solution.style import COLOURS, new_figure, save_figure


def crosses(q):
    """x, which is zero on the section."""
    return q[0]


def section(energy: float = ENERGY, orbits: int = 24, steps: int = 2000, step: float = 0.5) -> Solution:
    """Orbits of one energy that begin on x = 0, with `sol.events` at each passage through it with ẋ > 0: y = q[1], ẏ = p[1].

    They start with ẏ = 0 at places y along the part of the axis that the energy allows.
    """
    roots = np.roots([-1 / 3, 0.5, 0.0, -energy])
    low, high = sorted(roots[np.abs(roots.imag) < 1e-9].real)[:2]  # V(0, y) = y²/2 − y³/3 = E
    y = low + (high - low) * (np.arange(orbits) + 0.5) / orbits
    q = np.stack([np.zeros(orbits), y], axis=1)
    v = np.stack([np.sqrt(2 * energy - y**2 + 2 * y**3 / 3), np.zeros(orbits)], axis=1)
    passage = Event(crosses, direction=+1)
    return simulate(EXAMPLE.system, Collocation(6), q=q, v=v, step=step, steps=steps, events=[passage], save_every=steps)


def picture(path: Any, energy: float = ENERGY, orbits: int = 24, steps: int = 4000) -> None:
    """Draw the section into a file of any format that matplotlib writes."""
    sol = section(energy, orbits, steps)
    passages = np.concatenate([sol.events.q, sol.events.p], axis=1)
    figure, ax = new_figure(size=(5.2, 4.8))
    for lane in np.unique(sol.events.lane):
        colour = COLOURS[int(lane) % len(COLOURS)]
        sol.plot_section(1, 3, points=passages[sol.events.lane == lane], ax=ax, color=colour, ms=1.3, rasterized=True)
    ax.set(xlabel="$y$", ylabel=r"$\dot{y}$", title=f"Hénon–Heiles, x = 0, E = {energy:.4g}")
    save_figure(figure, path)
