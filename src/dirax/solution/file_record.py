"""What a file says about its solution, checked before any array of numbers is read."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite
from typing import Any

import numpy as np

from dirax.schemes.step import COMPOSED
from dirax.solution.description import DERIVED, FORMAT, type_of
from dirax.solution.saving import MOVED
from dirax.solution.stored import TYPES, Unreadable
from dirax.solution.stored_events import shapes_in

Kinds = Mapping[str, tuple[tuple[int, ...], np.dtype]]


@dataclass(frozen=True)
class FileRecord:
    """The attributes of a file as plain values; `params` as text, None where none were stored."""

    batched: bool
    step: float
    save_every: int
    batch_params: bool
    ok: bool
    message: Any
    fields: list[dict[str, Any]]
    initial: list[str]
    derived: list[str]
    events: dict[str, Any]
    stats: dict[str, Any]
    metadata: dict[str, Any]
    checksums: dict[str, int]
    scheme: Any
    params: str | None


def file_record(about: Mapping[str, Any], kinds: Kinds) -> FileRecord:
    """The checked description of a file with these attributes and arrays of these shapes and types.

    Raises `Unreadable` in words for a file that holds no solution, or one whose parts contradict each other; any other
    exception means that it is malformed.
    """
    _check_format(about.get("dirax_format"))
    batched = "ok" in kinds
    read = lambda name, kind: _of_kind(name, json.loads(about[name]), kind)
    record = FileRecord(
        batched=batched,
        step=_of_kind("step", about["step"], float, int),
        save_every=_of_kind("save_every", about["save_every"], int),
        batch_params=bool(_of_kind("batch_params", about["batch_params"], int, bool)),
        ok=read("ok", bool),
        message=read("message", dict if batched else str),
        fields=read("fields", list),
        initial=_names("initial", read("initial", list)),
        derived=_names("derived", read("derived", list)),
        events=read("events", dict) if "events" in about else {},
        stats=read("stats", dict),
        metadata={**read("metadata", dict), **{k: str(about[k]) for k in ("system", "scheme", "dirax_version")}},
        checksums=read("checksums", dict),
        scheme=json.loads(about["scheme_settings"]),
        params=_of_kind("params", about["params"], str) if "params" in about else None,
    )
    if about["batch_params"] not in (0, 1) or (record.batch_params and not batched):
        raise Unreadable(f"it says that batch_params is {about['batch_params']}, which dirax does not write there")
    _check_numbers(record)
    for entry in record.fields:
        _check_entry(entry)
    _check_labels(record)
    _check_shapes(record, kinds)
    return record


def _check_format(found: Any) -> None:
    if type(found) is not int:
        raise Unreadable("it holds no dirax solution (the attribute dirax_format is missing or no whole number)")
    if found > FORMAT:
        raise Unreadable(f"it was written by a later dirax (format {found}, this one reads {FORMAT}): update dirax")
    if found < 1:
        raise Unreadable(f"it says that it has the format {found}, which there never was")


def _of_kind(name: str, value: Any, *kinds: type) -> Any:
    if type(value) not in kinds:
        raise Unreadable(f"its attribute {name} is {value!r:.60}, which dirax does not write")
    return value


def _names(name: str, values: list) -> list[str]:
    if not all(type(value) is str for value in values) or len(set(values)) != len(values):
        raise Unreadable(f"its attribute {name} is {values!r:.60}, which dirax does not write")
    return values


def _check_numbers(record: FileRecord) -> None:
    if not (isfinite(record.step) and record.step > 0):
        raise Unreadable(f"its step is {record.step}, not a positive number")
    if not 1 <= record.save_every < 2**63:
        raise Unreadable(f"it says that every {record.save_every:.6g}th step was saved")
    if record.batched and not all(type(text) is str for text in record.message.values()):
        raise Unreadable("its messages are no texts")
    if not set(record.derived) <= set(DERIVED):
        raise Unreadable(f"it holds {', '.join(record.derived)} as derived quantities, of which dirax has {', '.join(DERIVED)}")


def _check_entry(entry: Any) -> None:
    """A field: its name, the name of its array, shape, place, names of axes, description, how it is composed, if it is chosen."""
    text = lambda key: type(entry[key]) is str
    sizes = lambda values: isinstance(values, list) and all(type(size) is int and size >= 0 for size in values)
    named = lambda values: isinstance(values, list) and all(type(name) is str for name in values)
    if not (
        isinstance(entry, dict)
        and all(map(text, ("name", "variable", "description")))
        and sizes(entry["shape"])
        and entry["place"] in ("node", "step")
        and named(entry["dims"])
        and entry.get("composed", "") in ("", *COMPOSED)
        and type(entry.get("chosen", False)) is bool
        and entry.get("dtype", "float64") in TYPES
    ):
        raise Unreadable("it describes a field as dirax does not")


def _check_labels(record: FileRecord) -> None:
    """Names of coordinates and units, which a user may have given."""
    labels, units = record.metadata.get("coordinates", []), record.metadata.get("units", {})
    if not isinstance(labels, list) or not all(type(name) is str for name in labels):
        raise Unreadable("its names of coordinates are no texts")
    texts = lambda unit: type(unit) is str or (isinstance(unit, list) and all(type(part) is str for part in unit))
    if not isinstance(units, dict) or not all(map(texts, units.values())):
        raise Unreadable("its units are no texts")


def _check_shapes(record: FileRecord, kinds: Kinds) -> None:
    """Every array that the description names has the shape that it says, and there is no other."""
    if "time" not in kinds or len(kinds["time"][0]) != 1 or kinds["time"][0][0] < 1:
        raise Unreadable("its variable time is missing or has no rows")
    rows = kinds["time"][0][0]
    lead = kinds["ok"][0] if record.batched else ()
    if len(lead) != int(record.batched):
        raise Unreadable(f"its variable ok has the shape {lead}")
    wanted: dict[str, Any] = {"time": (rows,), **({"ok": lead} if record.batched else {})}
    for entry in record.fields:
        if entry["variable"] in wanted:
            raise Unreadable(f"it describes {entry['variable']:.60} twice")
        wanted[entry["variable"]] = (*lead, rows - (entry["place"] == "step"), *entry["shape"])
    if any(entry["place"] == "step" for entry in record.fields):
        wanted["interval"] = (rows - 1,)
    for name, shape in wanted.items():
        if name in kinds and kinds[name][0] != shape:
            raise Unreadable(f"its variable {name:.60} has the shape {kinds[name][0]} instead of {shape}")
    for name in record.derived:
        if name in kinds and kinds[name][0][: len(lead) + 1] != (*lead, rows):
            raise Unreadable(f"its variable {name} has the shape {kinds[name][0]}, not one entry a row")
    starts = [f"initial_{name}" for name in record.initial]
    for name in starts:
        if name in kinds and kinds[name][0][:-1] not in ((), lead):
            raise Unreadable(f"its variable {name:.60} has the shape {kinds[name][0]}")
    for name, shape in (of_events := shapes_in(record.events)).items():
        if name in kinds and kinds[name][0] != shape:
            raise Unreadable(f"its variable {name:.60} has the shape {kinds[name][0]} instead of {shape}")
    known = {*wanted, *record.derived, *starts, *of_events}
    for name in known & kinds.keys():
        if kinds[name][1].name != (dtype := type_of(name, record.fields)):
            raise Unreadable(f"its variable {name:.60} holds {kinds[name][1]}, and dirax writes {dtype} there")
    for name in kinds:
        if name not in known and not name.startswith(MOVED):
            raise Unreadable(f"its variable {name:.60} is not one that dirax wrote")
    for name in (*wanted, *record.derived, *starts, *of_events):
        if name not in kinds:
            raise Unreadable(f"its variable {name:.60} is missing: the file is incomplete")
