"""[PY] reproduced: Peng, Yoshimura, Discrete Dirac structures and discrete Lagrange–Dirac dynamical systems in mechanics, §8.

The paper prints data, equations and figures, but no numbers: its numbers here are its equations with the multipliers
eliminated, iterated as they are printed, without any of dirax.
"""

import math
from typing import Any

import numpy as np

from dirax.diagnostics.verify import verify
from dirax.gallery import heisenberg, rolling_disk
from dirax.gallery.peng_yoshimura_figures import disk_figures, heisenberg_figures
from dirax.gallery.peng_yoshimura_quantities import AXIS_END, SIGN, TEXT_END, generalized_energy, path_energy
from dirax.gallery.reproduction import AGREES, DIFFERS, NEW, WRONG, Progress, Reproduction, Row, compared
from dirax.schemes.lagrange_dirac import LagrangeDAlembert, MinusLagrangeDirac, PlusLagrangeDirac
from dirax.solution.solution import Solution

TITLE = "Peng, Yoshimura: discrete Lagrange–Dirac dynamical systems, §8"
SCHEMES = {"+": PlusLagrangeDirac(), "-": MinusLagrangeDirac()}
DISK, HEISENBERG = rolling_disk.EXAMPLE, heisenberg.EXAMPLE

BY_ITS_EQUATIONS = "The paper prints no numbers: its column is its equations for (x, y, θ, φ), iterated as printed."


def reproduction(progress: Progress = lambda fraction, text: None) -> Reproduction:
    """Run §8 of the paper: table and Figures 9–20."""
    disks, lines = {}, {}
    for number, sign in enumerate(SCHEMES):
        progress(0.04 * number, f"rolling disk, {SIGN[sign]}, h = .001 to t = {AXIS_END}")
        disks[sign] = disk_run(sign, DISK.step, AXIS_END)
    for number, sign in enumerate(SCHEMES):
        progress(0.08 + 0.02 * number, f"Heisenberg system, {SIGN[sign]}, h = .01 to t = 1000")
        lines[sign] = HEISENBERG.simulate(SCHEMES[sign], **heisenberg.TWO_POINTS)
    rows: list[Row] = []
    for number, sign in enumerate(SCHEMES):
        progress(0.12 + 0.25 * number, f"rolling disk, {SIGN[sign]}: verification, h = .01 to t = 1000")
        rows += disk_rows(sign, disks[sign])
    progress(0.62, "rolling disk: continuous solution, midpoint scheme")
    rows += continuous_rows(disks)
    progress(0.75, "Heisenberg system: energy, momentum, constraint")
    rows += heisenberg_rows(lines)
    progress(0.8, "figures")
    figures = {**disk_figures("+", disks["+"]), **disk_figures("-", disks["-"]), **heisenberg_figures(lines["+"])}
    from dirax.gallery.peng_yoshimura_theorems import theorems

    progress(0.97, "theorems")
    return Reproduction("PY", TITLE, tuple(rows), figures, tuple(theorems()))


# ------------------------------------------------------------------------------------------------------ rolling disk


def disk_run(sign: str, step: float, end: float) -> Solution:
    """The disk from the printed two points (h = .001), or for another step from the same position and velocity."""
    start: dict[str, Any] = dict(rolling_disk.TWO_POINTS)
    if step != DISK.step:
        start["q1"] = start["q0"] + step * DISK.initial["v"]
    # for (+) the printed points are off the discrete constraint, which they satisfy at q0
    return DISK.simulate(SCHEMES[sign], step=step, steps=round(end / step), check_initial=False, **start)


def iterate_printed(sign: str, q0, q1, step: float, steps: int) -> np.ndarray:
    """The simplified equations of §8.1 with m = R = 1, I = .25, J = .5, μ eliminated: position (4,) after `steps` steps."""
    (x0, y0, a0, f0), (x, y, a, f) = map(float, q0), map(float, q1)
    for _ in range(steps - 1):
        f2 = 2 * f - f0
        base = f2 if sign == "+" else f
        c, s, cb, sb = math.cos(f), math.sin(f), math.cos(base), math.sin(base)
        known = 0.25 * (a - a0) + c * (x - x0) + s * (y - y0) - 10 * step**2 * math.cos(a)
        change = known / (0.25 + c * cb + s * sb)
        x0, x, y0, y, a0, a, f0, f = x, x + cb * change, y, y + sb * change, a, a + change, f, f2
    return np.array([x, y, a, f])


