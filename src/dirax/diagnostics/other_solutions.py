"""Other solutions of the equations of steps, which a run may have found, looked for near those of other steps."""

from dataclasses import dataclass

import numpy as np

from dirax.diagnostics.replay import MOST_OPERATIONS
from dirax.diagnostics.replay_comparison import Comparison

MOST_CUBED = 2e6
"""Cubes of their unknowns of the steps that are led to the next rows, a few tenths of a second."""

PASSES = 32
"""Times that steps in doubt are taken again from the unknowns of others that were found."""

SCATTERED, SCATTERED_TIMES = 64, 16
"""Steps that are taken again from scattered unknowns at most, and how often each."""


@dataclass(eq=False)
class OtherSolutions:
    """Those of the steps of a comparison into rows in doubt, which are missed by more than `limit` times the `usual` scales."""

    of: Comparison
    usual: np.ndarray
    limit: float

    def look_for(self, doubted: np.ndarray) -> None:
        """Expect of rows in doubt what is nearest to what was saved."""
        self._try_from_neighbours(self._steps_into(doubted))
        left = self.of.worst(self.of.ratio(self.usual), self.limit)
        if len(left) and len(self.of.again.unknowns) > 1:
            self._try_from_found(left)

    def _steps_into(self, entries: np.ndarray) -> np.ndarray:
        """The steps that leave these rows, and those that lead to them."""
        return np.union1d(entries, self.of.previous[entries][self.of.previous[entries] >= 0])

    def _try_from_neighbours(self, entries: np.ndarray) -> None:
        """Steps again from the unknowns of the steps before them, as the run had it, of those after them, and from some that lead
        to the next row: an equation may have several solutions."""
        for neighbour in (self.of.previous, self.of.next):
            one = np.where(neighbour[entries] >= 0, neighbour[entries], entries)
            two = np.where(neighbour[one] >= 0, neighbour[one], one)
            self._try_near(entries, one, two)
        if len(self.of.again.unknowns) == 1:
            self._try_from_next_rows(entries[(self.of.next[entries] >= 0) & (self.of.at.steps[entries] == 1)])

    def _try_from_found(self, doubted: np.ndarray) -> None:
        """Steps of several parts into rows in doubt again, from the unknowns of the nearest steps that lead to what was saved,
        and from scattered ones, as long as this finds others: of several solutions of a part a run keeps near one."""
        for _ in range(min(self._affordable(len(doubted)), PASSES)):
            entries, count = self._steps_into(doubted), len(doubted)
            found = self._missed_after(np.arange(len(self.of.at.rows))) <= self.limit
            for nearest in _nearest(found, self.of.at.lanes):
                one = np.where(nearest[entries] >= 0, nearest[entries], entries)
                self._try_near(entries, one, np.where(self.of.previous[one] >= 0, self.of.previous[one], one))
            doubted = self.of.worst(self.of.ratio(self.usual), self.limit)
            if len(doubted) == count:
                self._try_scattered(self._steps_into(doubted)[:SCATTERED])
                doubted = self.of.worst(self.of.ratio(self.usual), self.limit)
            if not 0 < len(doubted) < count:
                return

    def _affordable(self, steps: int) -> int:
        """How often there is time for so many steps; once at least."""
        return max(1, int(MOST_OPERATIONS / self.of.replay.steps.operations(steps)))

    def _try_scattered(self, entries: np.ndarray) -> None:
        """Steps of these entries from unknowns that are anywhere among those of all of them and of their parts."""
        random, unknowns = np.random.default_rng(0), self.of.again.unknowns
        most = [np.max(np.abs(u[entries]), axis=0) for u in unknowns]
        if len({len(a) for a in most}) == 1:
            most = len(most) * [np.max(most, axis=0)]
        for _ in range(min(self._affordable(len(entries)), SCATTERED_TIMES)):
            self._try(entries, [2 * a * random.uniform(-1, 1, (len(entries), len(a))) for a in most])

    def _try_near(self, entries: np.ndarray, one: np.ndarray, two: np.ndarray) -> None:
        """Steps of these entries from the unknowns of others, and from the line through those of two."""
        unknowns = self.of.again.unknowns
        for guesses in ([u[one] for u in unknowns], [2 * u[one] - u[two] for u in unknowns]):
            self._try(entries, guesses)

    def _try(self, entries: np.ndarray, guesses: list[np.ndarray]) -> None:
        """Steps of these entries from other guesses: what is nearer to what was saved is expected."""
        again, before = self.of.replay.again(self.of.at[entries], guesses=guesses), self._missed_after(entries)
        self.of.expect(entries, *self.of.said(again), if_nearer=True)
        nearer = self._missed_after(entries) < before
        for own, other in zip(self.of.again.unknowns, again.unknowns, strict=True):
            own[entries[nearer]] = other[nearer]
        self.of.again.near.put(entries[nearer], again.near[nearer])

    def _missed_after(self, entries: np.ndarray) -> np.ndarray:
        """By how much (entries,) the rows are missed to which these steps lead; infinite where there is none, or no solution."""
        missed, after = np.max(self.of.ratio(self.usual), axis=1), self.of.next[entries]
        solved = np.any(np.isfinite(self.of.expected[:, list(self.of.held.values())]), axis=1)
        return np.where((after >= 0) & solved[after], missed[after], np.inf)

    def _try_from_next_rows(self, entries: np.ndarray) -> None:
        """Steps again from unknowns that lead to the next rows, and on to those after them."""
        entries = entries[: int(MOST_CUBED / max(1, self.of.again.unknowns[0].shape[1]) ** 3)]
        if not len(entries):
            return
        first, _ = self.of.replay.held[min(self.of.replay.held)]
        one = self.of.next[entries]
        two = np.where(self.of.at.steps[one] == 1, self.of.next[one], -1)
        held = lambda rows: {
            i: np.where(rows >= 0, self.of.saved[rows, self.of.held[i]], np.nan)
            for i, (name, _) in self.of.replay.held.items()
            if name == first
        }
        again = self.of.replay.leading_to(self.of.at[entries], self.of.again.unknowns[0][entries], held(one), held(two))
        self.of.expect(entries, *self.of.said(again), if_nearer=True)


def _nearest(found: np.ndarray, lanes: np.ndarray) -> list[np.ndarray]:
    """Of each entry the nearest one of its trajectory before it that was found, and after it; −1 where there is none."""
    numbers = np.arange(len(found))
    before = np.maximum.accumulate(np.where(found, numbers, -1))
    after = np.minimum.accumulate(np.where(found, numbers, len(found))[::-1])[::-1]
    after = np.where(after < len(found), after, -1)
    return [np.where((near >= 0) & (lanes[near] == lanes), near, -1) for near in (before, after)]
