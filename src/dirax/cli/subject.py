"""What a command works on: a system of the gallery or a user's own file, with the changes of `--set`."""

import ast
import dataclasses
import difflib
import inspect
import os
import re
import runpy
import sys
import traceback
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dirax import gallery
from dirax.gallery.example import Example
from dirax.schemes.step import AbstractScheme
from dirax.systems.system import AbstractSystem
from dirax.text.representation import shortened

INITIAL = ("q", "v", "p", "q0", "q1", "x")
RUN_OPTIONS = ("save_every", "t0", "max_iterations", "engine", "project", "check_initial")
IN_FILES = (*RUN_OPTIONS, "inputs", "events", "batch_params", "compensated")
"""Arguments of `dx.simulate` that `--set` gives, and those that a file may define."""

EXCLUDES = {"v": {"p"}, "p": {"v"}, "q0": {"q", "v", "p"}, "q1": {"q", "v", "p"}, "q": {"q0", "q1"}, "x": {"q", "v", "p"}}
"""Initial data that a newly given one replaces."""


def subject(name: str) -> Example:
    """The example to run: the gallery's by name, or the one that a Python file defines if `name` ends in .py. Raises `ValueError`
    for another name, and for the path of anything else."""
    if not name.endswith(".py") and name not in gallery.names() and os.path.exists(name):
        raise ValueError(f"{name} is no Python file: give one that ends in .py, or a name that `dirax list` shows.")
    return from_file(Path(name)) if name.endswith(".py") else gallery.get(name)


def from_file(path: Path) -> Example:
    """Run a user's file and take `system` and `initial` from it, and `scheme`, `step`, `steps`, `params`, `scene` and other
    arguments of `dx.simulate` (IN_FILES) if they are there.

    Raises `ValueError` where the file fails (with the line) or does not define them, `FileNotFoundError` without a file.
    """
    found = namespace(path)
    _require(path, found, "system", AbstractSystem, "a dirax system such as dx.LagrangeDirac(…)")
    _require(path, found, "initial", Mapping, "a dict of initial data such as dict(q=[…], v=[…])")
    unknown = set(found["initial"]) - set(INITIAL)
    if unknown or not found["initial"]:
        raise ValueError(
            f"`initial` in {path} may hold {', '.join(INITIAL)}, but it holds "
            f"{', '.join(map(str, found['initial'])) or 'nothing'}."
        )
    if "scheme" in found:
        _require(path, found, "scheme", AbstractScheme, "a dirax scheme such as dx.PlusLagrangeDirac()")
    return Example(
        name=path.stem,
        title=path.name,
        source=str(path),
        system=found["system"],
        initial=dict(found["initial"]),
        scheme=found["scheme"] if "scheme" in found else _first_scheme(found),
        step=found.get("step", 0.01),
        steps=found.get("steps", 1000),
        params=found.get("params"),
        coordinates=(),
        options={name: found[name] for name in IN_FILES if name in found and not inspect.ismodule(found[name])},
        scene=found.get("scene"),
    )


def _first_scheme(found: dict[str, Any]) -> AbstractScheme:
    from dirax.cli.schemes import first_scheme  # with all schemes, where one is looked for

    return first_scheme(found["system"], found["initial"], found.get("params"))


def namespace(path: Path) -> dict[str, Any]:
    """What a Python file defines, which finds modules beside it. Raises `ValueError` where it fails, with the line,
    `FileNotFoundError` without a file."""
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}: check the path.")
    if (folder := str(path.resolve().parent)) not in sys.path:
        sys.path.insert(0, folder)
    try:
        return runpy.run_path(str(path), run_name="dirax_file")
    except SyntaxError as error:
        where = f", line {error.lineno}" if error.lineno else ""  # none for a file that is no text
        raise ValueError(f"{path}{where}: {error.msg}.") from error
    except Exception as error:
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if Path(frame.filename) == path]
        where = f", line {lines[-1]}" if lines else ""
        raise ValueError(f"{path}{where}: {type(error).__name__}: {error}") from error


