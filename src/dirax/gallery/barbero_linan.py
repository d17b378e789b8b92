"""[BLM] reproduced: Barbero Liñán, López Medel, Martín de Diego, Discretization of Dirac systems, §6.3 and §8.

The paper prints three figures and no numbers: its column here is its equations (13), (15) and RK2 in complex form, iterated
as printed, without any of dirax. Of §8 it shows no run; the rolling disk stands for it, against its continuous solution.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.gallery import rolling_disk, vortices
from dirax.gallery.reproduction import AGREES, DIFFERS, NEW, WRONG, Progress, Reproduction, Row, compared
from dirax.schemes.composition import Composition
from dirax.schemes.discrete_dirac import DiscreteDirac
from dirax.solution.solution import Solution
from dirax.systems.nonholonomic import NonholonomicMechanics

TITLE = "Barbero Liñán, López Medel, Martín de Diego: Dirac systems and the constraint algorithm, §6 and §8"
VORTICES = vortices.EXAMPLE
SYSTEM = vortices.point_vortices(vortices.CIRCULATIONS)
GAMMA = np.array(vortices.CIRCULATIONS)
METHODS = {1: DiscreteDirac(), 2: DiscreteDirac(constraints="resolve")}
SHORT, ZOOM, LONG = 300, 500, 1_000_000
"""Steps of Figures 1, 3 and 2, at h = 1."""
EVERY = 100
DISK_START: dict[str, Any] = {
    "q": np.array([0.0, 0.0, 0.0, np.pi / 3]),
    "v": np.array([5.0, 10 * np.sin(np.pi / 3), 10.0, 1.00005]),
    "project": True,
}
BY_ITS_EQUATIONS = "The paper prints no numbers: its column is its complex equations, iterated as printed."


def reproduction(progress: Progress = lambda fraction, text: None) -> Reproduction:
    """Run §6.3 and §8 of the paper: Figures 1–3 and a table."""
    from dirax.gallery.barbero_linan_figures import energy_figure, path_figure, zoom_figure
    from dirax.gallery.barbero_linan_theorems import theorems

    progress(0.0, "four vortices, 500 steps")
    short = {number: vortex_run(number, ZOOM) for number in METHODS}
    rows = position_rows(short) + energy_rows(short)
    long = {}
    for number in METHODS:
        progress(0.15 + 0.3 * (number - 1), f"four vortices, Method {number}, to t = 10⁶")
        long[number] = vortex_run(number, LONG, EVERY)
    progress(0.7, "four vortices, RK2, to t = 10⁶")
    drifting = runge_kutta(LONG // EVERY, EVERY)
    rows += long_rows(long, drifting)
    progress(0.8, "rolling disk, Methods 1 and 2")
    rows += disk_rows()
    progress(0.95, "figures")
    figures = {
        "figure_01": path_figure({number: sol.q[: SHORT + 1] for number, sol in short.items()}, runge_kutta(SHORT, 1)),
        "figure_02": energy_figure(long, energies(drifting), EVERY),
        "figure_03": zoom_figure(short),
    }
    progress(0.97, "theorems")
    return Reproduction("BLM", TITLE, tuple(rows), figures, tuple(theorems()))


# ------------------------------------------------------------------------------------------------------- point vortices


def vortex_run(method: int, steps: int, save_every: int = 1) -> Solution:
    """The four vortices at h = 1; Method 1, which is two-step in q, takes its first step by RK2 as the paper does."""
    if method == 2:
        return VORTICES.simulate(METHODS[2], steps=steps, save_every=save_every)
    second = np.asarray(vortices.runge_kutta_step(jnp.asarray(vortices.FOUR), 1.0))
    return VORTICES.simulate(METHODS[1], steps=steps, save_every=save_every, q0=vortices.FOUR, q1=second)


def runge_kutta(rows: int, every: int) -> np.ndarray:
    """(rows + 1, 8): RK2 at h = 1, a row every `every` steps."""

    @jax.jit
    def run(q):
        more = lambda q, _: (jax.lax.fori_loop(0, every, lambda _, q: vortices.runge_kutta_step(q, 1.0), q), q)
        last, saved = jax.lax.scan(more, q, length=rows)
        return jnp.concatenate([saved, last[None]])

    return np.asarray(run(jnp.asarray(vortices.FOUR)))


def energies(q: np.ndarray) -> np.ndarray:
    """H of rows of q."""
    return np.asarray(jax.jit(jax.vmap(lambda q: SYSTEM.hamiltonian(q, None)))(jnp.asarray(q)))


def f(z: np.ndarray) -> np.ndarray:
    """conj(ż_l) = (1/2πi) Σ_{j≠l} Γ_j/(z_l − z_j), the paper's f."""
    apart = z[:, None] - z[None, :]
    np.fill_diagonal(apart, np.inf)
    return (GAMMA / apart).sum(1) / (2j * np.pi)


