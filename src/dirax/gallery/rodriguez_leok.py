"""[RL] reproduced: Rodríguez Abella, Leok, Discrete Dirac reduction of implicit Lagrangian systems, §7."""

import time
from typing import Any

import jax
import numpy as np

from dirax.diagnostics.verify import verify
from dirax.gallery import charged_particle, double_spherical_pendulum
from dirax.gallery.reproduction import AGREES, DIFFERS, NEW, NOT_OURS, WRONG, Progress, Reproduction, Row, compared
from dirax.reduction.connection import LinearConnection
from dirax.reduction.reduce import reduce
from dirax.schemes.discrete_lagrangian import RULES, discrete_lagrangian
from dirax.schemes.lagrange_dirac import PlusLagrangeDirac
from dirax.schemes.routh import DiscreteRouth
from dirax.solution.reconstruction import reconstruct
from dirax.solution.solution import Solution

TITLE = "Rodríguez Abella, Leok: discrete Dirac reduction, §7"
PARTICLE: Any = charged_particle.EXAMPLE
PENDULUM: Any = double_spherical_pendulum.EXAMPLE
REDUCED_PARTICLE = reduce(PARTICLE.system, LinearConnection(fibre=[3]))
REDUCED_PENDULUM = reduce(PENDULUM.system, LinearConnection(fibre=[0]))
TABLE_1 = {10: 1.6781, 50: 0.25971, 100: 0.06626, 200: 0.01664}
"""Number of steps → error at the last step, as printed."""

PRINTED_DIGITS = {10: 4, 50: 5, 100: 5, 200: 5}
FASTER = 0.75
"""How much faster the paper's reduced code was than its unreduced one."""


def reproduction(progress: Progress = lambda fraction, text: None) -> Reproduction:
    """Run §7 of the paper: Table 1 and Figures 1, 3 and 4."""
    from dirax.gallery.rodriguez_leok_figures import energy_figure, helix_figure, pendulum_figure
    from dirax.gallery.rodriguez_leok_theorems import theorems

    progress(0.0, "charged particle: Table 1")
    rows = table_rows()
    progress(0.3, "double spherical pendulum, reduced and unreduced, h = .01 to t = 100")
    unreduced = PENDULUM.simulate()
    quotient = pendulum_run(REDUCED_PENDULUM)
    reduced = reconstruct(quotient)
    rows += pendulum_rows(unreduced, quotient, reduced)
    progress(0.7, "double spherical pendulum: time of a step")
    rows += [speed_row()]
    progress(0.9, "figures")
    figures = {
        "figure_01": helix_figure(particle_run(100)),
        "figure_03": pendulum_figure(reduced),
        "figure_04": energy_figure(reduced, discrete_energy(reduced), discrete_energy(unreduced)),
    }
    progress(0.97, "theorems")
    return Reproduction("RL", TITLE, tuple(rows), figures, tuple(theorems()))


# --------------------------------------------------------------------------------------------------- charged particle


def particle_run(steps: int, rule: str = "left", unreduced: bool = False) -> Solution:
    """The particle to T = 20 by the (+) equations, reduced and lifted back unless `unreduced`."""
    sol = _simulate(
        PARTICLE, None if unreduced else REDUCED_PARTICLE, PlusLagrangeDirac(rule), charged_particle.END / steps, steps
    )
    return sol if unreduced else reconstruct(sol)


def particle_error(sol: Solution) -> float:
    """‖q(T) − q_N‖ in R³."""
    end = PARTICLE.exact([charged_particle.END], **PARTICLE.initial)[0]
    return float(np.linalg.norm(end[:3] - np.asarray(sol.q)[-1, :3]))


def table_rows() -> list[Row]:
    """Table 1, its order, and that neither the reduction nor the discrete Lagrangian changes it."""
    errors = {steps: particle_error(particle_run(steps)) for steps in TABLE_1}
    rows = [
        compared(f"particle: error, N = {n}", TABLE_1[n], e, 0.5000001 * 10.0 ** -PRINTED_DIGITS[n], digits=6)
        for n, e in errors.items()
    ]
    order = float(np.log2(errors[100] / errors[200]))
    rows.append(
        Row(
            "particle: order of convergence",
            "second",
            f"{order:.3f} from N = 100 to 200",
            AGREES if abs(order - 2) < 0.05 else DIFFERS,
            "With the left discrete Lagrangian, which is of first order in general.",
            {"order": order},
        )
    )
    others = [particle_run(100, rule, unreduced=True) for rule in RULES]
    apart = max(abs(particle_error(sol) - errors[100]) for sol in others)
    rows.append(
        Row(
            "particle: error by other L_d, unreduced",
            "—",
            f"the same, to {apart:.1e}",
            NEW,
            "Left, right, midpoint and trapezoidal L_d, N = 100.",
            {"largest difference": apart},
        )
    )
    return rows


# ------------------------------------------------------------------------------------------ double spherical pendulum


def pendulum_run(system: Any, scheme: Any = None, **changes: Any) -> Solution:
    """The paper's run of the pendulum as the system that is given."""
    return _simulate(PENDULUM, system, scheme or PENDULUM.scheme, **{"step": PENDULUM.step, "steps": PENDULUM.steps, **changes})


