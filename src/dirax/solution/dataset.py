"""A Solution as an xarray Dataset, and back: named dimensions, units, derived quantities, and a record of what was run."""

import json
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

import numpy as np

from dirax.program.user_functions import is_traced
from dirax.schemes.step import Field, Shape, make_step_equation
from dirax.solution.records import NotPlain, decode_params, decode_scheme, encode_params, encode_scheme, plain
from dirax.solution.solution import Solution

if TYPE_CHECKING:
    from xarray import Dataset

FORMAT = 1
"""Version of the layout below; a Dataset of a later one is refused."""

RENAMED = {"constraint": "constraint_residual"}
"""Fields that have another name in a Dataset, because a dimension has theirs."""

TAKEN = {"time", "interval", "trajectory", "coordinate", "energy", "ok"}
"""Names that a field cannot have in a Dataset."""

DERIVED = ("energy", "constraint_residual")


def to_dataset(sol: Solution, units: Mapping[str, Any] | None = None, coordinates: Sequence[str] | None = None) -> "Dataset":
    """The solution as an `xarray.Dataset`.

    Dimensions: `trajectory` (in a batch), `time` (saved rows), `interval` (the step leaving a row), `coordinate`,
    `constraint`. Variables: every saved field, `energy`, `constraint_residual`, the initial data, and `ok` in a batch.
    `units`: a unit for "t", "energy" or the name of a field, one string or one per coordinate; `coordinates`: the names of
    the coordinates. Both default to what `sol.metadata` says. Attributes record what was run, as text and as JSON.

    Raises `ValueError` for unknown names, wrong lengths, and a solution inside `jax.grad`, `jit` or `vmap`.
    """
    import xarray as xr

    if is_traced(sol.t, sol.fields, sol.step, sol.params, sol.stats):
        raise ValueError(
            "this solution holds traced values, not numbers: convert or save it outside of jax.grad, jit and vmap, or return "
            "its arrays from the transformed function."
        )
    layout = _layout(sol)
    units = _checked_units(sol, units)
    lead = () if sol.batch is None else ("trajectory",)
    sizes = dict.fromkeys((entry["variable"] for entry in layout), -1)  # no dimension may have the name of a variable
    variables: dict[str, Any] = {}
    for entry in layout:
        rows = "time" if entry["place"] == "node" else "interval"
        dims = _dimensions(entry["name"], entry["dims"], entry["shape"], sizes)
        about = {"long_name": entry["description"] or entry["name"], "units": _unit(units, entry["name"])}
        variables[entry["variable"]] = ((*lead, rows, *dims), np.asarray(sol.fields[entry["name"]]), about)
    derived = _derived(sol, variables)
    for name, values in derived.items():
        inner = values.shape[len(lead) + 1 :]
        dims = _dimensions(name, ["constraint"] * len(inner), inner, sizes)
        about = {"long_name": name.replace("_", " "), "units": _unit(units, name)}
        variables[name] = ((*lead, "time", *dims), values, about)
    for name, values in sol.initial.items():
        dims = _dimensions(f"initial_{name}", ["coordinate"], np.shape(values)[-1:], sizes)
        about = {"long_name": f"initial data {name}", "units": _unit(units, name)}
        variables[f"initial_{name}"] = ((*lead[: np.ndim(values) - 1], *dims), np.asarray(values), about)
    if lead:
        variables["ok"] = (lead, np.asarray(sol.ok, dtype=bool), {"long_name": "whether every step was solved"})

    time = {"long_name": "time", "units": _unit(units, "t")}
    coords: dict[str, Any] = {"time": ("time", np.asarray(sol.t), time)}
    if any(entry["place"] == "step" for entry in layout):
        coords["interval"] = ("interval", np.asarray(sol.t)[:-1], {**time, "long_name": "time at which a step begins"})
    names = _checked_names(sol, coordinates, sizes.get("coordinate", 0))
    if names:
        coords["coordinate"] = ("coordinate", np.array(names, dtype=object), {"long_name": "coordinate"})
        for dims, _, about in variables.values():
            if "coordinate" in dims:
                about["coordinate_names"] = ", ".join(names)
    metadata = {**sol.metadata, **({"units": units} if units else {}), **({"coordinates": names} if names else {})}
    return xr.Dataset(variables, coords, _attributes(sol, layout, list(derived), metadata))


