"""Poincaré sections: the states in which a trajectory passes through a value of one coordinate."""

from typing import Any

import numpy as np

from dirax.numerics.brackets import bracketed_roots


def crossings(t: np.ndarray, states: np.ndarray, column: int, value: float, direction: int) -> np.ndarray:
    """The states (k, n) of a trajectory `states` (rows, n) where `column` goes through `value`, upwards for `direction` 1,
    downwards for −1, both for 0. Between rows it is interpolated by the cubic through the four nearest."""
    g = states[:, column] - value
    up, down = (g[:-1] < 0) & (g[1:] >= 0), (g[:-1] > 0) & (g[1:] <= 0)
    at = np.flatnonzero((up & (direction >= 0)) | (down & (direction <= 0)))
    if len(states) < 4:
        raise ValueError(f"a section needs four saved rows or more, but there are {len(states)}: run longer, or save more often.")
    first = np.clip(at - 1, 0, len(states) - 4)
    near = first[:, None] + np.arange(4)
    time = lambda part, which: t[at[which]] + part * (t[at[which] + 1] - t[at[which]])
    through = lambda part, which: np.einsum("kj,kj->k", _weights(t[near[which]], time(part, which)), g[near[which]])
    part = bracketed_roots(through, np.zeros(len(at)), np.ones(len(at)), g[at], g[at + 1])
    x = time(part, np.arange(len(at)))
    return np.einsum("kj,kjn->kn", _weights(t[near], x), states[near])


def _weights(nodes: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Lagrange's cubics (k, 4) of nodes (k, 4) at times (k,)."""
    weights = np.ones_like(nodes)
    for j in range(4):
        for i in range(4):
            if i != j:
                weights[:, j] *= (t - nodes[:, i]) / (nodes[:, j] - nodes[:, i])
    return weights


def states_of(sol: Any) -> np.ndarray:
    """q, x and p side by side, (…, rows, n)."""
    return np.concatenate([np.asarray(sol.fields[name]) for name in ("q", "x", "p") if name in sol.fields], axis=-1)
