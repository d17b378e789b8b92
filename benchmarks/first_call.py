"""What the first run of an equation costs: tracing and compiling, in processor seconds, and the second run in a new place."""

import json
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

import dirax as dx
from benchmarks.double_pendulum import SCHEME, START, SYSTEM
from benchmarks.harness import in_new_process, store, table

DISK = dx.LagrangeDirac(
    lambda q, v: (v[0] ** 2 + v[1] ** 2) / 2 + v[2] ** 2 / 8 + v[3] ** 2 / 4 - 10 * jnp.sin(q[2]),
    lambda q: jnp.array([[1.0, 0.0, -jnp.cos(q[3]), 0.0], [0.0, 1.0, -jnp.sin(q[3]), 0.0]]),
)
CHAIN = dx.LagrangeDirac(lambda q, v: v @ v / 2 - jnp.sum(1 - jnp.cos(jnp.diff(q))) - q @ q / 2)
RUNS = {
    "double pendulum, 2 unknowns": (SYSTEM, SCHEME, {"q": START[0], "v": START[1]}),
    "rolling disk, 6 unknowns": (DISK, dx.PlusLagrangeDirac(), {"q": [0, 0, 0, np.pi / 3], "v": [5.0, 75**0.5, 10.0, 1.0]}),
    "chain of 30 pendulums": (CHAIN, SCHEME, {"q": np.sin(np.arange(30.0)), "v": np.zeros(30)}),
}


def measure(name: str, engine: str) -> dict:
    """Processor seconds of a first and a second run of 100 steps, of the energy, and of a gradient; µs a step after that."""
    jax.config.update("jax_enable_compilation_cache", False)
    system, scheme, data = RUNS[name]
    run = lambda steps=100, **change: dx.simulate(system, scheme, **(data | change), step=1e-3, steps=steps, engine=engine)
    found = {}

    def timed(label, function):
        tick = time.process_time()
        value = function()
        found[label] = time.process_time() - tick
        return value

    sol = timed("first", run)
    timed("second", lambda: run(v=np.asarray(data["v"]) * 1.01))
    timed("energy", sol.energy)
    timed("energy_again", run(v=np.asarray(data["v"]) * 1.02).energy)
    steps = 5000
    found["microseconds_per_step"] = 1e6 * min(run(steps).stats["run_seconds"] for _ in range(7)) / steps
    saving = {"step": 1e-3, "steps": 1000, "save_every": 1000, "engine": engine}
    end = lambda v: dx.simulate(system, scheme, **(data | {"v": v} | saving)).q[-1, 0]
    gradient, v = jax.jit(jax.grad(end)), jnp.asarray(data["v"], float)
    timed("gradient", lambda: gradient(v).block_until_ready())
    timed("gradient_again", lambda: gradient(v).block_until_ready())
    return found


def main(short: bool = False) -> None:
    results, rows = {}, []
    for name in list(RUNS)[: 2 if short else None]:
        for label, engine, fast in (("xla", "xla", False), ("xla, fast_loops", "xla", True), ("native", "native", False)):
            found = in_new_process("benchmarks.first_call", {"name": name, "engine": engine}, fast)
            results[f"{name}: {label}"] = found
            columns = ("first", "second", "energy", "energy_again", "gradient", "gradient_again", "microseconds_per_step")
            rows.append((name, label, *(f"{found[c]:.3f}" if c in found else "" for c in columns)))
    header = ("system", "engine", "first run", "second", "energy", "energy again", "gradient", "again", "µs/step")
    print(table(header, rows, "processor seconds of a run of 100 steps, nothing cached"))
    store("first_call", results)


if __name__ == "__main__":
    if len(sys.argv) > 1 and sys.argv[1].startswith("{"):
        print(json.dumps(measure(**json.loads(sys.argv[1]))))
    else:
        main("--short" in sys.argv)