def discrete_energy(sol: Solution) -> np.ndarray:
    """(E_d)_k = L_d(q_k, q_{k+1}) of [RL] (5.7) at each step, (rows − 1,)."""
    ld, h = discrete_lagrangian(sol.system.lagrangian, "midpoint"), sol.step
    q = np.asarray(sol.q)
    along = jax.jit(jax.vmap(lambda q, v: ld(0.0, q, v, h, sol.params)))
    return np.asarray(along(q[:-1], np.diff(q, axis=0) / h))


def pendulum_rows(unreduced: Solution, quotient: Solution, reduced: Solution) -> list[Row]:
    """End state, momentum and energies of the paper's run."""
    p = np.asarray(unreduced.p)
    start = np.array([p[0, 0] / 2 - p[0, 2] / 2, p[0, 1], p[0, 0] / 2 + p[0, 2] / 2, p[0, 3]])
    a, f1, b, f2 = np.asarray(reduced.q)[-1]
    apart = np.abs(np.asarray(reduced.q) - np.asarray(unreduced.q))
    energies = discrete_energy(reduced), discrete_energy(unreduced)
    difference = float(np.max(np.abs(energies[0] - energies[1])))
    size = float(np.max(np.abs(energies[0])))
    mu = np.asarray(quotient.fields["mu"])
    moved = float(np.max(np.abs(mu - mu[0])))
    energy = np.asarray(unreduced.energy())
    line = verify(unreduced)["energy"]
    ranges = f"L_d runs over [{energies[0].min():.6g}, {energies[0].max():.6g}]"
    return [
        Row("pendulum: momenta (θ1, φ1, θ2, φ2) at t = 0", "—", ", ".join(f"{x:g}" for x in start), NEW, numbers={"p": start}),
        Row(
            "pendulum: (θ1, φ1, θ2, φ2) at t = 100",
            "—",
            f"{a - b:.7f}, {f1:.8f}, {a + b:.8f}, {f2:.8f}",
            NEW,
            numbers={"q": np.array([a - b, f1, a + b, f2])},
        ),
        Row(
            "pendulum: momentum map μ",
            "conserved",
            f"changes by ≤ {moved:.1e}",
            AGREES if moved == 0 else DIFFERS,
            "μ is a state of the reduced equations, handed from step to step.",
            {"largest change": moved},
        ),
        Row(
            "pendulum: discrete energies, reduced − unreduced",
            "almost the same (Fig. 4)",
            f"differ by ≤ {difference:.1e} of {size:.3g}",
            AGREES if difference <= 1e-9 * size else DIFFERS,
            numbers={"largest difference": difference, "relative": difference / size, "positions differ by": apart.max(axis=0)},
        ),
        Row(
            "pendulum: Figure 4, top",
            "the discrete energy",
            ranges,
            WRONG,
            "(5.7) with q_{k+1} = q_k⁺ leaves E_d = L_d, the discrete Lagrangian h L, as the paper says itself: it shows no "
            "energy, and its oscillation is that of the motion. The energy ⟨p, v⟩ − L is in the next row and beside Figure 4.",
            {"smallest": energies[0].min(), "largest": energies[0].max()},
        ),
        Row(
            "pendulum: energy E",
            "near conservation",
            f"{line.verdict}: {energy[0]:.8g}, band {np.ptp(energy):.3g}",
            AGREES if line.verdict in ("ok", "bounded") else DIFFERS,
            "The band is the passage of the second link by the pole φ2 = π of the angles, where the step is coarse.",
            {"verify": line.verdict, **line.details, "band": np.ptp(energy)},
        ),
    ]


def speed_row(repeats: int = 3) -> Row:
    """Time of a step of the unreduced, the reduced and the Routh equations, run in turn; medians."""
    programs = {
        "unreduced": lambda: PENDULUM.simulate(save_every=1000),
        "reduced": lambda: pendulum_run(REDUCED_PENDULUM, save_every=1000),
        "Routh": lambda: pendulum_run(REDUCED_PENDULUM, DiscreteRouth("midpoint"), save_every=1000),
    }
    seconds: dict[str, list[float]] = {name: [] for name in programs}
    for _ in range(repeats):
        for name, program in programs.items():
            seconds[name].append(program().stats["run_seconds"])
    median = {name: 1e6 * float(np.median(times)) / PENDULUM.steps for name, times in seconds.items()}
    ratio = {name: median["unreduced"] / value for name, value in median.items()}
    return Row(
        "pendulum: speed, reduced",
        f"about {FASTER:.0%} faster",
        f"{ratio['reduced']:.2f}× the unreduced; Routh {ratio['Routh']:.2f}×",
        NOT_OURS,
        "The ratio belongs to the paper's code: the reduced equations are the unreduced ones in other variables, with the same "
        "four unknowns and Newton steps. Routh has three, and a division more in every evaluation.",
        {"microseconds a step": median, "speed over unreduced": ratio, "measured at": time.strftime("%Y-%m-%d")},
    )


def _simulate(example: Any, system: Any, scheme: Any, step: float, steps: int, **settings: Any) -> Solution:
    from dirax.run.simulate import simulate

    return simulate(
        example.system if system is None else system,
        scheme,
        **example.initial,
        params=dict(example.params),
        step=step,
        steps=steps,
        **settings,
    )
