"""What it costs to save every step: time a step and memory against the number of steps."""

import json
import resource
import sys

import dirax as dx
from benchmarks.double_pendulum import SCHEME, START, STEP, SYSTEM
from benchmarks.harness import in_new_process, interleaved, store, summary, table

ALLOWED = 0.2
"""How much more than proportional a long run may cost, in time and in memory."""


def run(steps: int, engine: str, save_every: int = 1) -> dx.Solution:
    return dx.simulate(SYSTEM, SCHEME, q=START[0], v=START[1], step=STEP, steps=steps, save_every=save_every, engine=engine)


def peak() -> int:
    """Largest resident size of the process so far, in bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def memory(steps: int, save_every: int, engine: str) -> dict:
    """Growth of the peak by one run, after a short one that compiles, and the size of what it saved."""
    run(10_000, engine, save_every)
    before = peak()
    saved = run(steps, engine, save_every)
    return {"growth": peak() - before, "saved": saved.nbytes}


def times(short: int, long: int, engine: str, repeats: int) -> dict:
    """µs a step of many short runs and of a long one, in turn."""

    def program(steps):
        runs = max(1, long // steps // 4)
        return lambda: 1e6 * sum(run(steps, engine).stats["run_seconds"] for _ in range(runs)) / (runs * steps)

    found = interleaved({str(short): program(short), str(long): program(long)}, repeats)
    return {name: summary(values) for name, values in found.items()}


def main(short: bool = False) -> None:
    steps, repeats = (200_000, 3) if short else (1_000_000, 9)
    results = {"system": "planar double pendulum, midpoint L_d", "allowed": ALLOWED}
    rows = []
    for engine in ("xla", "native"):
        ask = lambda what, engine=engine, **more: in_new_process("benchmarks.saving", {"what": what, "engine": engine, **more})
        cost = ask("times", short=10_000, long=steps, repeats=repeats)
        found = {
            "microseconds_per_step": cost,
            "long_to_short": cost[str(steps)]["median"] / cost["10000"]["median"],
            "memory": {str(every): ask("memory", steps=steps, save_every=every) for every in (1, 100)},
        }
        growth = found["memory"]["1"]["growth"] / found["memory"]["1"]["saved"]
        found["within_allowed"] = found["long_to_short"] <= 1 + ALLOWED and growth <= 1 + ALLOWED
        results[engine] = found
        for every, used in found["memory"].items():
            ratio = f"{found['long_to_short']:.2f}" if every == "1" else ""
            rows.append((engine, every, ratio, f"{used['saved'] / 2**20:.1f}", f"{used['growth'] / 2**20:.1f}"))
    header = ("engine", "save_every", f"time a step, {steps:g} to 10000 steps", "saved MiB", "peak growth MiB")
    print(table(header, rows, f"saving {steps:g} steps"))
    store("saving", results)


if __name__ == "__main__":
    if len(sys.argv) > 1 and sys.argv[1].startswith("{"):
        arguments = json.loads(sys.argv[1])
        print(json.dumps({"times": times, "memory": memory}[arguments.pop("what")](**arguments)))
    else:
        main("--short" in sys.argv)
