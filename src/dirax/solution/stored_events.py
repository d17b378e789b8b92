"""The events of a run as named arrays, for descriptions and files, and back."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from dirax.solution.events import Events

KINDS = ("events", "impacts")
"""The attributes of a Trajectory that hold events; the arrays are called events_t, impacts_q …"""

WHOLE = ("index", "direction", "lane")
"""What is a whole number of each event."""


WHOLE_ARRAYS = frozenset(f"{kind}_{part}" for kind in KINDS for part in WHOLE)
"""The names of their arrays."""


def arrays_of(kind: str, found: Events) -> dict[str, np.ndarray]:
    """The arrays of some events by the names that they have in a file; none of no events."""
    if not len(found):
        return {}
    own = {"t": found.t, **{name: getattr(found, name).astype(np.int64) for name in WHOLE}, **found.fields}
    return {f"{kind}_{name}": np.asarray(values) for name, values in own.items()}


def record_of(found: Events) -> dict[str, Any]:
    """How many there are, and the shapes of their fields, as plain data."""
    return {"count": len(found), "fields": {name: list(a.shape[1:]) for name, a in found.fields.items()}}


def shapes_in(said: Mapping[str, Any]) -> dict[str, tuple[int, ...]]:
    """The shapes of the arrays that a file must hold by its record of all kinds. Raises `ValueError` for one of another form."""
    shapes: dict[str, tuple[int, ...]] = {}
    for kind, record in said.items():
        match record:
            case {"count": int(count), "fields": dict(fields)} if kind in KINDS and count >= 0:
                sizes = {name: tuple(shape) for name, shape in fields.items()}
            case _:
                raise ValueError("its events have an unknown form")
        if not all(type(size) is int and size >= 0 for shape in sizes.values() for size in shape):
            raise ValueError("its events have an unknown form")
        if count:
            shapes |= {f"{kind}_{name}": (count,) for name in ("t", *WHOLE)}
            shapes |= {f"{kind}_{name}": (count, *shape) for name, shape in sizes.items()}
    return shapes


def events_in(kind: str, record: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> Events:
    """The events of one kind, of the arrays of a file."""
    count = record["count"]
    own = lambda name, shape, dtype: arrays[f"{kind}_{name}"] if count else np.zeros((0, *shape), dtype)
    index, direction, lane = (own(name, (), np.int64) for name in WHOLE)
    fields = {name: own(name, shape, float) for name, shape in record["fields"].items()}
    return Events(own("t", (), float), index, direction, lane, fields)
