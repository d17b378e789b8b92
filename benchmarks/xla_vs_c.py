"""Time of a step of one trajectory: the engines against a loop written in C and compiled in the same run."""

import json
import sys

import numpy as np

import dirax as dx
from benchmarks.double_pendulum import SCHEME, START, STEP, SYSTEM, compiled
from benchmarks.harness import in_new_process, interleaved, store, summary, table

ALLOWED = 4.0
"""Microseconds a step that the xla engine may take."""


def measure(steps: int, repeats: int) -> dict:
    """µs a step of every program, and how far each ends from the C program."""
    last = {}

    def engine(name):
        def run():
            sol = dx.simulate(SYSTEM, SCHEME, q=START[0], v=START[1], step=STEP, steps=steps, engine=name)
            last[f"dirax {name}"] = (np.concatenate([sol.q[-1], sol.p[-1]]), sol.stats["newton_iterations"])
            return sol.stats["run_seconds"]

        return run

    def by_hand(name, program):
        def run():
            seconds, rows, updates = program(steps)
            last[name] = (rows[-1], updates)
            return seconds

        return run

    programs = {"dirax xla": engine("xla"), "dirax native": engine("native")}
    for flags in ("-O2", "-O3 -march=native"):
        program = compiled(flags)
        if program is not None:
            programs[f"C {flags}"] = by_hand(f"C {flags}", program)
    seconds = interleaved(programs, repeats)
    reference = last.get("C -O2", last["dirax native"])[0]
    return {
        name: {
            "microseconds_per_step": summary([1e6 * s / steps for s in values]),
            "newton_updates_per_step": float(last[name][1]) / steps,
            "distance_at_end": float(np.max(np.abs(last[name][0] - reference))),
        }
        for name, values in seconds.items()
    }


def main(short: bool = False) -> None:
    steps, repeats = (20_000, 7) if short else (100_000, 21)
    results = {"system": "planar double pendulum, midpoint L_d, h = 0.001, every row saved", "steps": steps}
    for label, fast in (("as JAX comes", False), ("fast_loops", True)):
        results[label] = in_new_process("benchmarks.xla_vs_c", {"steps": steps, "repeats": repeats}, fast)
    rows = []
    for label in ("as JAX comes", "fast_loops"):
        found = results[label]
        c = found["C -O2"]["microseconds_per_step"]["median"] if "C -O2" in found else None
        for name, entry in found.items():
            cost = entry["microseconds_per_step"]["median"]
            entry["ratio_to_C"] = cost / c if c else None
            ratio = f"{cost / c:.2f}" if c else "no compiler"
            updates, distance = f"{entry['newton_updates_per_step']:.2f}", f"{entry['distance_at_end']:.1e}"
            rows.append((label, name, f"{cost:.3f}", ratio, updates, distance))
    header = ("JAX", "program", "µs/step", "ratio to C -O2", "updates/step", "distance from C")
    print(table(header, rows, results["system"]))
    cost = results["as JAX comes"]["dirax xla"]["microseconds_per_step"]["median"]
    results["within_allowed"] = cost <= ALLOWED
    store("xla_vs_c", results)


if __name__ == "__main__":
    if len(sys.argv) > 1 and sys.argv[1].startswith("{"):
        print(json.dumps(measure(**json.loads(sys.argv[1]))))
    else:
        main("--short" in sys.argv)
