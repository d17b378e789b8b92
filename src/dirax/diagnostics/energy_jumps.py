"""Whether the energy has a jump between two rows: as the piece of the way from one to the other in which it changes shrinks, a
jump keeps its size, and a kink, a stiff spring or a steep wall does not. Where a last place of the time, or of another number,
changes the energy as much as that, nothing is said."""

import numpy as np

from dirax.diagnostics.report import VIOLATED, Line
from dirax.diagnostics.rows import at_rows, energy_at, over_rows, row_numbers
from dirax.diagnostics.verdicts import of_lane
from dirax.schemes.step import CLOCK
from dirax.solution.solution import Solution

SUSPECTS = 32
"""Pairs of rows that are looked at, of each trajectory or of all: those whose change differs most from its neighbours'."""

PIECES, TIMES = 8, 14
"""A way is cut into so many pieces, and the one in which the energy changes most again, so many times: to 2⁻⁴² of it."""

NOTICED = 1e-9
"""Changes below this, relative to the energy, are none."""

BESIDE = 2.0**-10
"""How far to either side of a jump, of the way, the energy is compared at one time."""

MOST_NUMBERS = 2**20
"""Numbers of the rows that are looked at."""


def energy_jump(sol: Solution, energy: np.ndarray, size: float) -> Line | None:
    """The line of a run between whose rows the energy (B, rows), with terms of this size, has jumps; None without."""
    change = np.diff(energy, axis=1)
    change, least = np.where(np.isfinite(change), change, 0.0), NOTICED * size
    if sol.system is None or not np.any(np.abs(change) > least):
        return None
    around = np.pad(change, ((0, 0), (1, 1)), mode="edge")
    excess = np.abs(change - (around[:, :-2] + around[:, 2:]) / 2) + NOTICED * np.abs(change)
    most = max(1, min(SUSPECTS // len(energy), MOST_NUMBERS // (PIECES * row_numbers(sol) * len(energy))))
    rows = np.argsort(-np.where(np.abs(change) > least, excess, -1.0), axis=1, kind="stable")[:, :most]
    change = np.abs(np.take_along_axis(change, rows, axis=1))
    found = (change > least) & _Ways(sol, rows).jump(least)
    if not np.any(found):
        return None
    lane, place = (int(i) for i in np.unravel_index(int(np.argmax(np.where(found, change, 0.0))), found.shape))
    by, row = float(change[lane, place]), int(rows[lane, place])
    way = f"the step from t = {sol.time_of(row, lane):.6g}"
    if sol.save_every > 1:
        way = f"the steps from t = {sol.time_of(row, lane):.6g} to {sol.time_of(row + 1, lane):.6g}"
    text = (
        f"jumps by {by:.3g} within {way}{of_lane(sol, lane)}, one of {np.sum(found)} such places: the Lagrangian or Hamiltonian "
        "has a jump there, which no step sees"
    )
    return Line("energy", by, least, VIOLATED, text)


class _Ways:
    """The straight ways (B, K) from some rows to the next ones, in all saved numbers."""

    def __init__(self, sol: Solution, rows: np.ndarray):
        self.sol, self.shape = sol, rows.shape
        lanes = np.arange(len(rows))[:, None]
        whole = {name: a if sol.batch is not None else np.asarray(a)[None] for name, a in sol.row_fields.items()}
        self.starts, self.ends = ({name: np.asarray(a)[lanes, rows + i] for name, a in whole.items()} for i in (0, 1))

    def energy(self, s: np.ndarray, time: np.ndarray | None = None, off: bool = False) -> np.ndarray:
        """At the shares s (B, K, n) of the ways; the time may be that at other shares; `off` by one last place of each number."""
        items = {}
        for name, start in self.starts.items():
            share = s if time is None or name not in ("t", CLOCK) else np.broadcast_to(time, s.shape)
            start, end = (a.reshape(*self.shape, 1, *a.shape[2:]) for a in (start, self.ends[name]))
            share = share.reshape(*s.shape, *(1,) * (start.ndim - 3))
            values = np.where(share < 0.5, start + share * (end - start), end - (1.0 - share) * (end - start))
            values = np.nextafter(values, np.where(end == start, np.inf, end)) if off else values
            values = values.reshape(len(s), -1, *start.shape[3:])
            items[name] = values if self.sol.batch is not None else values[0]
        return over_rows(at_rows(self.sol, energy_at), self.sol, (items,)).reshape(s.shape)

    def only(self, some: np.ndarray) -> None:
        """Go on with some of the K ways of each trajectory."""
        for ends in (self.starts, self.ends):
            ends.update({name: a[:, some] for name, a in ends.items()})
        self.shape = len(self.starts["t"]), len(some)

    def jump(self, least: float) -> np.ndarray:
        """Where (B, K) the energy has a jump of more than `least`, at one time. Ways without one are left."""
        found, which, low, width = np.zeros(self.shape, bool), np.arange(self.shape[1]), np.zeros(self.shape), 1.0
        left = half = np.zeros(self.shape)
        for i in range(TIMES):
            s = low[..., None] + width * np.linspace(0.0, 1.0, PIECES + 1)
            pieces = _changes(self.energy(s))
            low = np.take_along_axis(s, np.argmax(pieces, axis=-1)[..., None], axis=-1)[..., 0]
            left, width = np.max(pieces, axis=-1), width / PIECES
            half = left if i == TIMES // 2 else half
            some = np.flatnonzero(np.any(left > least, axis=0))
            if not len(some):
                return found
            if len(some) < len(which):
                self.only(some)
                which, low, left, half = which[some], low[:, some], left[:, some], half[:, some]
        keeps = (left > least) & (left > half / 2) & (left < 2 * half)
        middle = (low + width / 2)[..., None]
        beside = np.clip(middle + np.array([-BESIDE, BESIDE]), 0.0, 1.0)
        there = self.energy(beside, middle)
        with np.errstate(invalid="ignore"):
            rough = np.max(np.nan_to_num(np.abs(self.energy(beside, middle, off=True) - there)), axis=-1)
        found[:, which] = keeps & (_changes(there)[..., 0] > left / 2) & (rough < left / 4)
        return found


def _changes(energy: np.ndarray) -> np.ndarray:
    """How much it changes from one to the next of its last axis, 0 where it is not finite."""
    with np.errstate(invalid="ignore"):
        change = np.abs(np.diff(energy, axis=-1))
    return np.where(np.isfinite(change), change, 0.0)
