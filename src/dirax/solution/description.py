"""What a Solution holds, said in full: named variables with dimensions and units, and a record of what was run.

It is what a Dataset, a table and a file are made from.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from dirax.schemes.step import Field
from dirax.solution.plain_forms import NotPlain, code_of_params, encode_params, encode_scheme
from dirax.solution.stored_events import KINDS, WHOLE_ARRAYS, arrays_of, record_of
from dirax.solution.trajectory import NotSaved, Trajectory
from dirax.text.tables import plain

FORMAT = 1
"""Version of the layout below; a file of a later one is refused."""

RENAMED = {"constraint": "constraint_residual"}
"""Fields that have another name in a description, because a dimension has theirs."""

TAKEN = {"time", "interval", "trajectory", "coordinate", "energy", "ok"}
"""Names that a field cannot have in a description."""

PARAMS_CODE = "params_code"
"""What of the params is code, such as their class, in the metadata of a file."""

DERIVED = ("energy", "constraint_residual")


@dataclass(frozen=True)
class Variable:
    """An array with the names of its axes and what is said about it: `long_name`, `units`, `coordinate_names`."""

    dims: tuple[str, ...]
    values: np.ndarray
    about: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Description:
    """`variables` by name, `axes`: time, interval and the names of the coordinates; `attributes`: what was run."""

    variables: dict[str, Variable]
    axes: dict[str, Variable]
    attributes: dict[str, Any]


def describe(
    sol: Trajectory, units: Mapping[str, Any] | None = None, coordinates: Sequence[str] | None = None, derived: bool = True
) -> Description:
    """The solution in full.

    Dimensions: `trajectory` (in a batch), `time` (saved rows), `interval` (the step leaving a row), `coordinate`,
    `constraint`, `events`, `impacts`. Variables: every saved field, `energy`, `constraint_residual`, the initial data, what
    `sol.events` holds, and `ok` in a batch. `units` and `coordinates` default to what `sol.metadata` says. Attributes record
    what was run, as text and as JSON. Without `derived` nothing is computed.

    Raises `ValueError` for unknown, repeated or too few names, and for a solution inside `jax.grad`, `jit` or `vmap`.
    """
    sol.refuse_traced("convert or save it")
    layout = layout_of(sol.field_info)
    units = _checked_units(sol, units)
    lead = () if sol.batch is None else ("trajectory",)
    sizes = dict.fromkeys((entry["variable"] for entry in layout), -1)  # no dimension may have the name of a variable
    variables: dict[str, Variable] = {}
    for entry in layout:
        rows = "time" if entry["place"] == "node" else "interval"
        dims = _dimensions(entry["name"], entry["dims"], entry["shape"], sizes)
        about = {"long_name": entry["description"] or entry["name"], "units": _unit(units, entry["name"])}
        values = np.asarray(sol.fields[entry["name"]])
        if values.dtype != np.float64:
            entry["dtype"] = "int8" if values.dtype == bool else values.dtype.name
        variables[entry["variable"]] = Variable((*lead, rows, *dims), values, about)
    quantities = _derived(sol, variables) if derived else {}
    for name, values in quantities.items():
        inner = values.shape[len(lead) + 1 :]
        dims = _dimensions(name, ["constraint"] * len(inner), inner, sizes)
        about = {"long_name": name.replace("_", " "), "units": _unit(units, name)}
        variables[name] = Variable((*lead, "time", *dims), values, about)
    for name, values in sol.initial.items():
        dims = _dimensions(f"initial_{name}", ["coordinate"], np.shape(values)[-1:], sizes)
        about = {"long_name": f"initial data {name}", "units": _unit(units, name)}
        variables[f"initial_{name}"] = Variable((*lead[: np.ndim(values) - 1], *dims), np.asarray(values), about)
    for kind in KINDS:
        if (found := getattr(sol, kind)) is not None:
            for name, values in arrays_of(kind, found).items():
                info = sol.field_info.get(name.removeprefix(f"{kind}_"))
                dims = _dimensions(name, info.dims if info else (), values.shape[1:], sizes)
                variables[name] = Variable((kind, *dims), values, {"long_name": name.replace("_", " of ", 1)})
    if lead:
        variables["ok"] = Variable(lead, np.asarray(sol.ok, dtype=bool), {"long_name": "whether every step was solved"})

    time = {
        "long_name": "number of steps times step, of which clock is the time" if sol.has_own_times else "time",
        "units": _unit(units, "t"),
    }
    axes = {"time": Variable(("time",), np.asarray(sol.axis), time)}
    if any(entry["place"] == "step" for entry in layout):
        about = {**time, "long_name": "time at which a step begins"}
        axes["interval"] = Variable(("interval",), np.asarray(sol.axis)[:-1], about)
    names = _checked_names(sol, coordinates, sizes.get("coordinate", 0))
    if names:
        axes["coordinate"] = Variable(("coordinate",), np.array(names, dtype=object), {"long_name": "coordinate"})
        for variable in variables.values():
            if "coordinate" in variable.dims:
                variable.about["coordinate_names"] = ", ".join(names)
    metadata = {**sol.metadata, **({"units": units} if units else {}), **({"coordinates": names} if names else {})}
    return Description(variables, axes, _attributes(sol, layout, list(quantities), metadata))


# ------------------------------------------------------------------------------------------------------------------ parts


def layout_of(fields: Mapping[str, Field]) -> list[dict[str, Any]]:
    """Name, name in the description, shape, place, dimensions and description of every field."""
    layout = []
    for name, info in fields.items():
        variable = RENAMED.get(name, f"{name}_field" if name in TAKEN else name)
        layout.append({"name": name, "variable": variable, **vars_of(info)})
    return layout


def type_of(variable: str, layout: Sequence[Mapping[str, Any]]) -> str:
    """The type of the numbers that a file has in an array: that of a field, and float64 but for what is whole."""
    fields = {entry["variable"]: entry.get("dtype", "float64") for entry in layout}
    return fields.get(variable, "int8" if variable == "ok" else "int64" if variable in WHOLE_ARRAYS else "float64")


def vars_of(info: Field) -> dict[str, Any]:
    """A Field as plain data; how it is composed, and that it is chosen, only where it says so, which files of the first version
    never do."""
    own = ({"composed": info.composed} if info.composed else {}) | ({"chosen": True} if info.chosen else {})
    return {
        "shape": list(info.shape),
        "place": info.place,
        "dims": list(info.dims),
        "description": info.description,
        **own,
    }


def _derived(sol: Trajectory, variables) -> dict[str, np.ndarray]:
    """Energy and constraint residual where they can be had and are not fields themselves."""
    derived = {}
    for name in DERIVED:
        if name in variables or (sol.system is None and name not in sol.derived):
            continue
        try:
            values = np.asarray(getattr(sol, name)())
        except NotSaved:  # a scheme of the user's that saves no momentum, say
            continue
        if values.size:
            derived[name] = values
    return derived


def _dimensions(name: str, dims: Sequence[str], shape: Sequence[int], sizes: dict[str, int]) -> list[str]:
    """The names of a field's axes; a name of its own for an axis that would contradict the size of an earlier one."""
    named = list(dims) if len(dims) == len(shape) else [f"{name}_axis_{i}" for i in range(len(shape))]
    for i, size in enumerate(shape):
        if sizes.get(named[i], size) != size or named[i] in named[:i]:
            named[i] = f"{name}_axis_{i}"
        sizes[named[i]] = int(size)
    return named