@functools.cache
def iterate_printed(method: int, steps: int) -> np.ndarray:
    """z (steps + 1, 4) by (13), (15) or, for method 0, RK2, h = 1; the implicit ones by fixed-point iteration to roundoff."""
    z = [vortices.FOUR[:4] + 1j * vortices.FOUR[4:]]
    middle_step = lambda z: z + np.conj(f(z + np.conj(f(z)) / 2))
    if method == 1:
        z.append(middle_step(z[0]))
    while len(z) <= steps:
        if method == 0:
            z.append(middle_step(z[-1]))
            continue
        base = z[-1] if method == 2 else z[-2] + np.conj(f((z[-2] + z[-1]) / 2))
        new = z[-1] + np.conj(f(z[-1]))
        for _ in range(60):
            new = base + np.conj(f((z[-1] + new) / 2))
        z.append(new)
    return np.array(z)


def position_rows(runs: dict[int, Solution]) -> list[Row]:
    """The first vortex after 300 steps."""
    rows = []
    for number, sol in runs.items():
        printed = iterate_printed(number, SHORT)[-1, 0]
        for symbol, expected, value in (("x", printed.real, sol.q[SHORT, 0]), ("y", printed.imag, sol.q[SHORT, 4])):
            name = f"Method {number}: {symbol}_1 after {SHORT} steps"
            rows.append(compared(name, expected, float(value), 1e-9, BY_ITS_EQUATIONS, 13))
    printed, own = iterate_printed(0, SHORT)[-1, 0], runge_kutta(SHORT, 1)[-1]
    rows.append(compared(f"RK2: x_1 after {SHORT} steps", printed.real, float(own[0]), 1e-9, BY_ITS_EQUATIONS, 13))
    return rows


