"""Collocation of 1024 trajectories beside heyoka's batch mode, on Hénon–Heiles to t = 100: the numbers of docs/speed.md.

    python -m benchmarks.collocation_batch

Needs heyoka. Times are those of one trajectory on one thread, the best of interleaved repeats (`stats["run_seconds"]`); the
error is the largest of all trajectories at the end. On a busy machine only processor times say something.
"""

import os
import time
from collections.abc import Iterator

os.environ["DIRAX_THREADS"] = "1"

import heyoka as hy
import numpy as np

import dirax as dx
from benchmarks.work_precision import henon_heiles

BATCH, SIDE_BY_SIDE, REPEATS, END = 1024, 8, 4, 100.0
TOLERANCES = 10.0 ** -np.arange(6, 16)
SETTINGS = ((4, 0.25), (4, 0.5), (5, 0.5), (6, 1.0), (7, 1.0), (8, 1.0), (8, 0.5), (10, 2.0), (12, 2.0))


def taylor(solver, start: np.ndarray) -> tuple[float, np.ndarray]:
    """(seconds, ends) of heyoka's batch integrator."""
    ends, begun = np.empty_like(start), time.perf_counter()
    for part in propagated(solver, start):
        ends[part] = solver.state.T
    return time.perf_counter() - begun, ends


def propagated(solver, start: np.ndarray) -> Iterator[slice]:
    """The trajectories that heyoka's integrator has at the end, those side by side one after the other."""
    for i in range(0, BATCH, SIDE_BY_SIDE):
        part = slice(i, i + SIDE_BY_SIDE)
        solver.set_time(0.0)
        solver.state[:] = start[part].T
        solver.propagate_until(END)
        yield part


def beside_heyoka(tolerances) -> tuple[np.ndarray, np.ndarray, dict, np.ndarray]:
    """Positions and velocities (BATCH, 2) of a start, heyoka's integrators by their tolerances, and the positions at the end."""
    numbers = np.random.default_rng(0)
    q = np.array([0.3, 0.1]) * (1 - 0.3 * numbers.random((BATCH, 1)))
    v = np.array([0.2, 0.35]) * (1 - 0.3 * numbers.random((BATCH, 1)))
    x, y, u, w = hy.make_vars("x", "y", "u", "w")
    field = [(x, u), (y, w), (u, -x - 2 * x * y), (w, -y - x * x + y * y)]
    made = lambda tolerance: hy.taylor_adaptive_batch(field, np.zeros((4, SIDE_BY_SIDE)), tol=float(tolerance))
    exact = taylor(made(1e-18), np.concatenate([q, v], axis=1))[1][:, :2]
    return q, v, {t: made(t) for t in tolerances}, exact


def main() -> None:
    """Print a line for every setting."""
    q, v, solvers, exact = beside_heyoka(TOLERANCES)
    start, system = np.concatenate([q, v], axis=1), dx.LagrangeDirac(henon_heiles)
    found, runs = {}, {}
    for s, h in SETTINGS:
        n = round(END / h)
        runs[s, h] = dx.prepare(system, dx.Collocation(s), q=q, v=v, step=END / n, steps=n, save_every=n)
    for _ in range(REPEATS):
        for tolerance, solver in solvers.items():
            seconds, ends = taylor(solver, start)
            found.setdefault(f"heyoka, {tolerance:.0e}", []).append((seconds, np.max(np.abs(ends[:, :2] - exact))))
        for (s, h), run in runs.items():
            sol = run()
            error = np.max(np.abs(np.asarray(sol.q)[:, -1] - exact))
            found.setdefault(f"dirax, s = {s}, h = {h}", []).append((sol.stats["run_seconds"], error))
    for name, values in found.items():
        print(f"{name}: {min(values)[0] / BATCH * 1e6:.1f} µs, error {values[0][1]:.1e}")


if __name__ == "__main__":
    main()