def _checked_units(sol: Trajectory, units: Mapping[str, Any] | None) -> dict[str, Any]:
    if units is None:
        return dict(sol.metadata.get("units", {}))
    if not isinstance(units, Mapping):
        raise TypeError(f'units must be a dict by the names of fields such as {{"q": "m"}}, but {units!r:.60} was given.')
    known = ["t", *DERIVED, *sol.fields]
    for name, unit in units.items():
        if name not in known:
            near = get_close_matches(name, known, 1)
            raise ValueError(
                f"units names {name!r}, which this solution does not hold: "
                f"{f'did you mean {near[0]!r}?' if near else 'it holds ' + ', '.join(known) + '.'}"
            )
        if not isinstance(unit, str) and not (isinstance(unit, list | tuple) and all(isinstance(u, str) for u in unit)):
            raise TypeError(f"units[{name!r}] must be a string, or a list of strings, but {unit!r} was given.")
    return {name: unit if isinstance(unit, str) else list(unit) for name, unit in units.items()}


def _unit(units: Mapping[str, Any], name: str) -> str:
    unit = units.get(name, units.get({v: k for k, v in RENAMED.items()}.get(name, name), ""))
    if isinstance(unit, str):
        return unit
    return unit[0] if len(set(unit)) == 1 else ", ".join(unit)


def _checked_names(sol: Trajectory, coordinates: Sequence[str] | None, count: int) -> list[str]:
    names = [str(name) for name in (sol.metadata.get("coordinates", ()) if coordinates is None else coordinates)]
    if names and len(names) != count:
        raise ValueError(f"coordinates must hold one name for each of {count} coordinates, but it holds {len(names)}: {names}.")
    if twice := next((name for k, name in enumerate(names) if name in names[:k]), None):
        raise ValueError(f"coordinates names {twice!r} twice: give every coordinate a name of its own.")
    return names


def _attributes(sol: Trajectory, layout, derived: list[str], metadata: dict[str, Any]) -> dict[str, Any]:
    try:
        installed = version("dirax")
    except PackageNotFoundError:
        installed = "unknown"
    params, code = _params(sol)
    metadata = {**metadata, **({PARAMS_CODE: code} if code else {})}
    text = lambda value, name: repr(value) if value is not None else str(sol.metadata.get(name, ""))
    batched = sol.batch is not None
    attributes = {
        "title": "dirax solution",
        "dirax_format": FORMAT,
        "dirax_version": installed,
        "system": text(sol.system, "system"),
        "scheme": text(sol.scheme, "scheme"),
        "scheme_settings": json.dumps(encode_scheme(sol.scheme)),
        "step": float(sol.step),
        "save_every": int(sol.save_every),
        "stats": json.dumps(plain(sol.stats, nonfinite=True)),
        "ok": json.dumps(bool(np.all(sol.ok))),
        "message": json.dumps({lane: text for lane, text in enumerate(sol.message) if text} if batched else sol.message),
        "batch_params": int(sol.batch_params),
        "fields": json.dumps(layout),
        "initial": json.dumps(list(sol.initial)),
        "derived": json.dumps(derived),
        "metadata": json.dumps(
            plain({k: v for k, v in metadata.items() if k not in ("system", "scheme", "dirax_version")}, nonfinite=True)
        ),
    }
    if events := {kind: record_of(found) for kind in KINDS if (found := getattr(sol, kind)) is not None}:
        attributes["events"] = json.dumps(events)
    return attributes | params


def _params(sol: Trajectory) -> tuple[dict[str, str], str]:
    """The attribute of params, and what of them is code."""
    try:
        record = encode_params(sol.params)
    except NotPlain as value:
        return {"params_not_stored": str(value)}, str(value)
    return {"params": json.dumps(record)}, code_of_params(record)
