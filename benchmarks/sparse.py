"""Chains of many sites: time a step beside Newton's method by hand in NumPy and SciPy, first calls, derivatives."""

import json
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import solve_banded

import dirax as dx
from benchmarks.harness import in_new_process, interleaved, store, summary, table
from dirax.gallery import hanging_chain, oscillator_chain

STEP, BETA = 0.05, 0.8
CHAIN = oscillator_chain.chain(alpha=0.0, beta=BETA)
LINKS = 128
SPAN = 100
"""Steps of a call of CasADi's."""


def run(sites: int, steps: int) -> dx.Solution:
    q = oscillator_chain.first_mode(sites)
    return dx.simulate(CHAIN, dx.LagrangeDAlembert(), q=q, v=0 * q, step=STEP, steps=steps, save_every=steps)


def processor_time(sites: int, steps: int) -> float:
    """µs of processor time a step of a run of so many steps, beyond that of a run of two."""
    started = time.process_time()
    run(sites, 2)
    begun = time.process_time()
    run(sites, steps + 2)
    return (time.process_time() - begun - (begun - started)) / steps * 1e6


def by_hand(sites: int, steps: int) -> float:
    """µs of processor time a step of the midpoint rule on the same chain: two updates by SciPy's banded solver."""
    q, p, v = oscillator_chain.first_mode(sites), np.zeros(sites), np.zeros(sites)
    band = np.zeros((3, sites))
    started = time.process_time()
    for _ in range(steps):
        for _ in range(2):
            middle = q + STEP / 2 * v
            d = np.diff(middle, prepend=0.0, append=0.0)
            force, slope = d + BETA * d**3, 1 + 3 * BETA * d**2
            left = v - p + STEP / 2 * (force[:-1] - force[1:])
            band[1] = 1 + STEP**2 / 4 * (slope[:-1] + slope[1:])
            band[0, 1:] = band[2, :-1] = -(STEP**2) / 4 * slope[1:-1]
            v = v - solve_banded((1, 1), band, left, check_finite=False)
        q, p = q + STEP * v, 2 * v - p
    return (time.process_time() - started) / steps * 1e6