def _require(path: Path, found: dict[str, Any], name: str, kind: type, expected: str) -> None:
    if name not in found:
        raise ValueError(f"{path} does not define `{name}`: it needs `system` and `initial`, {expected}.")
    if not isinstance(found[name], kind):
        raise ValueError(f"`{name}` in {path} must be {expected}, but it is a {type(found[name]).__name__}.")


def changed(example: Example, settings: Sequence[str]) -> tuple[Example, dict[str, Any]]:
    """The example with the settings `key=value` of a command line, and options for `simulate`.

    Keys: step, steps, save_every, t0, max_iterations, engine, project, check_initial; q, v, p, q0, q1, x for initial data,
    or one entry of them, `q[2]=0.5` or `q[θ]=0.5`; the parameters by name. Values are Python literals. Raises `ValueError`.
    """
    numbers: dict[str, Any] = {}
    initial = {name: np.array(value, dtype=float) if name in INITIAL else value for name, value in example.initial.items()}
    params, options = example.params, dict(example.options)
    for setting in settings:
        key, equals, text = setting.partition("=")
        key = key.strip()
        if not equals:
            raise ValueError(f"--set takes key=value, but {shortened(setting)} was given.")
        value = _literal(key, text)
        entry = re.fullmatch(r"(\w+)\[(.+)\]", key)
        if key in ("step", "steps"):
            numbers[key] = _whole(value) if key == "steps" else value
        elif key in RUN_OPTIONS:
            options[key] = _whole(value)
        elif key in INITIAL:
            initial = {k: a for k, a in initial.items() if k not in EXCLUDES[key]}
            initial[key] = _array(key, value)
        elif entry and entry[1] in initial:
            initial[entry[1]][_position(example, entry[1], entry[2], initial)] = _number(key, value)
        elif isinstance(params, Mapping) and key in params:
            real = isinstance(params[key], float) and isinstance(value, int)  # --set k=1 for a parameter that is 4.0
            params = {**params, key: float(value) if real else value}
        else:
            raise ValueError(_unknown(key, initial, params))
    return dataclasses.replace(example, initial=initial, params=params, **numbers), options


def _literal(key: str, text: str) -> Any:
    try:
        return ast.literal_eval(text.strip())
    except (ValueError, SyntaxError, RecursionError, MemoryError):
        if text.strip().isidentifier():
            return {"true": True, "false": False}.get(text.strip().lower(), text.strip())
        raise ValueError(
            f"cannot read the value {shortened(text)} of {key:.60}: give a number, a list such as [0, 1.5], or a word."
        ) from None


def _whole(value: Any) -> Any:
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _array(key: str, value: Any) -> np.ndarray:
    try:
        return np.array(value, dtype=float)
    except (TypeError, ValueError):
        raise ValueError(f"{key} must be a list of numbers, but {shortened(value)} was given.") from None


def _number(key: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{key} must be a number, but {shortened(value)} was given.")
    return float(value)


def _position(example: Example, name: str, index: str, initial: dict[str, np.ndarray]) -> tuple[Any, int]:
    labels = [coordinate.name for coordinate in example.coordinates]
    size = initial[name].shape[-1]
    if index in labels:
        return ..., labels.index(index)
    if re.fullmatch(r"-?\d+", index) and -size <= int(index) < size:
        return ..., int(index)
    names = f", or one of {', '.join(labels)}" if labels else ""
    raise ValueError(f"{name} has no entry {shortened(index)}: give a number from 0 to {size - 1}{names}.")


def _unknown(key: str, initial: dict[str, Any], params: Any) -> str:
    known = ["step", "steps", *RUN_OPTIONS, *initial, *(params if isinstance(params, Mapping) else ())]
    near = difflib.get_close_matches(key, known, n=1)
    return f"cannot set {shortened(key)}: {f'did you mean {near[0]}?' if near else 'there are ' + ', '.join(known) + '.'}"
