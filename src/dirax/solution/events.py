"""Events of a run: where a function of its motion was zero, or where it hit a wall."""

from typing import Any

import numpy as np

from dirax.program.user_functions import is_traced

WALLS_WORK = "walls_work"
"""The entry of `stats` that says whether a wall of the run changes the energy."""


class Events:
    """What happened between the rows of a run, trajectory after trajectory, each in the order of time.

    `t` (K,) the times; `index` (K,) which of the `events=` it was; `direction` (K,) +1 where its function rose through zero and
    −1 where it fell; `lane` (K,) the trajectory, in a batch; and by name the fields of nodes at these times, q, p, x: (K, n).
    `events[i]`, with a number, an array of numbers or of booleans, or a slice, are some of them; `events.of(1)` those of
    `events=[…][1]`.
    """

    def __init__(self, t: Any, index: Any, direction: Any, lane: Any, fields: dict[str, Any]):
        arrays = (t, index, direction, lane)
        self.t, self.index, self.direction, self.lane = arrays if is_traced(arrays) else map(np.asarray, arrays)
        self.fields = fields

    def __getattr__(self, name: str):
        fields = self.__dict__.get("fields", {})
        if name in fields:
            return fields[name]
        raise AttributeError(f"these events have no {name!r}; they hold t, index, direction, lane, {', '.join(fields)}.")

    def __len__(self) -> int:
        return len(self.t)

    def __getitem__(self, which: Any) -> "Events":
        which = np.atleast_1d(np.arange(len(self))[which])
        fields = {name: a[which] for name, a in self.fields.items()}
        return type(self)(self.t[which], self.index[which], self.direction[which], self.lane[which], fields)

    def of(self, index: int) -> "Events":
        """Those of one of the `events=`."""
        return self[self.index == index]

    def of_lanes(self, lanes: Any) -> "Events":
        """Those of some trajectories of a batch, numbered anew."""
        parts = [np.flatnonzero(self.lane == lane) for lane in np.atleast_1d(lanes)]
        found = self[np.concatenate([*parts, np.zeros(0, int)]).astype(int)]
        found.lane = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
        return found

    def __repr__(self) -> str:
        if is_traced(self.t):
            return f"Events({len(self)} at most, traced)"
        stretch = f", from t = {np.min(self.t):.6g} to {np.max(self.t):.6g}" if len(self) else ""
        return f"Events({len(self)}{stretch})"


def joined(parts: list[Events]) -> Events:
    """All of them, sorted by trajectory and time, with the fields that all have."""
    if len(parts) == 1:
        return parts[0]
    t, index, direction, lane = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("t", "index", "direction", "lane")
    )
    names = [name for name in parts[0].fields if all(name in part.fields for part in parts)]
    fields = {name: np.concatenate([part.fields[name] for part in parts]) for name in names}
    whole = Events(t, index, direction, lane, fields)
    return whole[np.lexsort((t, lane))]
