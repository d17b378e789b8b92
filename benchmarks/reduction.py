"""Time of a step of the unreduced, the reduced and the Routh equations of the double spherical pendulum of [RL], in one run.

    python benchmarks/reduction.py [--rounds 25] [--steps 10000] [--json FILE]

Every round runs each program once, in turn; the best and the median of the rounds are shown. The paper reports that its
reduced code was about 75 % faster than its unreduced one.
"""

import argparse
import json
from pathlib import Path

import numpy as np

from dirax.gallery.rodriguez_leok import FASTER, PENDULUM, REDUCED_PENDULUM, pendulum_run
from dirax.schemes.routh import DiscreteRouth


def measured(rounds: int, steps: int) -> dict[str, dict[str, float]]:
    """Microseconds a step of each program on the native engine, with its unknowns a step."""
    settings = {"steps": steps, "save_every": steps, "engine": "native"}
    programs = {
        "unreduced": lambda: pendulum_run(PENDULUM.system, **settings),
        "reduced": lambda: pendulum_run(REDUCED_PENDULUM, **settings),
        "Routh": lambda: pendulum_run(REDUCED_PENDULUM, DiscreteRouth("midpoint"), **settings),
    }
    unknowns = {name: program().stats["unknowns"] for name, program in programs.items()}
    seconds: dict[str, list[float]] = {name: [] for name in programs}
    for _ in range(rounds):
        for name, program in programs.items():
            seconds[name].append(program().stats["run_seconds"])
    per_step = {name: 1e6 * np.array(times) / steps for name, times in seconds.items()}
    return {
        name: {"unknowns": unknowns[name], "best": float(times.min()), "median": float(np.median(times))}
        for name, times in per_step.items()
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=25)
    parser.add_argument("--steps", type=int, default=10_000)
    parser.add_argument("--json")
    chosen = parser.parse_args()
    results = measured(chosen.rounds, chosen.steps)
    for name, line in results.items():
        ratio = results["unreduced"]["best"] / line["best"]
        print(f"{name:10s} {line['unknowns']} unknowns   best {line['best']:.3f} µs   median {line['median']:.3f} µs   "
              f"{ratio:.2f}× the speed of the unreduced")  # fmt: skip
    print(f"paper      reduced about {FASTER:.0%} faster than unreduced")
    if chosen.json:
        Path(chosen.json).write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