def energy_rows(runs: dict[int, Solution]) -> list[Row]:
    """H at the start, and the bands of Figure 3."""
    z = vortices.FOUR[:4] + 1j * vortices.FOUR[4:]
    ordered = sum(GAMMA[j] * GAMMA[k] * np.log(abs(z[j] - z[k]) ** 2) for j in range(4) for k in range(4) if j != k) / (4 * np.pi)
    start = float(runs[2].energy()[0])
    rows = [
        Row(
            "H at the start",
            f"{ordered:.10g} by (9)",
            f"{start:.12g}",
            WRONG if abs(ordered - 2 * start) < 1e-13 else DIFFERS,
            "(9) sums over ordered pairs, twice the Hamiltonian of its own equations (10).",
            {"by (9)": ordered, "computed": start},
        )
    ]
    bands = {}
    for number, sol in runs.items():
        error = np.asarray(sol.energy()) - start
        bands[number] = error
        rows.append(
            Row(
                f"Method {number}: H − H(0) over {ZOOM} steps",
                "a band (Fig. 3)",
                f"[{error.min():.3g}, {error.max():.4g}]",
                AGREES if error.max() < 3e-4 and error[ZOOM // 2 :].max() < 1.01 * error.max() else DIFFERS,
                numbers={"smallest": error.min(), "largest": error.max()},
            )
        )
    smaller = np.ptp(bands[2]) < np.ptp(bands[1])
    rows.append(
        Row(
            "Method 2 against Method 1, energy",
            "“slightly better” (Fig. 3)",
            f"band {np.ptp(bands[2]):.3g} against {np.ptp(bands[1]):.3g}",
            AGREES if smaller else DIFFERS,
            numbers={"Method 1": np.ptp(bands[1]), "Method 2": np.ptp(bands[2])},
        )
    )
    return rows


def long_rows(runs: dict[int, Solution], drifting: np.ndarray) -> list[Row]:
    """Figure 2: H − H(0) up to t = 10⁶."""
    rows = []
    for name, energy in [(f"Method {n}", np.asarray(sol.energy())) for n, sol in runs.items()] + [("RK2", energies(drifting))]:
        error = energy - energy[0]
        tenth = len(error) // 10
        early, late = np.abs(error[:tenth]).max(), np.abs(error[-tenth:]).max()
        bounded = late < 1.5 * early
        rows.append(
            Row(
                f"{name}: H − H(0) to t = 10⁶",
                "gradual drift (Fig. 2)" if name == "RK2" else "close at all times (Fig. 2)",
                f"{'bounded' if bounded else 'drifts'}: {early:.3g} in the first tenth, {late:.3g} in the last",
                AGREES if bounded != (name == "RK2") else DIFFERS,
                f"h = 1, every {EVERY}th step saved.",
                {"first tenth": early, "last tenth": late, "smallest": error.min(), "largest": error.max()},
            )
        )
    return rows


# --------------------------------------------------------------------------------------------------------- rolling disk


def disk() -> NonholonomicMechanics:
    """The rolling disk of [PY] as nonholonomic mechanics of §8: m = R = 1, I = .25, J = .5, V = 10 sin θ."""
    return NonholonomicMechanics(
        lambda q: jnp.diag(jnp.array([1.0, 1.0, 0.25, 0.5])),
        lambda q: 10.0 * jnp.sin(q[2]),
        lambda q: rolling_disk.one_forms(q, rolling_disk.PARAMS),
    )


def disk_rows(end: float = 10.0) -> list[Row]:
    """Orders, errors and constraint of Methods 1 and 2 and of Method 2 composed, on the rolling disk."""
    from dirax.run.simulate import simulate

    system = disk()
    schemes = {
        "Method 1 (36)–(38)": (METHODS[1], (0.02, 0.01, 0.005)),
        "Method 2 (39)–(43)": (METHODS[2], (0.02, 0.01, 0.005)),
        "Method 2, composed (Suzuki)": (Composition(METHODS[2], "suzuki4"), (0.04, 0.02, 0.01)),
    }
    rows = []
    for name, (scheme, sizes) in schemes.items():
        errors, largest = [], 0.0
        for h in sizes:
            sol = simulate(system, scheme, **DISK_START, step=h, steps=round(end / h))
            exact = rolling_disk.exact(sol.t, DISK_START["q"], DISK_START["v"])
            errors.append(np.abs(np.asarray(sol.q) - exact)[:, :3].max())
            largest = np.abs(sol.constraint_residual()).max()
        order = np.log2(errors[-2] / errors[-1])
        expected = 4 if isinstance(scheme, Composition) else 2
        exactly = scheme is not METHODS[1]
        rows.append(
            Row(
                f"disk, {name}: order",
                "future work (§9)" if expected == 4 else "2 (a midpoint rule)",
                f"{order:.2f}: " + ", ".join(f"{e:.3e}" for e in errors),
                (NEW if expected == 4 else AGREES) if abs(order - expected) < 0.1 else DIFFERS,
                f"Largest error in (x, y, θ) for t ≤ {end:g}, h as in " + ", ".join(f"{h:g}" for h in sizes) + ".",
                {"errors": errors, "steps": sizes, "order": order},
            )
        )
        rows.append(
            Row(
                f"disk, {name}: constraint at the nodes",
                "exact" if exactly else "not imposed",
                f"{largest:.1e}",
                AGREES if (largest <= 5e-15) == exactly else DIFFERS,
                numbers={"largest": largest},
            )
        )
    return rows
