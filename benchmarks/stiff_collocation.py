"""Collocation of stiff systems: Newton's method in the eigenbasis of A beside that of all unknowns; the table of docs/speed.md.

    python -m benchmarks.stiff_collocation      prints the table in Markdown

Times are processor times of a prepared run of one trajectory on one thread, the best of interleaved repeats; `Flat` is the same
step without the stage relation, as an engine sees it that knows nothing of collocation.
"""

import os
import time
from dataclasses import replace
from typing import Any

os.environ["DIRAX_THREADS"] = "1"
os.environ["DIRAX_CACHE"] = "off"

import jax.numpy as jnp
import numpy as np

import dirax as dx
from dirax.schemes.step import AbstractScheme, StepEquation

REPEATS, STEPS = 5, 1000
MOST = 100
"""Unknowns up to which an elimination of all of them is compiled."""


class Flat(AbstractScheme):
    """Collocation that does not say that it is made of stages."""

    stages: int

    def step_equation(self, system: Any, shape: Any) -> StepEquation:
        return replace(dx.Collocation(self.stages).step_equation(system, shape), collocation=None)


def spring_pendulum(q, v):
    """L(q, v), a scalar."""
    return v @ v / 2 - 1e4 * (jnp.sqrt(q @ q) - 1) ** 2 / 2 - 9.81 * q[1]


def springs(q, v):
    """Fermi, Pasta, Ulam: stiff springs between soft ones, in the coordinates of Hairer, Lubich, Wanner, I.5.1."""
    middle, stretch = jnp.split(q, 2)
    soft = jnp.concatenate([middle[:1] - stretch[:1], middle[1:] - stretch[1:] - middle[:-1] - stretch[:-1],
                            middle[-1:] + stretch[-1:]])  # fmt: skip
    return v @ v / 2 - 50.0**2 / 2 * (stretch @ stretch) - jnp.sum(soft**4) / 4


def bars(q, v):
    """Seven stiff bars that hang from each other."""
    points = q.reshape(7, 2)
    along = jnp.concatenate([points[:1], points[1:] - points[:-1]])
    return v @ v / 2 - 200.0**2 / 2 * jnp.sum((jnp.sqrt(jnp.sum(along**2, axis=1)) - 1) ** 2) - 9.81 * jnp.sum(points[:, 1])


def cases() -> list[tuple[str, Any, dict, float]]:
    """(name, Lagrangian, initial data, step)."""
    angles = np.linspace(1.0, 0.3, 7)
    hanging = np.cumsum(np.stack([np.sin(angles), -np.cos(angles)], axis=1), axis=0).ravel()
    wave = lambda n: {
        "q": np.concatenate([np.cos(np.arange(n / 2)), np.sin(1 + np.arange(n / 2)) / 50]),
        "v": np.cos(3.0 * np.arange(n)),
    }
    return [
        ("spring pendulum, ω = 100", spring_pendulum, {"q": [1.0, 0.0], "v": [0.0, 0.3]}, 0.1),
        ("stiff and soft springs, n = 16, ω = 50", springs, wave(16), 0.1),
        ("stiff and soft springs, n = 64, ω = 50", springs, wave(64), 0.1),
        ("seven stiff bars, n = 14, ω = 200", bars, {"q": hanging, "v": np.zeros(14)}, 0.02),
    ]


def main() -> None:
    """Print the table."""
    print("| system, h | stages | simplified Newton: sweeps, µs a step, compiled in s | all unknowns: updates, µs, s | ratio |")
    print("|---|---|---|---|---|")
    for name, lagrangian, data, h in cases():
        for stages in (2, 4):
            runs, found = {}, {}
            fits = stages * len(data["q"]) <= MOST
            for scheme in (dx.Collocation(stages), Flat(stages))[: 1 + fits]:
                begun = time.perf_counter()
                run = dx.prepare(
                    dx.LagrangeDirac(lagrangian), scheme, **data, step=h, steps=STEPS, save_every=STEPS, engine="native"
                )
                run()
                runs[scheme] = run, time.perf_counter() - begun
            for _ in range(REPEATS):
                for scheme, (run, _) in runs.items():
                    begun = time.process_time()
                    sol = run()
                    found.setdefault(scheme, []).append((time.process_time() - begun, sol))
            cells, best = [], []
            for scheme, values in found.items():
                sol = values[0][1]
                best.append(min(seconds for seconds, _ in values) / STEPS * 1e6)
                end = "" if sol.ok else " (fails)"
                cells.append(f"{sol.stats['newton_iterations'] / STEPS:.1f}, {best[-1]:.2g}, {runs[scheme][1]:.1f}{end}")
            cells += [f"{best[0] / best[1]:.2f}"] if fits else ["–", "–"]
            print(f"| {name}, {h:g} | {stages} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