def disk_rows(sign: str, sol: Solution) -> list[Row]:
    """Positions at t = 50, constraint, p_φ and energy of one of the schemes."""
    name, end = SIGN[sign], round(TEXT_END / sol.step)
    printed = iterate_printed(sign, sol.q[0], sol.q[1], sol.step, end)
    rows = [
        compared(f"disk {name}: {symbol}({TEXT_END})", printed[i], float(sol.q[end, i]), 1e-6, BY_ITS_EQUATIONS, 12)
        for symbol, i in (("θ", 2), ("x", 0), ("y", 1))
    ]
    report = verify(sol, symmetries=DISK.symmetries)
    keys = (f"{name}-discrete Dirac structure", "constraint", "momentum map p_φ")
    structure, constraint, momentum = (report[key] for key in keys)
    rows.append(
        Row(
            f"disk {name}: discrete Dirac structure",
            "contains every step (Prop 5.17)",
            f"relative defect ≤ {structure.value:.1e}",
            AGREES if structure.verdict == "ok" else DIFFERS,
            numbers={"defect": structure.value, "tolerance": structure.tolerance},
        )
    )
    largest = np.max(np.abs(sol.constraint_residual()[1:]))
    point = "q_{k+1}" if sign == "+" else "q_k"
    rows.append(
        Row(
            f"disk {name}: rolling constraint",
            f"holds at {point}",
            f"residual ≤ {largest:.1e}",
            AGREES if constraint.verdict == "ok" else DIFFERS,
            "From the first computed step on; the printed points are rounded, and made for (−)." if sign == "+" else "",
            {"largest": largest, "relative": constraint.value, "tolerance": constraint.tolerance},
        )
    )
    figure = {"+": 12, "-": 16}[sign]
    p = np.asarray(sol.p)[:, 3]
    rows.append(
        Row(
            f"disk {name}: momentum p_φ",
            f"conserved (Fig. {figure})",
            f"{p[0]:.7g}, changes by ≤ {np.max(np.abs(p - p[0])):.1e}",
            AGREES if momentum.verdict == "ok" else DIFFERS,
            numbers={"p_φ": p[0], "relative change": momentum.value, "tolerance": momentum.tolerance},
        )
    )
    return [*rows, *energy_rows(sign, sol, report["energy"])]


def energy_rows(sign: str, sol: Solution, line: Any) -> list[Row]:
    """The claim that the energy behaves well: trend by `verify`, range up to t = 50, a longer run at a larger step."""
    name, figure = SIGN[sign], {"+": 10, "-": 14}[sign]
    drift = line.details
    shown = generalized_energy(sol, sign)
    change = float(np.ptp(shown))
    note = (
        f"Figs. 10 and 14 draw E_d ≈ h·E ≈ {shown[0]:.3f} on an axis from −1 to 1, where the drift moves the curve by "
        f"{change:.3f} up to t = {AXIS_END}: less than the width of the line. The logarithmic panels beside them show it."
    )
    rows = [
        Row(
            f"disk {name}: energy",
            f"“good” (Fig. {figure})",
            f"{line.verdict}: {drift.get('slope', 0.0):+.4f} ± {drift.get('standard_error', 0.0):.4f} per unit of time",
            WRONG if line.verdict == "drifts" else DIFFERS,
            note,
            {"verify": line.verdict, **drift},
        )
    ]
    change = (path_energy(sol) - path_energy(sol)[0])[: round(TEXT_END / sol.step)]
    rows.append(
        Row(
            f"disk {name}: E − E(0) for t ≤ {TEXT_END}",
            "invisible in the figure",
            f"[{change.min():.3f}, {change.max():.3f}]",
            NEW,
            "E at q_k with the velocity (q_{k+1} − q_k)/h; E(0) = 62.75.",
            {"smallest": change.min(), "largest": change.max()},
        )
    )
    long = path_energy(disk_run(sign, 0.01, 1000))
    rows.append(
        Row(
            f"disk {name}: E at t = 1000, h = .01",
            "—",
            f"{long[-1]:.4g}, from {long[0]:.4g}",
            NEW,
            "The same system and velocity, a step ten times longer, a run twenty times longer.",
            {"first": long[0], "last": long[-1], "largest": long.max(), "smallest": long.min()},
        )
    )
    return rows


