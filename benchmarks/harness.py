"""What every benchmark needs: interleaved repeats and the machine (from the package), new processes, results as JSON."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from dirax.diagnostics.bench.timing import interleaved, machine, summary

__all__ = ["RESULTS", "in_new_process", "interleaved", "machine", "store", "summary", "table"]

RESULTS = Path(__file__).parent / "results"
FAST_LOOPS = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=65536"


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


def store(name: str, results: dict[str, Any]) -> Path:
    """Write `results/name.json` with the description of the machine."""
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / f"{name}.json"
    path.write_text(json.dumps({"machine": machine(), **results}, indent=1, ensure_ascii=False) + "\n")
    return path


def table(header: tuple[str, ...], rows: list[tuple[str, ...]], title: str) -> str:
    """Aligned text."""
    from dirax.text.tables import text_table

    return text_table(header, rows, title) + "\n"
