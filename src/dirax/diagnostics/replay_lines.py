"""The line of `dx.verify` on every saved number: each row is what the step from the row before it makes of that."""

from dataclasses import replace

import numpy as np

from dirax.diagnostics.flights import longest_flight
from dirax.diagnostics.replay import MOST_OPERATIONS, Again, CannotReplay, Replay, Rows, times_of
from dirax.diagnostics.replay_of_many import replayed_of_many
from dirax.diagnostics.report import NOT_CHECKED, Line
from dirax.diagnostics.rows import LARGE, row_numbers
from dirax.diagnostics.verdicts import judged, of_lane, roundoff_limit, spread
from dirax.engines.steps_in_numbers import SMALLEST
from dirax.program.evaluation.noise import Noise
from dirax.solution.solution import Solution

NAME = "steps replayed"

DISTURBANCE = 2.0**-36
"""Relative changes that show what rounding does: far above it, and small enough to do the same, only more."""

SMALL = 2.0**-47
"""Others, hardly above it: many steps make of the larger ones all that a motion can differ by before they do so of rounding."""

SAMPLED = 48
"""Steps of a run at which that is seen, besides those in doubt."""

OFTEN = 4
"""Times that a step is disturbed."""

TYPICAL = 0.9
"""The share of the sampled steps in which a number moves by no more than its scale: one in which the chart changes does not set
the scale of all."""


MOST_CUBED = 2e6
"""Cubes of their unknowns of the steps that are led to the next rows, a few tenths of a second."""

PASSES = 32
"""Times that steps in doubt are taken again from the unknowns of others that were found."""

SCATTERED, SCATTERED_TIMES = 64, 16
"""Steps that are taken again from scattered unknowns at most, and how often each."""

DOUBTED = 2000
"""Rows of which it is asked how far rounding moves them: the worst."""


def replayed(sol: Solution, tolerance: float | None) -> Line:
    """The line: the difference of a saved number from what it should be, relative to its terms, the largest of all."""
    if row_numbers(sol) > LARGE and sol.system is not None and sol.equation is not None and sol.rows > 2:
        return replayed_of_many(longest_flight(sol)[0], NAME, tolerance)
    try:
        replay = Replay.of(sol)
        if replay.too_long:
            return replayed_of_many(longest_flight(sol)[0], NAME, tolerance)
        at = replay.begun(*replay.chosen())
    except CannotReplay as reason:
        return Line(NAME, None, None, NOT_CHECKED, str(reason))
    limit = roundoff_limit(tolerance, 1)
    found = _Comparison(replay, at)
    ratio = found.ratios(limit)
    entry, number = np.unravel_index(int(np.argmax(ratio)), ratio.shape)
    lane, row = int(at.lanes[entry]), int(at.rows[entry])
    where = f"{found.name(int(number))} at t = {sol.time_of(row, lane):.6g}{of_lane(sol, lane)}"
    per_trajectory = np.zeros(sol.batch or 1)
    np.maximum.at(per_trajectory, at.lanes, np.max(ratio, axis=1))
    return judged(sol, NAME, per_trajectory, limit, f"{found.told()}; worst {where}, off by {found.missed[entry, number]:.2g}")


def moved_numbers(sol: Solution, name: str) -> np.ndarray:
    """How far the numbers (…) of a saved field move in a typical step, in units of what every operation is off; 0 where steps
    cannot be taken again."""
    shape = sol.field_info[name].shape
    try:
        replay = Replay.of(sol)
        lanes, rows = replay.chosen()
        some = _sampled(_neighbours(lanes, rows, sol.rows)[0])
        at = replay.begun(lanes[some], rows[some])
        found = _Comparison(replay, replace(at, steps=np.ones_like(at.steps)))
    except CannotReplay:
        return np.zeros(shape)
    first = found.starts[name]
    return found.usual(np.arange(len(some)))[first : first + found.sizes[name]].reshape(shape)


