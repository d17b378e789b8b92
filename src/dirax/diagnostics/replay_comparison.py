"""Saved rows of a run beside what their steps make of them, and how far rounding may move each number."""

from functools import cached_property

import numpy as np

from dirax.diagnostics.replay import Again, Replay, Rows, times_of
from dirax.numerics.tolerances import SMALLEST
from dirax.program.evaluation.noise import Noise

DISTURBANCE = 2.0**-36
"""Relative changes that show what rounding does: far above it, and small enough to do the same, only more."""

OFTEN = 4
"""Times that a step is disturbed."""

TYPICAL = 0.9
"""The share of the sampled steps in which a number moves by no more than its scale: one in which the chart changes does not set
the scale of all."""

FAINT = 2.0**-140
"""Of the largest number of a field, what is zero: another one of it may have a unit that is so many times as large."""

DOUBTED = 2000
"""Rows of which it is asked how far rounding moves them: the worst."""


def neighbours(lanes: np.ndarray, rows: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """The entries of the row after each of some rows of trajectories and before each, −1 where there is none."""
    order = lanes.astype(np.int64) * (most + 1) + rows
    following, numbers = np.append(np.diff(order) == 1, False), np.arange(len(order))
    return np.where(following, numbers + 1, -1), np.where(np.roll(following, 1), numbers - 1, -1)


class Comparison:
    """What was saved of some rows beside what their steps make of it, and how far rounding may move each number.

    Arrays are (entries, numbers): an entry is a row of a trajectory, a number one of all fields, and the time.
    """

    def __init__(self, replay: Replay, at: Rows):
        self.replay, self.at = replay, at
        self.sizes = {name: int(np.prod(a.shape[2:])) for name, a in replay.saved.items()}
        self.starts = dict(zip(self.sizes, np.cumsum([0, *self.sizes.values()]).tolist(), strict=False))
        self.held = {i: self.starts[name] + place for i, (name, place) in replay.held.items()}
        self.next, self.previous = neighbours(at.lanes, at.rows, replay.sol.rows)
        self.divided = replay.crosses(at.lanes, at.rows)
        self.previous[self.next[self.divided & (self.next >= 0)]] = -1
        self.next[self.divided] = -1
        self.saved = self._saved()
        self.again = replay.again(at)
        self.expected = np.full_like(self.saved, np.nan)
        everywhere = np.arange(len(at.rows))
        self.expect(everywhere, *self.said(self.again))
        if replay.from_points:
            self._expect_given_points()
        self.expected[:, -1] = times_of(replay.sol)[at.rows]

    def name(self, number: int) -> str:
        """What a number is called."""
        for name, size in self.sizes.items():
            if number < size:
                return f"{name}[{number}]" if size > 1 else name
            number -= size
        return "t"

    def told(self) -> str:
        """What was computed again."""
        replay, count = self.replay, len(self.at.rows)
        whole = int(np.sum(replay.ends + 1))
        rows = f"{count} of {whole} rows" if count < whole else "each row"
        steps = f" by {replay.sol.save_every} steps" if replay.sol.save_every > 1 else ""
        failed = int(np.sum(~self.again.good & (self.next >= 0)))
        missing = f", {failed} steps could not be solved again" if failed else ""
        return f"every number of {rows} from the row before{steps}, relative to its terms{missing}"

    # ------------------------------------------------------------------------------------------ what is expected

    @property
    def missed(self) -> np.ndarray:
        """|saved − expected|, 0 where nothing is expected, infinite where a number should be and none is."""
        missed = np.abs(self.saved - self.expected)
        missed = np.where(missed <= self.faint, 0.0, missed)
        return np.where(np.isfinite(self.expected), np.where(np.isfinite(missed), missed, np.inf), 0.0)

    @cached_property
    def faint(self) -> np.ndarray:
        """Differences (numbers,) that are none in any unit: what is left of coordinates that are zero, after projections."""
        found = np.zeros(self.saved.shape[1])
        for name, size in self.sizes.items():
            place = slice(self.starts[name], self.starts[name] + size)
            found[place] = FAINT * np.max(np.abs(self.saved[:, place]), initial=0.0, where=np.isfinite(self.saved[:, place]))
        return found

    def _saved(self) -> np.ndarray:
        pieces = []
        for name in self.sizes:
            values = self.replay.saved[name]
            values = values.reshape(*values.shape[:2], -1)
            pieces.append(values[self.at.lanes, np.minimum(self.at.rows, values.shape[1] - 1)])
        return np.concatenate([*pieces, np.asarray(self.replay.sol.axis, float)[self.at.rows][:, None]], axis=1)

    def said(self, again: Again) -> tuple[np.ndarray, np.ndarray]:
        """What steps say of the rows that they leave, and of the next ones; NaN where nothing, or where it was chosen."""
        here, there = self._said_of_all(again)
        for name, size in self.sizes.items():
            if self.replay.sol.field_info[name].chosen:
                here[:, self.starts[name] :][:, :size] = there[:, self.starts[name] :][:, :size] = np.nan
        return here, there

    def _said_of_all(self, again: Again) -> tuple[np.ndarray, np.ndarray]:
        count = len(again.after)
        flat = lambda rows: np.concatenate(
            [*(rows[n].reshape(count, -1) for n in self.sizes), np.full((count, 1), np.nan)], axis=1
        )
        here = flat(again.here)
        if again.there is not None:
            there = flat(again.there)
            for i, number in self.held.items():  # known also where the step after has no solution
                there[:, number] = np.where(np.isnan(there[:, number]), again.after[:, i], there[:, number])
            return here, there
        there = np.full_like(here, np.nan)
        for i, number in self.held.items():
            there[:, number], here[:, number] = again.after[:, i], np.nan
        return here, there

    def expect(self, entries: np.ndarray, here: np.ndarray, there: np.ndarray, if_nearer: bool = False) -> None:
        """Take what the steps of some entries say of their rows and of the next ones."""
        first = np.full(len(entries), True) if not self.replay.hides else self.replay.begins & (self.at.rows[entries] == 0)
        after = self.next[entries]
        for which, rows, said in ((first, entries, here), (after >= 0, after, there)):
            rows, said = rows[which], said[which]
            said = np.where(self._exist(rows), said, np.nan)
            old = self.expected[rows]
            if if_nearer:
                saved = self.saved[rows]
                said = np.where(np.abs(said - saved) < np.nan_to_num(np.abs(old - saved), nan=np.inf), said, old)
            self.expected[rows] = np.where(np.isnan(said), old, said)

    def _exist(self, entries: np.ndarray) -> np.ndarray:
        """Which numbers the rows have: those of steps are not in the last one of a trajectory, and in that of a failed one no
        step was solved that could say more than the state."""
        sol, lanes = self.replay.sol, self.at.lanes[entries]
        last, ok = self.at.rows[entries] >= self.replay.ends[lanes], np.atleast_1d(sol.ok)[lanes]
        of_step = [sol.field_info[name].place == "step" for name, size in self.sizes.items() for _ in range(size)]
        said = np.isin(np.arange(self.saved.shape[1] - 1), list(self.held.values()), invert=True)
        lacking = np.where(ok[:, None], np.array(of_step)[None], said)
        parted = self.divided[entries][:, None] & said  # of a step that a wall divides the state that it leaves is known
        return np.pad(~(last[:, None] & lacking | parted), ((0, 0), (0, 1)), constant_values=True)

    def _expect_given_points(self) -> None:
        """Row 0 is what was given, and row 1 follows from it alone."""
        again = self.replay.of_given_points()
        first = np.flatnonzero(self.at.rows == 0)
        here, there = (a[self.at.lanes[first]] for a in self.said(again))
        for i, number in self.held.items():  # the row holds of the state what it was given
            here[:, number] = again.begun[self.at.lanes[first], i]
        self.expected[first] = np.where(self._exist(first), here, np.nan)
        after = self.next[first]
        self.expected[after[after >= 0]] = np.where(np.isnan(there), self.expected[after], there)[after >= 0]

    # ------------------------------------------------------------------------------------------ how far rounding moves it

    def ratio(self, scale: np.ndarray) -> np.ndarray:
        """`missed`, relative to a scale of each number."""
        return ratio_to(self.missed, scale)

    def usual(self, sampled: np.ndarray) -> np.ndarray:
        """How far each number moves in a typical row, of these entries."""
        scale = np.maximum(*self.scales_at(sampled))
        usual = np.quantile(scale, TYPICAL, axis=0)
        usual[-1] = np.max(np.abs(self.saved[:, -1])) + float(self.replay.sol.step)
        return usual

    def worst(self, ratio: np.ndarray, limit: float) -> np.ndarray:
        """The entries in doubt, at most DOUBTED."""
        most = np.max(ratio, axis=1)
        doubted = np.flatnonzero(most > limit)
        return doubted if len(doubted) <= DOUBTED else np.sort(doubted[np.argsort(-most[doubted])[:DOUBTED]])

    def scales_at(self, entries: np.ndarray, size: float = DISTURBANCE) -> tuple[np.ndarray, np.ndarray]:
        """How far the numbers that the steps of these entries say of their rows, and of the next ones, move, relative to the
        `size` of what every operation is off."""
        at, guesses, near = self.at[entries], [u[entries] for u in self.again.unknowns], self.again.near[entries]
        said = self.said(self.replay.again(at, guesses=guesses, near=near))
        often = np.tile(np.arange(len(entries)), OFTEN)  # all disturbances at once: few entries take as long as one
        many = self.replay.again(at[often], Noise(size, 0), [u[often] for u in guesses], near[often])
        moved = []
        for one, off in zip(said, self.said(many), strict=True):
            off = np.abs(off.reshape(OFTEN, *one.shape) - one)
            moved.append(np.max(np.nan_to_num(off, posinf=0.0), axis=0) / size)
        return moved[0], moved[1]


def ratio_to(missed: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """missed/scale; infinite where something is missed that nothing moves."""
    with np.errstate(all="ignore"):
        return np.where(missed > SMALLEST, missed / scale, 0.0)
