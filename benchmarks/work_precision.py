"""Collocation beside heyoka: the time to reach an error at the end, on six systems; the table of docs/speed.md.

    python -m benchmarks.work_precision [SYSTEM …]      prints the table in Markdown
    python -m benchmarks.work_precision_picture         draws docs/images/work_precision.png

Needs heyoka (`pip install heyoka`). Times are the best of interleaved repeats on one thread, `stats["run_seconds"]` of a prepared
run and the time of `propagate_until`; each reaches the error with the cheapest of its settings.
"""

import sys
import time
from typing import Any

import heyoka as hy
import jax.numpy as jnp
import numpy as np

import dirax as dx
from dirax.gallery import double_spherical_pendulum, heavy_top, vortices

ERRORS = (1e-6, 1e-9, 1e-12)
REPEATS = 5
TOLERANCES = 10.0 ** -np.arange(5, 17)
IN_A_ROW = 4
"""Runs one after the other in a repeat: the first finds cold caches."""

STAGES = (4, 6, 8, 12, 16)
FEWER = (4, 6, 8)
"""Of a system whose steps of more stages take seconds to compile."""

GRAVITY = 2.95912208286e-4
MASSES = (1.00000597682, 0.000954786104043, 0.000285583733151, 0.0000437273164546, 0.0000517759138449, 1 / 1.3e8)
PLANETS = """
0 0 0 0 0 0
-3.5023653 -3.8169847 -1.5507963 0.00565429 -0.00412490 -0.00190589
9.0755314 -3.0458353 -1.6483708 0.00168318 0.00483525 0.00192462
8.3101420 -16.2901086 -7.2521278 0.00354178 0.00137102 0.00055029
11.4707666 -25.7294829 -10.8169456 0.00288930 0.00114527 0.00039677
-15.5387357 -25.2225594 -3.1902382 0.00276725 -0.00170702 -0.00136504
"""
"""Sun, Jupiter, Saturn, Uranus, Neptune, Pluto: astronomical units and days (Hairer, Lubich, Wanner, I.2.4)."""


def henon_heiles(q, v):
    """L(q, v), a scalar."""
    return (v @ v) / 2 - (q @ q) / 2 - (q[0] ** 2 * q[1] - q[1] ** 3 / 3)


def kepler(q, v):
    """L(q, v), a scalar."""
    return (v @ v) / 2 + 1 / jnp.sqrt(q @ q)


def outer_solar_system(q, v):
    """L(q, v), a scalar."""
    q, v = q.reshape(6, 3), v.reshape(6, 3)
    kinetic = sum(mass * (u @ u) for mass, u in zip(MASSES, v, strict=True)) / 2
    pairs = [(i, j) for i in range(6) for j in range(i)]
    return kinetic + sum(GRAVITY * MASSES[i] * MASSES[j] / jnp.sqrt((q[i] - q[j]) @ (q[i] - q[j])) for i, j in pairs)


