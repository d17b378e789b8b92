"""Time of a step and trajectory in batches, and of the gradient of a trajectory, on each engine."""

import json
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

import dirax as dx
from benchmarks.double_pendulum import SCHEME, START, STEP, SYSTEM
from benchmarks.harness import in_new_process, interleaved, store, summary, table

SIZES = (16, 128, 1024, 8192)
GRADIENT_STEPS = 2000


def measure(sizes: list[int], work: int, repeats: int) -> dict:
    """µs a step and trajectory by batch size and engine, every tenth row saved; µs a step of a gradient in reverse mode."""
    results = {}
    for size in sizes:
        steps = max(50, work // size)
        spread = 0.1 * np.random.default_rng(0).normal(size=(size, 2))
        run = {"q": START[0] + spread, "v": START[1], "step": STEP, "steps": steps, "save_every": 10}

        def program(engine, run=run):
            return lambda: dx.simulate(SYSTEM, SCHEME, engine=engine, **run).stats["run_seconds"]

        seconds = interleaved({"xla": program("xla"), "native": program("native")}, repeats)
        results[str(size)] = {name: summary([1e6 * s / (steps * size) for s in values]) for name, values in seconds.items()}
    results["gradient"] = summary([1e6 * s / GRADIENT_STEPS for s in interleaved({"gradient": gradient()}, repeats)["gradient"]])
    return results


def gradient():
    """Seconds of the gradient of the end point's first angle with respect to the initial velocity."""

    def end(v):
        return dx.simulate(SYSTEM, SCHEME, q=START[0], v=v, step=STEP, steps=GRADIENT_STEPS).q[-1, 0]

    compiled = jax.jit(jax.grad(end))

    def run():
        tick = time.perf_counter()
        compiled(jnp.array(START[1])).block_until_ready()
        return time.perf_counter() - tick

    return run


def main(short: bool = False) -> None:
    sizes, work, repeats = ([16, 1024], 20_000, 3) if short else (list(SIZES), 200_000, 9)
    settings = {"sizes": sizes, "work": work, "repeats": repeats}
    results = {"system": "planar double pendulum, midpoint L_d, h = 0.001", **settings}
    rows = []
    for label, fast in (("as JAX comes", False), ("fast_loops", True)):
        found = results[label] = in_new_process("benchmarks.batches", settings, fast)
        gradient = found["gradient"]["median"]
        for size in map(str, sizes):
            rows.append((label, size, *(f"{found[size][engine]['median']:.4f}" for engine in ("xla", "native"))))
        rows.append((label, "gradient of one", f"{gradient:.2f}", ""))
    print(table(("JAX", "batch", "xla", "native"), rows, f"µs a step and trajectory; {results['system']}"))
    store("batches", results)


if __name__ == "__main__":
    if len(sys.argv) > 1 and sys.argv[1].startswith("{"):
        print(json.dumps(measure(**json.loads(sys.argv[1]))))
    else:
        main("--short" in sys.argv)
