"""What the first run of an equation costs: tracing and compiling, and the second run in a new place.

`python -m benchmarks.first_call` compares the engines on three systems; with `--gallery` it measures the first call of every
system of the gallery in new processes, with no kernel on the disk and with one, and the first `verify`.
"""

import json
import os
import statistics
import sys
import tempfile
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


def first_call(name: str) -> dict:
    """Seconds of the first call of a system of the gallery in this process, after the imports, and of `verify` of that run."""
    import dirax.engines.native  # noqa: F401  (it is imported when it is used; so that the call is measured alone)
    from dirax import gallery

    jax.config.update("jax_enable_compilation_cache", False)
    example = gallery.get(name)
    clocks = lambda: np.array([time.perf_counter(), time.process_time()])
    started = clocks()
    sol = example.simulate(steps=10, save_every=10)
    ran = clocks()
    dx.verify(sol)
    verified = clocks()
    (wall, processor), (_, verify) = (ran - started).tolist(), (verified - ran).tolist()
    stats = {"engine": sol.stats["engine"], "cached": sol.stats.get("kernel_cached", False)}
    return {"wall": wall, "processor": processor, "verify": verify, **stats}


def over_gallery(repeats: int = 5) -> None:
    """The table of first calls, each the median of `repeats` pairs of new processes: nothing on the disk, then the kernel."""
    from dirax import gallery

    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # Python's byte code is in place, as it is on a user's machine
    results: dict = {}
    for repeat in range(repeats + 1):
        for name in gallery.names():
            with tempfile.TemporaryDirectory() as folder:
                os.environ["DIRAX_CACHE"] = folder
                pair = [in_new_process("benchmarks.first_call", {"gallery": name}) for _ in range(2)]
            if repeat:  # the first round writes the byte code
                results.setdefault(name, []).append(pair)
    middle = lambda name, k, clock: statistics.median(pair[k][clock] for pair in results[name])
    columns = [(0, "wall"), (1, "wall"), (0, "processor"), (1, "processor"), (0, "verify")]
    found = {name: {f"{('first', 'from the disk')[k]}, {c}": middle(name, k, c) for k, c in columns} for name in results}
    names = sorted(found, key=lambda name: middle(name, 0, "wall"))
    rows = [(name, *(f"{value:.3f}" for value in found[name].values()), results[name][0][0]["engine"]) for name in names]
    header = ("system", "first call", "from the disk", "first, processor", "disk, processor", "verify, processor", "engine")
    print(table(header, rows, f"seconds of the first call in a new process, after the imports; medians of {repeats}"))
    for k, label in ((0, "first call"), (1, "from the disk")):
        times = [middle(name, k, "wall") for name in names]
        within = ", ".join(f"{sum(t <= limit for t in times)} within {limit:g} s" for limit in (0.1, 0.2, 0.5, 1.0))
        print(f"{label}: median {statistics.median(times):.3f} s, largest {max(times):.3f} s; of {len(times)}, {within}")
    store("first_call_gallery", found)


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
        given = json.loads(sys.argv[1])
        print(json.dumps(first_call(given["gallery"]) if "gallery" in given else measure(**given)))
    elif "--gallery" in sys.argv:
        over_gallery(1 if "--short" in sys.argv else 5)
    else:
        main("--short" in sys.argv)
