"""A sweep beside the bare batch: time of a trajectory, memory, and what a task costs on a cluster of dask."""

import resource
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import dirax as dx
from benchmarks.harness import store, table
from dirax import gallery

STEP, STEPS, EVERY = 1e-2, 1000, 100
BARE = 20_000
"""Trajectories of a bare batch."""

PENDULUM = gallery.get("double-pendulum")
KEEPS = {
    "rows saved": None,
    "kept: largest angles": lambda sol: {"largest": np.max(np.abs(sol.q), axis=0)},
    "kept: energy error": lambda sol: {"error": np.max(np.abs(sol.energy() - sol.energy()[0]))},
}


def case(a, b):
    return {"q": [a, b], "v": [0.0, 0.0]}


def axes(points: int) -> dict[str, np.ndarray]:
    """Two axes of about so many points in all."""
    side = round(points**0.5)
    return {"a": np.linspace(-3, 3, side), "b": np.linspace(-3, 3, side)}


def bare() -> tuple[float, float]:
    """Seconds, and seconds of processors, of a trajectory in a batch of `simulate` that is not saved."""
    over = axes(BARE)
    q = np.stack(np.meshgrid(*over.values(), indexing="ij"), axis=-1).reshape(-1, 2)
    started, before = time.perf_counter(), processors()
    settings = {"params": PENDULUM.params, "step": STEP, "steps": STEPS, "save_every": EVERY}
    dx.simulate(PENDULUM.system, PENDULUM.scheme, q=q, v=[0.0, 0.0], **settings)
    return (time.perf_counter() - started) / len(q), (processors() - before) / len(q)


def swept(points: int, keep, folder: Path, executor=None, task_seconds: float = 1.0) -> tuple[float, float]:
    """The same of a whole sweep, its start and the writing of the store included."""
    over = axes(points)
    path = Path(tempfile.mkdtemp(dir=folder)) / "study.zarr"
    started, before = time.perf_counter(), processors()
    dx.sweep(
        PENDULUM.system,
        PENDULUM.scheme,
        over=over,
        case=case,
        params=PENDULUM.params,
        step=STEP,
        steps=STEPS,
        save_every=EVERY,
        keep=keep,
        to=path,
        executor=executor,
        task_seconds=task_seconds,
        progress=False,
    )
    count = len(over["a"]) ** 2
    return (time.perf_counter() - started) / count, (processors() - before) / count


def processors() -> float:
    """Seconds of processors that this process has used."""
    return sum(resource.getrusage(resource.RUSAGE_SELF)[:2])


def memory() -> float:
    """Most memory so far, in GB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def main(short: bool = False) -> None:
    points = 40_000 if short else 1_000_000
    results, rows = {"points": points, "steps": STEPS}, []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        bare(), swept(400, None, folder)  # compiled and imported
        first = memory()
        for label, keep in KEEPS.items():
            before, found, after = bare(), swept(points, keep, folder), bare()
            ratio = [(b + a) / 2 / s for b, s, a in zip(before, found, after, strict=True)]
            results[label] = {"seconds": found[0], "processor_seconds": found[1], "throughput": ratio, "memory": memory() - first}
            rows.append((label, f"{1e6 * found[0]:.1f}", f"{ratio[0]:.2f}", f"{ratio[1]:.2f}", f"{memory() - first:.2f}"))
    header = ("sweep", "µs a trajectory", "throughput / bare", "by processor time", "GB more")
    print(table(header, rows, f"{points} double pendulums, {STEPS} steps"))
    store("sweep", results)


if __name__ == "__main__":
    main("--short" in sys.argv)