def cases() -> dict[str, tuple]:
    """Name → (system, initial data, heyoka's equations, end, steps, and stages where they are not STAGES)."""
    x, y, u, w = hy.make_vars("x", "y", "u", "w")
    r = (x * x + y * y) ** -1.5
    plane = np.array([float(n) for n in PLANETS.split()]).reshape(6, 6)
    pendulum, top = double_spherical_pendulum.EXAMPLE, heavy_top.EXAMPLE
    whirls = vortices.point_vortices(vortices.CIRCULATIONS)
    return {
        "Hénon–Heiles, t = 100": (
            dx.LagrangeDirac(henon_heiles), {"q": [0.3, 0.1], "v": [0.2, 0.35]},
            [(x, u), (y, w), (u, -x - 2 * x * y), (w, -y - x * x + y * y)], 100.0, (2.0, 1.0, 0.5, 0.25),
        ),
        "Kepler, e = .6, ten turns": (
            dx.LagrangeDirac(kepler), {"q": [0.4, 0.0], "v": [0.0, 2.0]},
            [(x, u), (y, w), (u, -x * r), (w, -y * r)], 20 * np.pi, tuple(np.pi / np.array([5, 7, 10, 14, 20, 28, 40])),
        ),
        "outer solar system, 100 000 days": (
            dx.LagrangeDirac(outer_solar_system), {"q": plane[:, :3].ravel(), "v": plane[:, 3:].ravel()},
            hy.model.nbody(6, masses=list(MASSES), Gconst=GRAVITY), 1e5, (1000.0, 500.0, 250.0, 125.0), FEWER,
        ),
        "double spherical pendulum, t = 30": (
            dx.LagrangeDirac(double_spherical_pendulum.lagrangian),
            {"q": pendulum.initial["q"], "p": pendulum.initial["p"], "params": pendulum.params},
            _angles(pendulum.params), 30.0, (1.0, 0.5, 0.25, 0.125, 0.0625), FEWER,
        ),
        "four vortices, t = 300": (whirls, {"q": vortices.FOUR}, _whirls(), 300.0, (12.0, 6.0, 3.0, 1.5)),
        "heavy top, t = 100": (
            top.system, {"x": top.initial["x"], "params": top.params}, _top(top.params), 100.0, (1.0, 0.5, 0.25, 0.125),
        ),
    }  # fmt: skip


def _angles(p):
    """The double spherical pendulum by heyoka's own Lagrangian mechanics."""
    q, v = hy.make_vars("a", "b", "c", "d"), hy.make_vars("va", "vb", "vc", "vd")
    s1, c1, s2, c2 = hy.sin(q[1]), hy.cos(q[1]), hy.sin(q[3]), hy.cos(q[3])
    azimuth1, azimuth2 = (v[0] - v[2]) * s1, (v[0] + v[2]) * s2
    first = p["l1"] ** 2 * (v[1] ** 2.0 + azimuth1**2.0)
    second = p["l2"] ** 2 * (v[3] ** 2.0 + azimuth2**2.0)
    across = (c1 * c2 * v[1] * v[3] + azimuth1 * azimuth2) * hy.cos(2.0 * q[2]) + s1 * s2 * v[1] * v[3]
    turned = (azimuth1 * c2 * v[3] - azimuth2 * c1 * v[1]) * hy.sin(2.0 * q[2])
    kinetic = (p["m1"] + p["m2"]) * first / 2.0 + p["m2"] * (second / 2.0 + p["l1"] * p["l2"] * (across + turned))
    return hy.lagrangian(kinetic - p["g"] * ((p["m1"] + p["m2"]) * p["l1"] * c1 + p["m2"] * p["l2"] * c2), q, v)


def _whirls():
    names = [f"{axis}{j}" for axis in "xy" for j in range(4)]
    z = hy.make_vars(*names)
    x, y, strength = z[:4], z[4:], vortices.CIRCULATIONS
    others = lambda j: [k for k in range(4) if k != j]
    over = lambda j, k: strength[k] / (2 * np.pi) / ((x[j] - x[k]) ** 2.0 + (y[j] - y[k]) ** 2.0)
    right = [sum(-over(j, k) * (y[j] - y[k]) for k in others(j)) for j in range(4)]
    up = [sum(over(j, k) * (x[j] - x[k]) for k in others(j)) for j in range(4)]
    return list(zip(z, [*right, *up], strict=True))


def _top(p):
    a, b, c, x, y, z = names = hy.make_vars("a", "b", "c", "x", "y", "z")
    i, j, k = a / p["I1"], b / p["I2"], c / p["I3"]
    g = p["mgl"]
    moment = [b * k - c * j + g * y, c * i - a * k - g * x, a * j - b * i]
    return list(zip(names, [*moment, y * k - z * j, z * i - x * k, x * j - y * i], strict=True))


