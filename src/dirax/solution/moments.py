"""The fields of a run at any time: `sol.at`."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from dirax.program.user_functions import is_traced
from dirax.solution.dense import Dense
from dirax.solution.dense_traced import TracedDense
from dirax.solution.selection import rows_of
from dirax.solution.stored_rows import StoredRows
from dirax.solution.trajectory import Trajectory


class Moments:
    """The fields of a run at times that were asked for: `t`, and by name those that the run saves, q, p, x, multipliers …

    Shapes: those of a row for one time, (T, …) for an array of times, (B, …) and (B, T, …) for a batch. A field of steps is that
    of the step in which the time lies.
    """

    def __init__(self, t: Any, fields: dict[str, Any]):
        self.t, self.fields = t, fields

    def __getattr__(self, name: str):
        fields = self.__dict__.get("fields", {})
        if name in fields:
            return fields[name]
        raise AttributeError(f"these moments have no {name!r}; they hold {', '.join(fields)}.")

    def __repr__(self) -> str:
        shapes = ", ".join(f"{name}{list(np.shape(values))}" for name, values in self.fields.items())
        return f"Moments(t{list(np.shape(self.t))}, {shapes})"


def at(sol: Trajectory, t: Any) -> Moments:
    """The fields of the run at the time t, or at an array of times (T,), each trajectory of a batch at its own with (B, T).

    Between rows the polynomial of a collocation method is taken, of which the error is O(h^(s+1)) with s stages; the cubic
    through positions and velocities for schemes of second order on Lagrangians; for the others, and where rows are
    missing between those that `save_every=` keeps, a step of a part of the length, which has the order of the scheme. At saved
    rows the run's own numbers come out, to roundoff.
    The first call finds the steps that it needs once more; later calls know them. With derivatives under `jax.grad`, `jit` and
    `vmap`, where values are not checked.

    Raises `ValueError` for times outside of the run and NaN, `TypeError` for what is no array of numbers.
    """
    if sol.lifted is not None:
        return _lifted_at(sol, t)
    if is_traced(t, sol.t, sol.fields, sol.step, sol.params):
        times = jnp.asarray(t, float)
        if times.ndim > 1:
            raise ValueError(
                f"under jax.grad, jit and vmap sol.at takes one time or times (T,), but shape {times.shape} was given."
            )
        found = TracedDense(sol).at(jnp.atleast_1d(times))
        one = (lambda a: a[0]) if sol.batch is None else (lambda a: a[:, 0])
        return Moments(times, found if times.ndim else {name: one(a) for name, a in found.items()})
    times = _times(t, sol.batch)
    if any(isinstance(a, StoredRows) for a in sol.fields.values()) and not sol.has_own_times:
        sol = _around(sol, times)
    if "_dense" not in sol.__dict__:
        sol.__dict__["_dense"] = Dense(sol)
    found = sol.__dict__["_dense"].at(np.atleast_1d(times))
    if not times.ndim:
        found = {name: a[:, 0] for name, a in found.items()}
    return Moments(times, found if sol.batch is not None else {name: a[0] for name, a in found.items()})


def _lifted_at(sol: Trajectory, t: Any) -> Moments:
    """The fields at these times of a run that was reconstructed, from those of the one before."""
    before = sol.lifted.before
    found = at(before, t)
    lead = np.shape(found.t) if before.batch is None else (before.batch, *np.shape(found.t)[-1:])
    kept = {name: a for name, a in found.fields.items() if name in sol.fields}
    return Moments(found.t, kept | sol.lifted.at(found.fields, lead))


def _around(sol: Trajectory, times: np.ndarray) -> Trajectory:
    """The rows that these times lie between, with one before them, read from the disk."""
    first, last = np.searchsorted(np.asarray(sol.axis), [np.nanmin(times), np.nanmax(times)])
    return rows_of(sol, range(max(0, int(first) - 2), min(int(last) + 2, sol.rows)))


def _times(t: Any, batch: int | None) -> np.ndarray:
    try:
        times = np.asarray(t)
        if times.dtype.kind not in "fiu":
            raise TypeError
    except (TypeError, ValueError):
        raise TypeError(f"sol.at takes a time or an array of times, but {t!r:.80} was given.") from None
    if times.ndim > 2 or (times.ndim == 2 and times.shape[0] != batch):
        expected = "a number or an array (T,)" + (f" or ({batch}, T), of a batch of {batch}" if batch is not None else "")
        raise ValueError(f"sol.at takes times as {expected}, but an array of shape {times.shape} was given.")
    return times.astype(float)