def _neighbours(lanes: np.ndarray, rows: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """The entries of the row after each of some rows of trajectories and before each, −1 where there is none."""
    order = lanes.astype(np.int64) * (most + 1) + rows
    following, numbers = np.append(np.diff(order) == 1, False), np.arange(len(order))
    return np.where(following, numbers + 1, -1), np.where(np.roll(following, 1), numbers - 1, -1)


def _sampled(after: np.ndarray) -> np.ndarray:
    """The entries, of which a row follows, that tell how far numbers move in a typical one."""
    several = np.flatnonzero(after >= 0)
    return several[spread(len(several), SAMPLED)]


class _Comparison:
    """What was saved of some rows beside what their steps make of it, and how far rounding may move each number.

    Arrays are (entries, numbers): an entry is a row of a trajectory, a number one of all fields, and the time.
    """

    def __init__(self, replay: Replay, at: Rows):
        self.replay, self.at = replay, at
        self.sizes = {name: int(np.prod(a.shape[2:])) for name, a in replay.saved.items()}
        self.starts = dict(zip(self.sizes, np.cumsum([0, *self.sizes.values()]).tolist(), strict=False))
        self.held = {i: self.starts[name] + place for i, (name, place) in replay.held.items()}
        self.next, self.previous = _neighbours(at.lanes, at.rows, replay.sol.rows)
        self.saved = self._saved()
        self.again = replay.again(at)
        self.expected = np.full_like(self.saved, np.nan)
        everywhere = np.arange(len(at.rows))
        self._expect(everywhere, *self._said(self.again))
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
        return np.where(np.isfinite(self.expected), np.where(np.isfinite(missed), missed, np.inf), 0.0)

    def _saved(self) -> np.ndarray:
        pieces = []
        for name in self.sizes:
            values = self.replay.saved[name]
            values = values.reshape(*values.shape[:2], -1)
            pieces.append(values[self.at.lanes, np.minimum(self.at.rows, values.shape[1] - 1)])
        return np.concatenate([*pieces, np.asarray(self.replay.sol.axis, float)[self.at.rows][:, None]], axis=1)

    def _said(self, again: Again) -> tuple[np.ndarray, np.ndarray]:
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

    def _expect(self, entries: np.ndarray, here: np.ndarray, there: np.ndarray, if_nearer: bool = False) -> None:
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
        return np.pad(~(last[:, None] & lacking), ((0, 0), (0, 1)), constant_values=True)

    def _expect_given_points(self) -> None:
        """Row 0 is what was given, and row 1 follows from it alone."""
        again = self.replay.of_given_points()
        first = np.flatnonzero(self.at.rows == 0)
        here, there = (a[self.at.lanes[first]] for a in self._said(again))
        for i, number in self.held.items():  # the row holds of the state what it was given
            here[:, number] = again.begun[self.at.lanes[first], i]
        self.expected[first] = np.where(self._exist(first), here, np.nan)
        after = self.next[first]
        self.expected[after[after >= 0]] = np.where(np.isnan(there), self.expected[after], there)[after >= 0]

    # ------------------------------------------------------------------------------------------ how far rounding moves it

    def usual(self, sampled: np.ndarray) -> np.ndarray:
        """How far each number moves in a typical row, of these entries."""
        scale = np.maximum(*self._scales_at(sampled))
        usual = np.quantile(scale, TYPICAL, axis=0)
        usual[-1] = np.max(np.abs(self.saved[:, -1])) + float(self.replay.sol.step)
        return usual

    def ratios(self, limit: float) -> np.ndarray:
        """`missed`, relative to the terms of each number: those of a typical row, and in a row in doubt its own."""
        usual = self.usual(_sampled(self.next))
        ratio = _ratio(self.missed, usual)
        doubted = self._worst(ratio, limit)
        if not len(doubted):
            return ratio
        self._try_from_neighbours(self._steps_into(doubted), usual)
        left = self._worst(_ratio(self.missed, usual), limit)
        if len(left) and len(self.again.unknowns) > 1:
            self._try_from_found(left, usual, limit)
        ratio = _ratio(self.missed, usual)
        doubted = self._worst(ratio, limit)
        if len(doubted):
            before = self.previous[doubted]
            for size in (DISTURBANCE, SMALL):
                said_before = np.where((before >= 0)[:, None], self._scales_at(np.maximum(before, 0), size)[1], 0.0)
                usual = np.maximum(usual, np.maximum(self._scales_at(doubted, size)[0], said_before))
            ratio[doubted] = _ratio(self.missed[doubted], usual)
        return ratio

    def _worst(self, ratio: np.ndarray, limit: float) -> np.ndarray:
        """The entries in doubt, at most DOUBTED."""
        most = np.max(ratio, axis=1)
        doubted = np.flatnonzero(most > limit)
        return doubted if len(doubted) <= DOUBTED else np.sort(doubted[np.argsort(-most[doubted])[:DOUBTED]])

    def _scales_at(self, entries: np.ndarray, size: float = DISTURBANCE) -> tuple[np.ndarray, np.ndarray]:
        """How far the numbers that the steps of these entries say of their rows, and of the next ones, move, relative to the
        `size` of what every operation is off."""
        at, guesses, near = self.at[entries], [u[entries] for u in self.again.unknowns], self.again.near[entries]
        said = self._said(self.replay.again(at, guesses=guesses, near=near))
        often = np.tile(np.arange(len(entries)), OFTEN)  # all disturbances at once: few entries take as long as one
        many = self.replay.again(at[often], Noise(size, 0), [u[often] for u in guesses], near[often])
        moved = []
        for one, off in zip(said, self._said(many), strict=True):
            off = np.abs(off.reshape(OFTEN, *one.shape) - one)
            moved.append(np.max(np.nan_to_num(off, posinf=0.0), axis=0) / size)
        return moved[0], moved[1]

    def _steps_into(self, entries: np.ndarray) -> np.ndarray:
        """The steps that leave these rows, and those that lead to them."""
        return np.union1d(entries, self.previous[entries][self.previous[entries] >= 0])

    def _try_from_neighbours(self, entries: np.ndarray, usual: np.ndarray) -> None:
        """Steps again from the unknowns of the steps before them, as the run had it, of those after them, and from some that lead
        to the next row: an equation may have several solutions."""
        for neighbour in (self.previous, self.next):
            one = np.where(neighbour[entries] >= 0, neighbour[entries], entries)
            two = np.where(neighbour[one] >= 0, neighbour[one], one)
            self._try_near(entries, one, two, usual)
        if len(self.again.unknowns) == 1:
            self._try_from_next_rows(entries[(self.next[entries] >= 0) & (self.at.steps[entries] == 1)])

    def _try_from_found(self, doubted: np.ndarray, usual: np.ndarray, limit: float) -> None:
        """Steps of several parts into rows in doubt again, from the unknowns of the nearest steps that lead to what was saved,
        and from scattered ones, as long as this finds others: of several solutions of a part a run keeps near one."""
        for _ in range(min(self._affordable(len(doubted)), PASSES)):
            entries, count = self._steps_into(doubted), len(doubted)
            found = self._missed_after(np.arange(len(self.at.rows)), usual) <= limit
            for nearest in _nearest(found, self.at.lanes):
                one = np.where(nearest[entries] >= 0, nearest[entries], entries)
                self._try_near(entries, one, np.where(self.previous[one] >= 0, self.previous[one], one), usual)
            doubted = self._worst(_ratio(self.missed, usual), limit)
            if len(doubted) == count:
                self._try_scattered(self._steps_into(doubted)[:SCATTERED], usual)
                doubted = self._worst(_ratio(self.missed, usual), limit)
            if not 0 < len(doubted) < count:
                return

    def _affordable(self, steps: int) -> int:
        """How often there is time for so many steps; once at least."""
        return max(1, int(MOST_OPERATIONS / self.replay.steps.operations(steps)))

    def _try_scattered(self, entries: np.ndarray, usual: np.ndarray) -> None:
        """Steps of these entries from unknowns that are anywhere among those of all of them and of their parts."""
        random, unknowns = np.random.default_rng(0), self.again.unknowns
        most = [np.max(np.abs(u[entries]), axis=0) for u in unknowns]
        if len({len(a) for a in most}) == 1:
            most = len(most) * [np.max(most, axis=0)]
        for _ in range(min(self._affordable(len(entries)), SCATTERED_TIMES)):
            self._try(entries, [2 * a * random.uniform(-1, 1, (len(entries), len(a))) for a in most], usual)

    def _try_near(self, entries: np.ndarray, one: np.ndarray, two: np.ndarray, usual: np.ndarray) -> None:
        """Steps of these entries from the unknowns of others, and from the line through those of two."""
        unknowns = self.again.unknowns
        for guesses in ([u[one] for u in unknowns], [2 * u[one] - u[two] for u in unknowns]):
            self._try(entries, guesses, usual)

    def _try(self, entries: np.ndarray, guesses: list[np.ndarray], usual: np.ndarray) -> None:
        """Steps of these entries from other guesses: what is nearer to what was saved is expected."""
        again, before = self.replay.again(self.at[entries], guesses=guesses), self._missed_after(entries, usual)
        self._expect(entries, *self._said(again), if_nearer=True)
        nearer = self._missed_after(entries, usual) < before
        for own, other in zip(self.again.unknowns, again.unknowns, strict=True):
            own[entries[nearer]] = other[nearer]
        self.again.near.put(entries[nearer], again.near[nearer])

    def _missed_after(self, entries: np.ndarray, usual: np.ndarray) -> np.ndarray:
        """By how much (entries,) the rows are missed to which these steps lead; infinite where there is none."""
        missed = np.max(_ratio(np.abs(self.saved - self.expected), usual), axis=1)
        return np.where(self.next[entries] >= 0, missed[self.next[entries]], np.inf)

    def _try_from_next_rows(self, entries: np.ndarray) -> None:
        """Steps again from unknowns that lead to the next rows, and on to those after them."""
        entries = entries[: int(MOST_CUBED / max(1, self.again.unknowns[0].shape[1]) ** 3)]
        if not len(entries):
            return
        first, _ = self.replay.held[min(self.replay.held)]
        one = self.next[entries]
        two = np.where(self.at.steps[one] == 1, self.next[one], -1)
        held = lambda rows: {
            i: np.where(rows >= 0, self.saved[rows, self.held[i]], np.nan)
            for i, (name, _) in self.replay.held.items()
            if name == first
        }
        again = self.replay.leading_to(self.at[entries], self.again.unknowns[0][entries], held(one), held(two))
        self._expect(entries, *self._said(again), if_nearer=True)


def _nearest(found: np.ndarray, lanes: np.ndarray) -> list[np.ndarray]:
    """Of each entry the nearest one of its trajectory before it that was found, and after it; −1 where there is none."""
    numbers = np.arange(len(found))
    before = np.maximum.accumulate(np.where(found, numbers, -1))
    after = np.minimum.accumulate(np.where(found, numbers, len(found))[::-1])[::-1]
    after = np.where(after < len(found), after, -1)
    return [np.where((near >= 0) & (lanes[near] == lanes), near, -1) for near in (before, after)]


def _ratio(missed: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """missed/scale; infinite where something is missed that nothing moves."""
    with np.errstate(all="ignore"):
        return np.where(missed > SMALLEST, missed / scale, 0.0)