def start_of(system, data):
    """The vector that heyoka starts from, and how it is ordered: positions at the front."""
    first = dx.simulate(system, dx.Collocation(4), step=1e-3, steps=1, **data)
    if "x" in data:
        return np.asarray(first.x[0], float)
    if isinstance(system, dx.PhaseSpaceLagrangian):
        return np.asarray(first.q[0], float)
    q, p = np.asarray(first.q[0]), np.asarray(first.p[0])
    return np.concatenate([q, np.asarray(system.inverse_legendre(jnp.array(q), jnp.array(p), data.get("params")))])


def measured(name, system, data, equations, end, steps, stages=STAGES) -> tuple[list, list]:
    """(seconds, error at the end) of heyoka for every tolerance, and (seconds, error, stages and step) of dirax."""
    start = start_of(system, data)
    if name.startswith("outer"):  # heyoka's own order: x, y, z and their rates, body by body
        start = np.stack([start[:18].reshape(6, 3), start[18:].reshape(6, 3)], axis=1).ravel()
    place = (lambda s: s.reshape(6, 6)[:, :3].ravel()) if name.startswith("outer") else (lambda s: s[: len(start)])
    count = len(np.ravel(data.get("x", data.get("q"))))
    exact = hy.taylor_adaptive(equations, start.copy(), tol=1e-18)
    exact.propagate_until(end)
    exact = place(exact.state)[:count].copy()
    size = max(1.0, np.max(np.abs(exact)))
    taylors = [hy.taylor_adaptive(equations, start.copy(), tol=float(tolerance)) for tolerance in TOLERANCES]

    def taylor(solver):
        solver.time, solver.state[:] = 0.0, start
        begun = time.perf_counter()
        solver.propagate_until(end)
        return time.perf_counter() - begun, np.max(np.abs(place(solver.state)[:count] - exact)) / size

    field = "x" if "x" in data else "q"
    settings = [(s, h) for s in stages for h in steps]
    prepared = {}
    for s, h in settings:
        n = round(end / h)
        prepared[s, h] = dx.prepare(system, dx.Collocation(s), step=end / n, steps=n, save_every=n, **data)

    def collocation(setting):
        sol = prepared[setting]()
        good = sol.ok and np.all(np.isfinite(sol.fields[field][-1]))
        return sol.stats["run_seconds"], np.max(np.abs(sol.fields[field][-1] - exact)) / size if good else np.inf

    runs: dict[Any, list] = {}
    for _ in range(REPEATS):
        for solver in taylors:
            runs.setdefault(id(solver), []).extend(taylor(solver) for _ in range(IN_A_ROW))
        for setting in settings:
            runs.setdefault(setting, []).extend(collocation(setting) for _ in range(IN_A_ROW))
    best = lambda key: (min(t for t, _ in runs[key]), runs[key][0][1])
    return [best(id(solver)) for solver in taylors], [(*best(setting), setting) for setting in settings]


def row(name, case) -> str:
    """A row of the table."""
    theirs_all, ours_all = measured(name, *case)
    cells = []
    for wanted in ERRORS:
        theirs = min((seconds for seconds, error in theirs_all if error <= wanted), default=np.nan)
        ours = min((one for one in ours_all if one[1] <= wanted), key=lambda one: one[0], default=(np.nan, 0, None))
        setting = f", s = {ours[2][0]}, h = {ours[2][1]:.3g}" if ours[2] else ""
        cells.append(f"{ours[0] * 1e6:.0f} / {theirs * 1e6:.0f} = {ours[0] / theirs:.2f}{setting}")
    return f"| {name} | {' | '.join(cells)} |"


def main() -> None:
    """Print the table."""
    print("| µs of dirax / µs of heyoka, end error | " + " | ".join(f"{e:.0e}" for e in ERRORS) + " |")
    print("| --- | --- | --- | --- |")
    for name, case in cases().items():
        if len(sys.argv) == 1 or any(part in name for part in sys.argv[1:]):
            print(row(name, case), flush=True)


if __name__ == "__main__":
    main()
