"""What stands around a run, over the gallery: each measured in a new process with nothing cached, the worst of each shown.

`python -m benchmarks.around_the_run` walks over the whole gallery; with names of systems over these, with `--parts a,b` over some
of the parts: `quantities` (the first and later calls, what their stats account for, energy, constraint, momenta, action, saving),
`failure` (a step that has no solution), `verify`, `prepared` (called again with other numbers), `convergence`, `compare`,
`program` (`dirax run NAME`).
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.harness import in_new_process, store, table

LONG = 0.01
"""Seconds of a call from which on its stats should account for its time."""

RUNS_OF_THE_SCHEMES = ("PlusLagrangeDirac", "MinusLagrangeDirac", "LagrangeDAlembert")

Clocks = dict[str, list[float]]
"""[wall, processor] seconds of each call."""


def timed(found: Clocks, label: str, function: Callable[[], Any]) -> Any:
    """What the function returns; its clocks go into `found`."""
    before = time.perf_counter(), time.process_time()
    value = function()
    found[label] = [time.perf_counter() - before[0], time.process_time() - before[1]]
    return value


def accounted(sol: Any, wall: float) -> float | None:
    """The share of a long call's time that its stats account for."""
    said = sum(value for name, value in sol.stats.items() if name.endswith("_seconds"))
    return said / wall if wall > LONG else None


def quantities(example: Any, found: Clocks) -> dict[str, Any]:
    """Calls, and what is asked of a solution."""
    import dirax as dx

    shares = {}
    for label, change in (("first call", {}), ("again", {}), ("other step", {"step": example.step * 0.999})):
        sol = timed(found, label, lambda change=change: example.simulate(**change))
        shares[label] = accounted(sol, found[label][0])
    sol = example.simulate(step=example.step)
    timed(found, "energy", sol.energy)
    timed(found, "constraint", sol.constraint_residual)
    for name, generator in list(example.symmetries.items())[:1]:
        timed(found, f"momentum {name}", lambda generator=generator: sol.momentum_map(generator))
    for label, function in (("action", dx.action_sum), ("discrete energy", dx.discrete_energy)):
        try:
            timed(found, label, lambda function=function: function(sol))
        except (TypeError, ValueError):  # what this scheme does not have
            found.pop(label, None)
    with tempfile.TemporaryDirectory() as folder:
        small = example.simulate(steps=10)
        timed(found, "save zarr", lambda: small.save(Path(folder) / "run.zarr"))
        timed(found, "save netCDF", lambda: small.save(Path(folder) / "run.nc"))
        timed(found, "to_csv", lambda: small.to_csv(Path(folder) / "run.csv"))
    return {"accounted": shares, "run": sol.stats["run_seconds"], "engine": sol.stats["engine"]}


def failure(example: Any, found: Clocks) -> dict[str, Any]:
    """The time of a call that fails, beyond that of its run."""
    for factor in (30.0, 300.0, 3000.0):
        try:
            example.simulate(steps=3, step=example.step * factor)
            longer = {"steps": 20, "step": example.step * factor * 1.01}
            sol = timed(found, "failing call", lambda longer=longer: example.simulate(**longer))
        except ValueError as error:  # refused before the first step
            return {"message": str(error)[:200]}
        if not np.all(sol.ok):
            found["explaining"] = [sol.stats["result_seconds"]] * 2
            return {"message": str(sol.message)[:200], "accounted": {"failing": accounted(sol, found["failing call"][0])}}
    return {}


def verify(example: Any, found: Clocks) -> dict[str, Any]:
    """The first `verify`."""
    import dirax as dx

    sol = example.simulate()
    report = timed(found, "verify", lambda: dx.verify(sol, symmetries=example.symmetries or None))
    return {"ok": report.ok}


def prepared(example: Any, found: Clocks) -> dict[str, Any]:
    """A prepared run of one step called again: the median and the largest of some calls with data, params, steps of their own."""
    import jax

    import dirax as dx

    data = {name: np.asarray(value, float) for name, value in example.initial.items() if name in ("q", "v", "p", "x")}
    given = {**example.initial, "params": example.params}
    run = dx.prepare(example.system, example.scheme, **given, step=example.step, steps=1)
    run()
    kinds = {
        "new data": lambda k: {n: a * (1 + 1e-13 * k) if n in ("v", "p", "x") else a for n, a in data.items()},
        "new params": lambda k: {"params": jax.tree.map(lambda leaf: np.asarray(leaf, float) * (1 + 1e-14 * k), example.params)},
        "new step": lambda k: {"step": example.step * (1 - 1e-3 * k)},
    }
    reached = {}
    for label, given in kinds.items():
        if label == "new params" and not jax.tree.leaves(example.params):
            continue
        seconds = []
        for k in range(1, 16):
            changed = given(k)
            tick = time.process_time()
            try:
                run(**changed)
            except ValueError:  # data that a premise excludes
                break
            seconds.append(time.process_time() - tick)
        if len(seconds) > 3:
            reached[label] = [float(np.median(seconds[2:])), float(max(seconds))]
    return {"microseconds": {label: [1e6 * s for s in pair] for label, pair in reached.items()}}


