"""The picture of docs/speed.md: work against precision of collocation and of heyoka, and their energies over a million steps.

python -m benchmarks.work_precision_picture     draws docs/images/work_precision.png; needs heyoka
"""

from pathlib import Path

import heyoka as hy
import matplotlib.pyplot as plt
import numpy as np

import dirax as dx
from benchmarks.work_precision import cases, henon_heiles, measured

SYSTEMS = ("Hénon–Heiles, t = 100", "Kepler, e = .6, ten turns", "four vortices, t = 300")
STEPS, STEP, ROWS = 1_000_000, 0.5, 200
TOLERANCES = (1e-12, 1e-15, 2.3e-16)


def front(points: list) -> np.ndarray:
    """The settings than which none is both faster and more accurate, (error, µs), by error."""
    kept, best = [], np.inf
    for error, seconds in sorted((p[1], p[0]) for p in points if 0.0 < p[1] < 1e-2):
        if seconds < best:
            best = seconds
            kept.append((error, 1e6 * seconds))
    return np.array(kept)


def energy(x: np.ndarray) -> np.ndarray:
    """That of Hénon and Heiles, of rows (q, v)."""
    x, y, u, w = x.T
    return (u * u + w * w) / 2 + (x * x + y * y) / 2 + x * x * y - y**3 / 3


def energies(axes) -> None:
    """|H − H(0)| of both programs at the same times."""
    every = STEPS // ROWS
    sol = dx.simulate(dx.LagrangeDirac(henon_heiles), dx.Collocation(8), q=[0.3, 0.1], v=[0.2, 0.35], step=STEP, steps=STEPS,
                      save_every=every)  # fmt: skip
    lines = {"dirax, 8 stages, h = .5": np.concatenate([sol.q, sol.p], axis=1)}
    x, y, u, w = hy.make_vars("x", "y", "u", "w")
    equations = [(x, u), (y, w), (u, -x - 2 * x * y), (w, -y - x * x + y * y)]
    for tolerance in TOLERANCES:
        solver = hy.taylor_adaptive(equations, [0.3, 0.1, 0.2, 0.35], tol=tolerance)
        lines[f"heyoka, {tolerance:.0e}"] = solver.propagate_grid(np.asarray(sol.t))[-1]
    for (name, rows), style in zip(lines.items(), ("C0-", "C1:", "C1--", "C1-"), strict=True):
        off = np.maximum.accumulate(np.abs(energy(rows) - energy(rows[:1])))
        axes.loglog(np.asarray(sol.t)[1:], np.maximum(off[1:], 1e-17), style, label=name)
        print(f"{name}: largest |H - H(0)| {off[-1]:.1e}")
    axes.set(xlabel="t", ylabel="largest |H − H(0)| so far", title="Hénon–Heiles, a million steps")
    axes.legend(fontsize=8)


def main() -> None:
    """Draw it."""
    figure, (work, drift) = plt.subplots(1, 2, figsize=(10, 4.2), layout="constrained")
    for number, name in enumerate(SYSTEMS):
        theirs, ours = measured(name, *cases()[name])
        for points, style, program in ((ours, "-o", "dirax"), (theirs, "--s", "heyoka")):
            errors = front(points)
            work.loglog(errors[:, 0], errors[:, 1], style, color=f"C{number}", ms=4, label=f"{name.split(',')[0]}, {program}")
    work.set(xlabel="error at the end", ylabel="µs", title="Work against precision")
    work.invert_xaxis()
    work.legend(fontsize=8)
    energies(drift)
    figure.savefig(Path(__file__).parents[1] / "docs/images/work_precision.png", dpi=110)


if __name__ == "__main__":
    main()
