"""Interleaved repeats, and the machine that they ran on."""

import datetime
import os
import platform
import shutil
import statistics
import subprocess
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from dirax.numerics.processors import processors

LIBRARIES = ("numpy", "jax", "llvmlite", "scipy", "casadi", "heyoka", "diffrax")


def interleaved(programs: dict[str, Callable[[], float]], repeats: int) -> dict[str, list[float]]:
    """What each call returned, `repeats` of them a program: every program once a round, in turn, so that a busy machine
    slows all of them alike. A first round, in which things are compiled, is not counted."""
    for program in programs.values():
        program()
    rounds = [{name: program() for name, program in programs.items()} for _ in range(repeats)]
    return {name: [values[name] for values in rounds] for name in programs}


def summary(values: list[float]) -> dict[str, float]:
    """Median and smallest of the repeats."""
    return {"median": statistics.median(values), "min": min(values), "repeats": len(values)}


def compiler() -> str | None:
    """The path of a C compiler, None without one."""
    return shutil.which("gcc") or shutil.which("cc") or shutil.which("clang")


def machine() -> dict[str, Any]:
    """Processor, cores, load, system, and the versions of what is compared; None for what is not there."""
    found = compiler()
    described = subprocess.run([found, "--version"], capture_output=True, text=True).stdout.splitlines() if found else []
    return {
        "processor": _processor(),
        "cores": processors(),
        "load_average": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "dirax": _version("dirax"),
        **{name: _version(name) for name in LIBRARIES},
        "compiler": described[0] if described else None,
        "date": datetime.date.today().isoformat(),
    }


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