def convergence(example: Any, found: Clocks) -> dict[str, Any]:
    """The first `dx.convergence`."""
    import dirax as dx

    data, h = {**example.initial, "params": example.params}, example.step
    try:
        measured = timed(
            found,
            "convergence",
            lambda: dx.convergence(example.system, example.scheme, step_sizes=[h, h / 2, h / 4, h / 8], time=16 * h, **data),
        )
    except ValueError as error:
        return {"raised": str(error)[:300]}
    return {"order": measured.order}


def compare(example: Any, found: Clocks) -> dict[str, Any]:
    """The first `dx.compare` of three schemes."""
    import dirax as dx
    from dirax.cli.comparison import suitable

    listed = {name: getattr(dx, name)() for name in RUNS_OF_THE_SCHEMES}
    if "x" in example.initial:
        listed = dict(list(suitable(example, {}).items())[:3])
    data = {**example.initial, "params": example.params}
    steps = min(example.steps, 1000)
    try:
        timed(found, "compare", lambda: dx.compare(example.system, listed, step=example.step, steps=steps, **data))
    except (TypeError, ValueError) as error:
        return {"raised": str(error)[:300]}
    return {}


PARTS = {part.__name__: part for part in (quantities, failure, verify, prepared, convergence, compare)}


def measure(name: str, part: str) -> dict[str, Any]:
    """One part of the walk at one system, in this process."""
    import jax

    import dirax.public  # noqa: F401  (so that calls are measured alone)
    from dirax import gallery

    jax.config.update("jax_enable_compilation_cache", False)
    found: Clocks = {}
    more = PARTS[part](gallery.get(name), found)
    return {"clocks": found, **more}


def program(name: str) -> dict[str, Any]:
    """`dirax run NAME` from start to end."""
    before, tick = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    command = [sys.executable, "-m", "dirax", "run", name]
    environment = os.environ | {"JAX_ENABLE_COMPILATION_CACHE": "false"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    wall, after = time.perf_counter() - tick, resource.getrusage(resource.RUSAGE_CHILDREN)
    processor = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    alarms = [line for line in done.stderr.splitlines() if line.strip()]
    return {"clocks": {"dirax run": [wall, processor]}, "status": done.returncode, "stderr": alarms[:5]}


def walk(names: list[str], parts: list[str]) -> dict[str, dict[str, Any]]:
    """Everything measured, by part and by name; a failing process leaves what it said."""
    found: dict[str, dict[str, Any]] = {part: {} for part in parts}
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # byte code is in place, as it is on a user's machine
    for name in names:
        for part in parts:
            with tempfile.TemporaryDirectory() as folder:
                os.environ["DIRAX_CACHE"] = folder
                try:
                    measured = (
                        program(name)
                        if part == "program"
                        else in_new_process("benchmarks.around_the_run", {"name": name, "part": part})
                    )
                except RuntimeError as error:
                    measured = {"clocks": {}, "error": str(error)[-600:]}
            found[part][name] = measured
            print(name, part, json.dumps(measured), flush=True)
    return found


def worst(found: dict[str, dict[str, Any]], count: int = 4) -> str:
    """A table of the largest processor times of each row."""
    rows = []
    for part, of_names in found.items():
        calls: dict[str, list[tuple[float, float, str]]] = {}
        for name, measured in of_names.items():
            for label, (wall, processor) in measured["clocks"].items():
                calls.setdefault(label.split(" ")[0] if label.startswith("momentum") else label, []).append(
                    (processor, wall, name)
                )
            for label, (middle, _) in measured.get("microseconds", {}).items():
                calls.setdefault(f"{label}, median", []).append((middle / 1e6, middle / 1e6, name))
        for label, measurements in calls.items():
            cells = [f"{name} {processor:.3g} ({wall:.3g})" for processor, wall, name in sorted(measurements)[: -count - 1 : -1]]
            rows.append((part, label, f"{np.median([p for p, _, _ in measurements]):.3g}", *cells, *[""] * (count - len(cells))))
        shares = [
            (share, name, label)
            for name, measured in of_names.items()
            for label, share in measured.get("accounted", {}).items()
            if share is not None
        ]
        if shares:
            cells = [f"{name}, {label} {share:.3f}" for share, name, label in sorted(shares)[:count]]
            rows.append((part, "accounted for", "", *cells, *[""] * (count - len(cells))))
    return table(("part", "call", "median", *["worst"] * count), rows, "processor seconds (wall)")


def main() -> None:
    from dirax import gallery

    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("names", nargs="*")
    parser.add_argument("--parts", default=",".join([*PARTS, "program"]))
    chosen = parser.parse_args()
    found = walk(chosen.names or list(gallery.names()), chosen.parts.split(","))
    print(worst(found))
    if not chosen.names:
        store("around_the_run", found)


if __name__ == "__main__":
    if len(sys.argv) > 1 and sys.argv[1].startswith("{"):
        print(json.dumps(measure(**json.loads(sys.argv[1]))))
    else:
        main()
