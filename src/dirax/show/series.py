"""The quantities that a report plots: of every run tables of columns, thinned so that no extremum is lost."""

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from dirax.show.arrays import DIGITS, Arrays, rounded
from dirax.solution.solution import Solution

ROWS = 10_001
"""Most rows of one table; of a longer run the smallest and the largest value in each of many pieces of time are kept."""

EXACT_BYTES = 320_000
"""Columns of full precision that a page has room for; others print six digits."""

LANES = 12
"""Most trajectories of a batch that are shown."""


@dataclass(frozen=True)
class Table:
    """Columns of one run that belong together: `values` (rows, c) at the first len(values) saved times."""

    name: str
    columns: tuple[str, ...]
    values: np.ndarray
    exact: bool = False
    """Whether every digit goes into the page: for what is nearly constant, and looked at by its change."""


@dataclass(frozen=True)
class Run:
    """One trajectory of the page: the solution (None for a closed form), its lane, and what is shown of it."""

    label: str
    t: np.ndarray
    rows: dict[str, np.ndarray]
    params: Any
    tables: dict[str, Table]
    group: int
    """Number of the solution that it belongs to."""
    ghost: bool = False


def coordinate_names(sol: Solution, count: int, letter: str = "q") -> tuple[str, ...]:
    """Names of coordinates, from the metadata where there are as many."""
    names = tuple(map(str, sol.metadata.get("coordinates", ())))
    return names if len(names) == count else tuple(f"{letter}{i}" for i in range(count))


def runs_of(sol: Solution, label: str, group: int, symmetries: Mapping[str, Callable] | None, measured: bool = True) -> list[Run]:
    """The runs of a solution: one, or the first of a batch; with `measured=False` without tables."""
    if sol.batch is None:
        lanes, labels = [None], [label]
    else:
        lanes = list(range(min(sol.batch, LANES)))
        labels = [f"{label} {lane}".strip() for lane in lanes]
    quantities = _measured(sol, symmetries) if measured else {}
    runs = []
    for lane, name in zip(lanes, labels, strict=True):
        of_lane = lambda a, lane=lane: np.asarray(a) if lane is None else np.asarray(a)[lane]
        nodes = {k: of_lane(a) for k, a in sol.fields.items() if sol.field_info[k].place == "node"}
        params = sol.params
        if sol.batch_params and params is not None:
            params = jax.tree.map(lambda leaf, lane=lane: leaf[lane], params)
        tables = {k: Table(k, columns, of_lane(values), exact) for k, (columns, values, exact) in quantities.items()}
        t = sol.times[lane or 0]
        rows = {**nodes, "t": t}
        runs.append(Run(name, t, rows, params, tables, group, ghost=bool(lane)))
    return runs


def _measured(sol: Solution, symmetries: Mapping[str, Callable] | None) -> dict[str, tuple]:
    """name → (columns, values (…, rows, c), exact)."""
    found: dict[str, tuple] = {}
    with contextlib.suppress(ValueError):  # loaded without its system
        found["energy"] = (("E",), np.asarray(sol.energy())[..., None], True)
    if symmetries and "p" in sol.fields:
        momenta = [np.asarray(sol.momentum_map(generator)) for generator in symmetries.values()]
        found["momenta"] = (tuple(symmetries), np.stack(momenta, axis=-1), True)
    with contextlib.suppress(ValueError):
        residual = np.asarray(sol.constraint_residual())
        if residual.shape[-1]:
            columns = tuple(f"r{i + 1}" for i in range(residual.shape[-1]))
            found["constraint"] = (columns, residual, False)
    state, columns = [], []
    for name, letter in (("q", "q"), ("x", "x"), ("p", "p")):
        if name in sol.fields and np.ndim(sol.fields[name]) - (sol.batch is not None) == 2:
            values = np.asarray(sol.fields[name])
            names = coordinate_names(sol, values.shape[-1], letter)
            columns += [f"p_{n}" if name == "p" else n for n in names]
            state.append(values)
    if state:
        found["state"] = (tuple(columns), np.concatenate(state, axis=-1), False)
    for name, values in sol.fields.items():
        values = np.asarray(values)
        if name not in ("q", "x", "p", "constraint") and values.size:
            flat = values.reshape(*values.shape[: 1 + (sol.batch is not None)], -1)
            count = flat.shape[-1]
            label = {"multipliers": "λ"}.get(name, name)
            columns = (label,) if count == 1 else tuple(f"{label}{i + 1}" for i in range(count))
            if count <= 12:
                found[name] = (columns, flat, False)
    return found


def kept_rows(values: np.ndarray, most: int) -> np.ndarray | None:
    """The rows (k,) to keep of values (rows, c), None for all: the ends, and of each column the smallest and the largest of
    every piece of time."""
    rows, columns = values.shape
    if rows <= most:
        return None
    pieces = max(64, most // (2 * columns))
    edges = np.linspace(0, rows, pieces + 1).astype(int)[:-1]
    kept = [np.array([0, rows - 1])]
    places = np.searchsorted(edges, np.arange(rows), side="right") - 1
    for column in values.T:
        for worst, at in ((np.fmin, np.inf), (np.fmax, -np.inf)):
            extreme = worst.reduceat(np.where(np.isnan(column), at, column), edges)
            hits = np.flatnonzero(column == extreme[places])
            kept.append(hits[np.unique(places[hits], return_index=True)[1]])  # the first of each piece
    return np.unique(np.concatenate(kept))


def described(run: Run, arrays: Arrays, budget: int, most: int = ROWS) -> dict[str, Any]:
    """The tables of a run for the page, of `most` rows; `budget`: bytes of full precision that this run may take."""
    t = np.asarray(run.t, float)
    tables = {}
    for table in sorted(run.tables.values(), key=lambda table: not table.exact):
        kept = kept_rows(table.values, most)
        values = table.values if kept is None else table.values[kept]
        exact = table.exact or 8 * values.size <= budget
        budget -= 8 * values.size * exact
        kind = "f8" if exact else "f4"
        tables[table.name] = {
            "columns": list(table.columns),
            "rows": None if kept is None else arrays.add(kept, "u4"),
            "count": len(values),
            "digits": 15 if table.exact else 9 if exact else DIGITS,
            "values": [arrays.add(column if exact else rounded(column), kind) for column in values.T],
        }
    return {"label": run.label, "group": run.group, "ghost": run.ghost, "t": _times(t, arrays), "tables": tables}


def _times(t: np.ndarray, arrays: Arrays) -> dict[str, Any]:
    """The times of the saved rows: by their step where that gives them to the last bit."""
    step = (t[-1] - t[0]) / max(1, len(t) - 1)
    for each in (step, float(f"{step:.12g}")):
        if np.array_equal(t[0] + each * np.arange(len(t)), t):
            return {"start": float(t[0]), "step": float(each), "count": len(t)}
    return arrays.add(t)


def worst_time(run: Run, table: str, column: int | None, change: bool) -> float | None:
    """When a quantity is farthest from where it began (`change`), or from zero."""
    if table not in run.tables:
        return None
    values = run.tables[table].values
    values = values if column is None else values[:, [column]]
    size = np.abs(values - values[:1] if change else values).max(axis=1)
    if not np.any(np.isfinite(size)):
        return None
    return float(run.t[int(np.nanargmax(size))])