def in_casadi(sites: int, solver: str, folder: str) -> Callable[[int], float] | None:
    """(steps) ↦ µs of processor time a step of the same by CasADi: derivatives and two updates of Newton's method with one of its
    sparse linear solvers in the C that it writes, SPAN steps a call; None without CasADi or a C compiler."""
    try:
        import casadi as ca
    except ImportError:
        return None
    if shutil.which("cc") is None:
        return None
    q, p, v = (ca.SX.sym(name, sites) for name in "qpv")
    middle = ca.vertcat(0, q + STEP / 2 * v, 0)
    d = middle[1:] - middle[:-1]
    force = d + BETA * d**3
    left = v - p + STEP / 2 * (force[:-1] - force[1:])
    equation = ca.Function("equation", [q, p, v], [left, ca.jacobian(left, v)])
    q, p, v = (ca.MX.sym(name, sites) for name in "qpv")
    found = v
    for _ in range(2):
        residual, matrix = equation(q, p, found)
        found = found - ca.solve(matrix, residual, solver)
    step = ca.Function("step", [ca.vertcat(q, p, v)], [ca.vertcat(q + STEP * found, 2 * found - p, found)])
    code = step.fold(SPAN).generate(f"{solver}.c")
    Path(code).rename(f"{folder}/{solver}.c")
    library = f"{folder}/{solver}.so"
    subprocess.run(["cc", "-O3", "-march=native", "-shared", "-fPIC", f"{folder}/{solver}.c", "-o", library, "-lm"], check=True)
    run = ca.external(step.fold(SPAN).name(), library)

    def timed(steps: int) -> float:
        state = np.concatenate([oscillator_chain.first_mode(sites), np.zeros(2 * sites)])
        started = time.process_time()
        for _ in range(steps // SPAN):
            state = run(state)
        return (time.process_time() - started) / (steps // SPAN * SPAN) * 1e6

    return timed


def peak() -> int:
    """The most bytes of memory that this process had; the kernel's own counter takes in those of the process that started it."""
    status = Path("/proc/self/status")
    if status.exists():
        return 1024 * int(next(line.split()[1] for line in status.read_text().splitlines() if line.startswith("VmHWM")))
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def first(sites: int) -> dict:
    """Seconds to the first result in a new process, also of processor time; and by how many bytes for each unknown its memory
    grows with a run of twice as many."""
    started, used = time.perf_counter(), time.process_time()
    run(sites, 2)
    found = {"seconds": time.perf_counter() - started, "processor_seconds": time.process_time() - used}
    before = peak()
    run(2 * sites, 2)
    return found | {"bytes_per_unknown": (peak() - before) / (2 * sites)}


def links(steps: int) -> float:
    """µs of processor time a step of a chain of LINKS links that begins level, in its first second: then it cracks as a whip."""
    q = hanging_chain.straight(LINKS)
    started = time.process_time()
    found = dx.simulate(hanging_chain.SYSTEM, dx.LagrangeDAlembert(), q=q, v=0 * q, step=1e-3, steps=steps, save_every=steps)
    assert found.ok, found.message
    return (time.process_time() - started) / steps * 1e6


def derivative(sites: int, steps: int) -> dict:
    """Seconds of a run and of the gradient of its end in all initial velocities."""
    q = jnp.asarray(oscillator_chain.first_mode(sites))

    def end(v):
        sol = dx.simulate(CHAIN, dx.LagrangeDAlembert(), q=q, v=v, step=STEP, steps=steps, save_every=steps)
        return jnp.sum(sol.p[-1] ** 2)

    value, both = jax.jit(end), jax.jit(jax.grad(end))
    times = {}
    for name, function in (("run", value), ("gradient", both)):
        jax.block_until_ready(function(0 * q))
        started = time.process_time()
        jax.block_until_ready(function(0 * q))
        times[name] = time.process_time() - started
    return times


def main(short: bool = False) -> None:
    results: dict[str, Any] = {"system": "FPUT chain with quartic forces, midpoint L_d"}
    rows = []
    for sites in (64, 1000, 10_000, 100_000):
        steps = max(20, (200_000 if short else 2_000_000) // sites)
        programs = {
            "dirax": lambda sites=sites, steps=steps: processor_time(sites, steps),
            "by hand": lambda sites=sites, steps=steps: by_hand(sites, min(steps, 200)),
        }
        run(sites, 2)
        found = {name: summary(values) for name, values in interleaved(programs, 3 if short else 9).items()}
        begun = in_new_process("benchmarks.sparse", {"what": "first", "sites": sites})
        results[str(sites)] = {"microseconds_per_step": found, "first_call": begun}
        ours, theirs = found["dirax"]["median"], found["by hand"]["median"]
        cells = (ours / sites, theirs / ours, begun["seconds"], begun["bytes_per_unknown"])
        rows.append((str(sites), *(f"{number:.3g}" for number in cells)))
    _beside_casadi(results, short)
    links(10)
    results["links"] = min(links(1000) for _ in range(3))
    results["derivative"] = derivative(10_000, 100)
    header = ("sites", "µs an unknown and step", "by hand / dirax", "first call s", "bytes an unknown")
    print(table(header, rows, results["system"]))
    times = results["derivative"]
    print(f"{LINKS} links: {results['links']:.3g} µs a step; a gradient takes {times['gradient'] / times['run']:.3g} runs")
    store("sparse", results)


def _beside_casadi(results: dict, short: bool) -> None:
    """Its two sparse solvers at 1000 sites."""
    sites, steps = 1000, 400 if short else 2000
    with tempfile.TemporaryDirectory() as folder:
        made = {solver: in_casadi(sites, solver, folder) for solver in ("qr", "ldl")}
        programs = {solver: run for solver, run in made.items() if run is not None}
        if not programs:
            return print("CasADi or a C compiler is missing")
        found = interleaved(
            {"dirax": lambda: processor_time(sites, steps)} | {k: lambda run=run: run(steps) for k, run in programs.items()}, 5
        )
    results["casadi"] = {name: summary(values) for name, values in found.items()}
    cells = [(name, f"{value['median'] / sites:.3g}") for name, value in results["casadi"].items()]
    print(table(("program", "µs an unknown and step"), cells, f"{sites} sites beside CasADi's C with its sparse solvers"))


if __name__ == "__main__":
    if len(sys.argv) > 1 and sys.argv[1].startswith("{"):
        arguments = json.loads(sys.argv[1])
        print(json.dumps({"first": first}[arguments.pop("what")](**arguments)))
    else:
        main("--short" in sys.argv)
