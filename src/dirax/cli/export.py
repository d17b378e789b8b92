"""What `dirax export` does: a run as a program of its own."""

from collections.abc import Sequence
from pathlib import Path

from dirax.cli.schemes import scheme_from_text
from dirax.cli.subject import changed, subject
from dirax.run.export_c import export_c


def write_c(name: str, settings: Sequence[str], scheme: str | None, out: Path | None, overwrite: bool) -> Path:
    """Write the run of the named system as a C file, and say where it is."""
    path = Path(f"{Path(name).stem}.c") if out is None else out
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} exists: pass --overwrite to replace it, or choose another path for --out.")
    example, options = changed(subject(name), settings)
    chosen = scheme_from_text(scheme) if scheme else example.scheme
    run = {**example.initial, "params": example.params, "step": example.step, "steps": example.steps, **options}
    if isinstance(options.get("params"), dict) and isinstance(example.params, dict):
        run["params"] = {**example.params, **options["params"]}
    export_c(path, example.system, chosen, example.title, **run)
    return path