def from_dataset(dataset: "Dataset", params: Any = None) -> Solution:
    """The Solution that `to_dataset` described, without system; `KeyError`, `TypeError` or `ValueError` for another Dataset.

    Nothing in the Dataset is executed: schemes of dirax are recognized by name. `params` replaces the recorded ones.
    """
    about = dataset.attrs
    read = lambda name: json.loads(about[name])
    values = lambda name: np.array(dataset[name].values)
    layout, batched = read("fields"), "trajectory" in dataset.sizes
    ok, message = read("ok"), read("message")
    if batched:
        ok = values("ok").astype(bool)
        message = [str(message.get(str(lane), "")) for lane in range(len(ok))]
    if params is None and "params" in about:
        params = decode_params(read("params"))
    return Solution(
        t=values("time"),
        fields={e["name"]: values(e["variable"]) for e in layout},
        field_info={e["name"]: Field(tuple(e["shape"]), e["place"], tuple(e["dims"]), e["description"]) for e in layout},
        step=float(about["step"]),
        save_every=int(about["save_every"]),
        stats=read("stats"),
        ok=ok,
        message=message,
        scheme=decode_scheme(read("scheme_settings")),
        params=params,
        batch_params=bool(about["batch_params"]),
        initial={name: values(f"initial_{name}") for name in read("initial")},
        derived={name: values(name) for name in read("derived")},
        metadata={**read("metadata"), **{k: str(about[k]) for k in ("system", "scheme", "dirax_version")}},
    )


def with_code(sol: Solution, system: Any, scheme: Any) -> Solution:
    """The solution with its system, scheme and equation; `ValueError` where they have other fields than were saved."""
    sol.system, sol.scheme = system, sol.scheme if scheme is None else scheme
    if sol.system is None or sol.scheme is None or not sol.initial:
        return sol
    one = {name: a[0] if a.ndim == 2 else a for name, a in sol.initial.items()}
    redundant = tuple(sol.stats.get("redundant_constraints", ()))
    sol.equation = make_step_equation(
        sol.scheme, sol.system, Shape(*sol.system.sizes(one, sol.params_of_one), redundant=redundant)
    )
    made = {name: tuple(field.shape) for name, field in sol.equation.stages[0][0].fields.items()}
    saved = {name: tuple(field.shape) for name, field in sol.field_info.items()}
    if made != saved:
        raise ValueError(f"the file holds the fields {saved}, but the system and scheme that were given have {made}.")
    return sol


def check_format(dataset: "Dataset") -> None:
    """Raise `ValueError` for a Dataset that is not one of `to_dataset`, or one of a later format."""
    try:
        found = int(dataset.attrs["dirax_format"])
    except (KeyError, TypeError, ValueError):
        raise ValueError("it holds no dirax solution (the attribute dirax_format is missing)") from None
    if found > FORMAT:
        raise ValueError(f"it was written by a later dirax (format {found}, this one reads {FORMAT}): update dirax")


# ------------------------------------------------------------------------------------------------- parts of a Dataset


def _layout(sol: Solution) -> list[dict[str, Any]]:
    """Name, name in the Dataset, shape, place, dimensions and description of every field."""
    layout = []
    for name, field in sol.field_info.items():
        variable = RENAMED.get(name, f"{name}_field" if name in TAKEN else name)
        layout.append({"name": name, "variable": variable, **vars_of(field)})
    return layout


def vars_of(field: Field) -> dict[str, Any]:
    """A Field as plain data."""
    return {
        "shape": list(field.shape),
        "place": field.place,
        "dims": list(field.dims),
        "description": field.description,
    }


def _derived(sol: Solution, variables) -> dict[str, np.ndarray]:
    """Energy and constraint residual where they can be had and are not fields themselves."""
    derived = {}
    for name in DERIVED:
        if name in variables or (sol.system is None and name not in sol.derived):
            continue
        try:
            values = np.asarray(getattr(sol, name)())
        except KeyError:  # a scheme of the user's that saves no momentum, say
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


def _checked_units(sol: Solution, units: Mapping[str, Any] | None) -> dict[str, Any]:
    if units is None:
        return dict(sol.metadata.get("units", {}))
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


def _checked_names(sol: Solution, coordinates: Sequence[str] | None, count: int) -> list[str]:
    names = [str(name) for name in (sol.metadata.get("coordinates", ()) if coordinates is None else coordinates)]
    if names and len(names) != count:
        raise ValueError(f"coordinates must hold one name for each of {count} coordinates, but it holds {len(names)}: {names}.")
    return names


def _attributes(sol: Solution, layout, derived: list[str], metadata: dict[str, Any]) -> dict[str, Any]:
    try:
        installed = version("dirax")
    except PackageNotFoundError:
        installed = "unknown"
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
        "stats": json.dumps(plain(sol.stats)),
        "ok": json.dumps(bool(np.all(sol.ok))),
        "message": json.dumps({lane: text for lane, text in enumerate(sol.message) if text} if batched else sol.message),
        "batch_params": int(sol.batch_params),
        "fields": json.dumps(layout),
        "initial": json.dumps(list(sol.initial)),
        "derived": json.dumps(derived),
        "metadata": json.dumps(plain({k: v for k, v in metadata.items() if k not in ("system", "scheme", "dirax_version")})),
    }
    try:
        attributes["params"] = json.dumps(encode_params(sol.params))
    except NotPlain as value:
        attributes["params_not_stored"] = str(value)
    return attributes