def continuous_rows(disks: dict[str, Solution]) -> list[Row]:
    """The continuous solution at t = 50 by quadrature, and how far the schemes are from it."""
    exact = rolling_disk.exact([TEXT_END], **DISK.initial)[0]
    midpoint = DISK.simulate(LagrangeDAlembert("midpoint", "midpoint"), steps=TEXT_END * 1000)
    energy = np.asarray(midpoint.energy())
    change = energy - energy[0]
    solutions = {f"{SIGN[sign]} scheme": sol for sign, sol in disks.items()} | {"midpoint scheme": midpoint}
    errors = {name: np.abs(sol.q[TEXT_END * 1000] - exact)[:3].max() for name, sol in solutions.items()}
    values = ", ".join(f"{value:.8f}" for value in exact[[2, 0, 1]])
    rows = [
        Row(
            f"disk, continuous: θ, x, y at t = {TEXT_END}",
            "—",
            values,
            NEW,
            "φ̇ = 1; θ from the inverse of a Fourier series for t(θ), x and y by Gauss–Legendre quadrature.",
            {"θ": exact[2], "x": exact[0], "y": exact[1]},
        )
    ]
    rows += [Row(f"disk, {k}: error at t = {TEXT_END}", "—", f"{e:.3g}", NEW, numbers={"error": e}) for k, e in errors.items()]
    rows.append(
        Row(
            f"disk, midpoint scheme: E − E(0) for t ≤ {TEXT_END}",
            "—",
            f"[{change.min():.1e}, {change.max():.1e}]",
            NEW,
            "The same system at the same step: the drift belongs to the one-sided constraints.",
            {"smallest": change.min(), "largest": change.max()},
        )
    )
    rows.append(
        Row(
            "disk: interval of time",
            "text [0, 50], axes to 100",
            "figures to 100, numbers at 50",
            NEW,
            "The axes of Figs. 10–12, 15 and 16 are labelled 0, 20, …, 100; the text says [0, 50].",
        )
    )
    return rows


# -------------------------------------------------------------------------------------------------- Heisenberg system


def heisenberg_rows(lines: dict[str, Solution]) -> list[Row]:
    """End points, energy, momentum and constraint of the run to t = 1000, and that (+) and (−) are one scheme."""
    sol = lines["+"]
    q0, q1 = heisenberg.TWO_POINTS["q0"], heisenberg.TWO_POINTS["q1"]
    velocity = (q1 - q0) / sol.step
    note = (
        "Along the constraint force (−y, x, 1)μ the differences of the constraint give μ(1 + x² + y²) = 0: every solution of "
        "the paper's equations is the straight line q_0 + k(q_1 − q_0)."
    )
    end = q0 + (len(sol.t) - 1) * (q1 - q0)
    rows = [
        compared(f"Heisenberg: {symbol}(1000)", end[i], float(sol.q[-1, i]), 1e-6, note, 10) for i, symbol in enumerate("xyz")
    ]
    steps = np.diff(np.asarray(sol.q), axis=0)
    energy = np.linalg.norm(steps, axis=1) ** 2 / (2 * sol.step**2)
    expected = velocity @ velocity / 2
    drift = np.max(np.abs(energy / expected - 1))
    momentum = np.max(np.abs(np.asarray(sol.p)[1:] - velocity))
    apart = np.max(np.abs(np.asarray(lines["-"].q) - np.asarray(sol.q)))
    residual = np.max(np.abs(np.asarray(sol.constraint_residual())))
    roundoff = 32 * np.finfo(float).eps * 2 * np.max(np.abs(sol.q)) * np.max(np.abs(velocity))  # of its terms, y ẋ and x ẏ
    return [
        *rows,
        Row(
            "Heisenberg: energy |q_{k+1} − q_k|²/2h²",
            f"constant (Fig. 20): {expected:.4g}",
            f"{energy[0]:.10g}, relative drift {drift:.1e}",
            AGREES if drift <= 5e-11 else DIFFERS,
            "The paper prints E_d with the factor 1/h; its Figure 20 has no legible scale.",
            {"energy": energy[0], "relative drift": drift, "tolerance": 5e-11},
        ),
        Row(
            "Heisenberg: momentum",
            "well preserved (Fig. 19)",
            f"({', '.join(f'{c:.6g}' for c in np.asarray(sol.p)[-1])}), changes by ≤ {momentum:.1e}",
            AGREES if momentum <= 1e-9 * np.max(np.abs(velocity)) else DIFFERS,
            "Figure 18 is labelled up to 15000 like Figure 17, though the velocity is (5, 10, −10); it has its own scale here.",
            {"largest change": momentum},
        ),
        Row(
            "Heisenberg: constraint",
            "holds at every step",
            f"residual ≤ {residual:.1e}",
            AGREES if residual <= roundoff else DIFFERS,
            "A difference of terms as large as 10⁵.",
            {"largest": residual, "tolerance": roundoff},
        ),
        Row(
            "Heisenberg: (+) and (−)",
            "identical",
            f"differ by ≤ {apart:.1e}",
            AGREES if apart <= 1e-6 else DIFFERS,
            numbers={"largest difference": apart},
        ),
    ]
