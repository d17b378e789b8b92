"""What every benchmark needs: interleaved repeats, a description of the machine, results as JSON."""

import datetime
import json
import os
import platform
import shutil
import statistics
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent / "results"
FAST_LOOPS = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=65536"


def interleaved(programs: dict[str, Callable[[], float]], repeats: int) -> dict[str, list[float]]:
    """Every program once a round, in turn, so that a busy machine slows all of them alike; what each call returned."""
    for program in programs.values():
        program()
    rounds = [{name: program() for name, program in programs.items()} for _ in range(repeats)]
    return {name: [values[name] for values in rounds] for name in programs}


def summary(values: list[float]) -> dict[str, float]:
    """Median and smallest of the repeats."""
    return {"median": statistics.median(values), "min": min(values), "repeats": len(values)}


def in_new_process(module: str, arguments: dict[str, Any], fast_loops: bool = False) -> Any:
    """The JSON that `python -m module '{"argument": …}'` prints in its last line."""
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    if fast_loops:
        environment["XLA_FLAGS"] = FAST_LOOPS
    command = [sys.executable, "-m", module, json.dumps(arguments)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, cwd=Path(__file__).parents[1])
    if done.returncode:
        raise RuntimeError(f"{module} {arguments} failed:\n{done.stderr}")
    return json.loads(done.stdout.splitlines()[-1])


def machine() -> dict[str, Any]:
    """Processor, system, versions and load."""
    import jax
    import numpy as np

    import dirax

    compiler = shutil.which("gcc") or shutil.which("cc")
    version = subprocess.run([compiler, "--version"], capture_output=True, text=True).stdout if compiler else ""
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "load_average": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "jax": jax.__version__,
        "numpy": np.__version__,
        "compiler": version.splitlines()[0] if version else None,
        "dirax": dirax.__version__,
        "date": datetime.date.today().isoformat(),
    }


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def store(name: str, results: dict[str, Any]) -> Path:
    """Write `results/name.json` with the description of the machine."""
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / f"{name}.json"
    path.write_text(json.dumps({"machine": machine(), **results}, indent=1, ensure_ascii=False) + "\n")
    return path


def table(header: tuple[str, ...], rows: list[tuple[str, ...]], title: str) -> str:
    """Aligned text."""
    from dirax.tables import text_table

    return text_table(header, rows, title) + "\n"
