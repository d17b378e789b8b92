"""Every saved row of a run once more, from the row before it: what it should hold, and how far rounding may move that."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dirax.diagnostics.rows import over_rows, times_at
from dirax.engines.steps_in_numbers import Attempts, Near, StepsInNumbers
from dirax.program.evaluation.noise import Noise
from dirax.program.graph import GraphTooLarge
from dirax.program.interpreter import UnsupportedPrimitive
from dirax.program.memo import Same
from dirax.solution.solution import Solution
from dirax.solution.trajectory import ROWS_BEFORE, SavedRow, last_rows

MOST_OPERATIONS = 4e7
"""Scalar operations of the steps that are taken again, a few tenths of a second: of longer runs as many rows, evenly spread."""

MOST = 10_001
"""Rows that are taken again at most: those of 10 000 steps."""

SHORT, OF_SHORT = 500, 8e8
"""Rows of a short run, whose steps may have so many operations."""

FEWEST, CALL = 16, 2048
"""Rows that are taken again at least, and states of which a function in NumPy takes as long as of one."""

LONGEST = 5 * MOST_OPERATIONS
"""Operations from which on these are too long."""

APART = 16
"""Rows from one to the next that is asked where its step begins."""


def steps_before(sol: Solution) -> np.ndarray:
    """The number of the step that each row is at."""
    counts, last = np.arange(sol.rows, dtype=float) * sol.save_every, sol.rows - 1
    if "q0" in sol.initial:
        counts[1:] = 1.0 + np.arange(last, dtype=float) * sol.save_every
    left = np.rint((float(sol.axis[last]) - float(sol.axis[last - 1])) / float(sol.step)) if last else 0.0
    if last and 1 <= left <= counts[last] - counts[last - 1]:
        counts[last] = counts[last - 1] + left
    return counts


def times_of(sol: Solution) -> np.ndarray:
    """The times that the rows should have."""
    return float(sol.axis[0]) + steps_before(sol) * float(sol.step)


class CannotReplay(Exception):
    """Why the rows of a run are not computed again."""


@dataclass
class Again:
    """Rows computed again: `here` what the steps leaving the rows say of these, `after` the states that they lead to, `there`
    what the steps leaving those say of the next rows, where a row does not hold its whole state."""

    here: dict[str, np.ndarray]
    after: np.ndarray
    good: np.ndarray
    there: dict[str, np.ndarray] | None
    unknowns: list[np.ndarray]
    begun: np.ndarray
    """The states that the steps left."""
    near: Near
    """By what the first of the steps from each row were solved."""


@dataclass
class Rows:
    """Some rows of some trajectories, as many entries as there are of both: where a step begins."""

    lanes: np.ndarray
    rows: np.ndarray
    states: np.ndarray
    guesses: list[np.ndarray]
    t: np.ndarray
    steps: np.ndarray
    """Steps to the next saved row; 1 for the last one of a trajectory."""
    params: np.ndarray

    def __getitem__(self, some: np.ndarray) -> "Rows":
        guesses = [guess[some] for guess in self.guesses]
        return Rows(
            self.lanes[some], self.rows[some], self.states[some], guesses, self.t[some], self.steps[some], self.params[some]
        )


@dataclass(eq=False)
class Replay:
    """The rows of a run, each from the one before. Saved arrays are taken as (B, rows, …) throughout."""

    sol: Solution
    steps: StepsInNumbers
    held: dict[int, tuple[str, int]] = field(init=False)
    """The entries of a state that a row holds as they are: in which field, and where in it."""

    def __post_init__(self):
        first, held = self.steps.program.equations[self.steps.program.stages[0][0]], {}
        for name, nodes in first.rows.items():
            about = self.sol.field_info[name]
            if about.place == "node" and about.rule == "first":
                held |= {int(node): (name, place) for place, node in enumerate(nodes.ravel())}
        self.held = {i: held[node] for i, node in enumerate(first.state) if node in held}

    @classmethod
    def of(cls, sol: Solution) -> "Replay":
        """Raises `CannotReplay`."""
        if sol.lacks:
            raise CannotReplay(sol.lacks)
        if lacking := sol.equation.fields.keys() - sol.fields.keys():
            raise CannotReplay(f"the rows hold no {', '.join(sorted(lacking))}: verify what this was reconstructed from")
        try:
            made = cls(sol, StepsInNumbers.of(sol.equation, sol.given_params, sol.batch_params))
        except (UnsupportedPrimitive, GraphTooLarge) as error:
            raise CannotReplay(f"the step is no scalar program: {error}") from None
        if not np.any(made.ends >= 1):
            raise CannotReplay("no step was computed")
        return made

    # ------------------------------------------------------------------------------------------ what was saved

    @cached_property
    def saved(self) -> dict[str, np.ndarray]:
        """The fields with an axis of the batch, float64."""
        one = self.sol.batch is None
        return {name: np.asarray(a, float)[None] if one else np.asarray(a, float) for name, a in self.sol.fields.items()}

    @cached_property
    def nodes(self) -> list[str]:
        """The names of the fields of nodes."""
        return [name for name, about in self.sol.field_info.items() if about.place == "node"]

    @cached_property
    def ends(self) -> np.ndarray:
        """The last row (B,) that each trajectory reached, −1 where there is none."""
        return last_rows([self.saved[name] for name in self.nodes])

    @cached_property
    def counts(self) -> np.ndarray:
        """The number of the step that each row is at."""
        return steps_before(self.sol)

    @property
    def from_points(self) -> bool:
        """Whether rows 0 and 1 are the points that were given."""
        return "q0" in self.sol.initial

    @property
    def begins(self) -> bool:
        """Whether the run began at its first row, and does not go on from one that was left out."""
        return ROWS_BEFORE not in self.sol.stats

    @property
    def hides(self) -> bool:
        """Whether a state has entries that no row holds."""
        return len(self.held) < len(self.steps.program.equations[self.steps.program.stages[0][0]].state)

    # ------------------------------------------------------------------------------------------ where steps begin

    @property
    def _steps_a_row(self) -> float:
        return max(1.0, float(np.mean(np.diff(self.counts))))

    @property
    def too_long(self) -> bool:
        """Whether there is no time for a few rows, with all the steps between them."""
        return self._steps_a_row > max(1.0, LONGEST / self.steps.operations(FEWEST, CALL))

    def chosen(self) -> tuple[np.ndarray, np.ndarray]:
        """(trajectory, row) of the rows whose steps are taken again: all that were reached, but for those that do not hold their
        states beside steps which walls divide, or as many as there is time for. Raises `CannotReplay` where there are none."""
        lanes, rows = np.nonzero((np.arange(self.sol.rows)[None] <= self.ends[:, None]) & ~self.beside_walls)
        if not len(rows):
            raise CannotReplay("walls divide every step")
        operations = OF_SHORT if len(rows) <= SHORT else MOST_OPERATIONS
        most = min(MOST, max(FEWEST, int(operations / self.steps.operations() / self._steps_a_row)))
        if len(rows) > most:
            some = np.unique(np.linspace(0, len(rows) - 2, most // 2).astype(int))
            some = np.union1d(some, some + 1)  # with their successors
            lanes, rows = lanes[some], rows[some]
        return lanes, rows

    @property
    def beside_walls(self) -> np.ndarray:
        """The rows (B, rows) before and after a step that a wall divides where rows do not hold their states: their momenta and
        multipliers are of parts of it."""
        beside = np.zeros((self.sol.batch or 1, self.sol.rows), bool)
        if self.hides:
            beside[:, :-1] |= self.sol.divided
            beside[:, 1:] |= self.sol.divided
        return beside

    def crosses(self, lanes: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Whether walls divide the steps that leave these rows."""
        return np.pad(self.sol.divided, ((0, 0), (0, 1)))[lanes, rows]

    def begun(self, lanes: np.ndarray, rows: np.ndarray) -> Rows:
        """Where the steps that leave these rows, in order, begin. Raises `CannotReplay` where the rows do not say it.

        Rows that hold their states are asked for first guesses now and then; between them these are interpolated.
        """
        ends = np.append(np.diff(lanes) != 0, True)
        some = (np.arange(len(rows)) % APART == 0) | ends | np.roll(ends, 1)
        if self.hides or len(rows) < 4 * APART:
            return self.resumed(lanes, rows)
        few = self.resumed(lanes[some], rows[some])
        made = self.steps.step(few.states, few.guesses, few.t, float(self.sol.step), few.params)
        place = lanes.astype(float) * self.sol.rows + rows
        good = np.flatnonzero(some)[made.good]
        if not len(good):
            return self.resumed(lanes, rows)
        between = lambda u: np.stack([np.interp(place, place[good], column) for column in u[made.good].T], axis=1)
        guesses = [between(u) if u.shape[1] else np.zeros((len(rows), 0)) for u in made.unknowns]
        states = np.zeros((len(rows), self.state_size))
        self._hold(states, lanes, rows)
        return Rows(lanes, rows, states, guesses, times_of(self.sol)[rows], self._gaps(lanes, rows), self.params_of(lanes))

    def resumed(self, lanes: np.ndarray, rows: np.ndarray) -> Rows:
        """The same, of every row as the scheme says."""
        program, sol = self.steps.program, self.sol
        sizes = [len(program.equations[index].unknowns) for index, _ in program.stages]
        states, *guesses = np.split(self._started(lanes, rows, False), np.cumsum([self.state_size, *sizes])[:-1], axis=1)
        if self.hides and self.begins:
            lane = np.arange(sol.batch or 1)
            first = self._started(lane, np.zeros_like(lane), True)[lanes, : self.state_size]
            states[:, self.constants] = first[:, self.constants]
            states[rows == 0] = first[rows == 0]
        self._hold(states, lanes, rows)
        guesses = [np.nan_to_num(guess) for guess in guesses]
        return Rows(lanes, rows, states, guesses, times_of(self.sol)[rows], self._gaps(lanes, rows), self.params_of(lanes))

    def _hold(self, states: np.ndarray, lanes: np.ndarray, rows: np.ndarray) -> None:
        """Write what the rows hold into the states."""
        for i, (name, place) in self.held.items():
            states[:, i] = self.saved[name].reshape(*self.saved[name].shape[:2], -1)[lanes, rows, place]

    def _gaps(self, lanes: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Steps from the rows to the next saved ones."""
        gaps = np.append(np.diff(self.counts), 1.0)
        return np.where(rows < self.ends[lanes], gaps[rows], 1.0).astype(int)

    @property
    def state_size(self) -> int:
        """Numbers of a state."""
        return len(self.steps.program.equations[self.steps.program.stages[0][0]].state)

    @cached_property
    def constants(self) -> list[int]:
        """The entries of a state that no row holds and no step changes: they are those of the first row."""
        equations = self.steps.program.equations
        return [i for i in range(self.state_size) if i not in self.held and all(e.advance[i] == e.state[i] for e in equations)]

    def _started(self, lanes: np.ndarray, rows: np.ndarray, anew: bool) -> np.ndarray:
        """States and first guesses of all stages, (entries, numbers), of runs that go on from the rows, or start `anew`."""
        sol, equation = self.sol, self.sol.equation
        every, back = np.unique(rows, return_inverse=True)
        # of the last row no step is saved: what is said of it is that of the step before, which nothing asks for
        taken = lambda a: np.take(a, np.minimum(every, a.shape[int(sol.batch is not None)] - 1), axis=int(sol.batch is not None))
        items: dict[str, Any] = {name: taken(np.asarray(a)) for name, a in sol.fields.items()}
        items |= {name: taken(np.asarray(a)) for name, a in sol.row_fields.items() if name not in sol.fields}
        try:
            found = over_rows(eqx.Partial(_begun, sol.system, sol.step, Same(equation), anew), sol, (items,))
            return found[lanes, back]
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            if self.hides:
                raise CannotReplay(f"the scheme does not start from a saved row: {error}") from None
        return np.zeros((len(rows), self.state_size + sum(stage.unknowns for stage, _ in equation.stages)))

    # ------------------------------------------------------------------------------------------ the steps

    def again(
        self, at: Rows, noise: Noise | None = None, guesses: list[np.ndarray] | None = None, near: Near | None = None
    ) -> Again:
        """The steps that leave these rows, up to the next saved ones, from these `guesses`, if they are given, `near` others."""
        h, steps = float(self.sol.step), self.steps
        first = steps.nothing_near(len(at.rows)) if near is None else near
        made = steps.step(at.states, guesses or at.guesses, at.t, h, at.params, noise, first)
        bad = ~made.good & (at.rows < self.ends[at.lanes])
        if np.any(bad) and guesses is None and noise is None:
            other, anew = self.resumed(at.lanes[bad], at.rows[bad]), steps.nothing_near(int(np.sum(bad)))
            made.put(bad, steps.step(at.states[bad], other.guesses, at.t[bad], h, at.params[bad], near=anew))
            first.put(bad, anew)
        here = steps.rows(made, at.t, h, at.params, noise)
        last, after, good = made, made.after.copy(), made.good.copy()
        unknowns = [u.copy() for u in made.unknowns]
        left, bends, near = np.arange(len(at.rows)), [np.zeros_like(u) for u in made.unknowns], first
        for count in range(1, int(np.max(at.steps, initial=1))):
            on = (at.steps[left] > count) & last.good
            good[left[(at.steps[left] > count) & ~last.good]] = False
            before = [u[on] for u in last.unknowns]
            slopes = [b[on] for b in bends]
            left, now, near = left[on], last.after[on], near[on]
            if not len(left):
                break
            t = at.t[left] + count * h
            last = steps.step(now, [u + b for u, b in zip(before, slopes, strict=True)], t, h, at.params[left], noise, near)
            bends = [u - b for u, b in zip(last.unknowns, before, strict=True)]
            after[left], good[left] = last.after, last.good
            for u, new in zip(unknowns, last.unknowns, strict=True):
                u[left] = new
        there = None
        if self.hides:
            t = at.t + at.steps * h
            then = steps.step(after, unknowns, t, h, at.params, noise, first[:])
            there = steps.rows(then, t, h, at.params, noise)
            there = {name: np.where(_column(then.good & good, a), a, np.nan) for name, a in there.items()}
        here = {name: np.where(_column(made.good, a), a, np.nan) for name, a in here.items()}
        return Again(here, np.where(good[:, None], after, np.nan), good, there, made.unknowns, made.states[0], first)

    def leading_to(self, at: Rows, guess: np.ndarray, wanted: dict[int, np.ndarray], then: dict[int, np.ndarray]) -> Again:
        """Steps of one part that leave these rows and lead to the wanted entries of states, where there are such, and steps after
        them that lead to others."""
        made = self.steps.leading_to(at.states, guess, wanted, at.t, float(self.sol.step), at.params)
        return self._taken(made, at.t, at.params, then)

    def _taken(self, made: Attempts, t: np.ndarray, params: np.ndarray, wanted: dict[int, np.ndarray] | None = None) -> Again:
        """Steps of one part that nothing needs to solve again; those after them lead to the wanted entries, where they can."""
        h, there = float(self.sol.step), None
        if self.hides:
            then = self.steps.step(made.after, made.unknowns, t + h, h, params)
            if wanted is not None:
                led = self.steps.leading_to(made.after, made.unknowns[0], wanted, t + h, h, params)
                then.put(led.good, led[led.good])
            there = self.steps.rows(then, t + h, h, params)
        here = {name: np.where(_column(made.good, a), a, np.nan) for name, a in self.steps.rows(made, t, h, params).items()}
        after = np.where(made.good[:, None], made.after, np.nan)
        return Again(here, after, made.good, there, made.unknowns, made.states[0], self.steps.nothing_near(len(t)))

    def of_given_points(self) -> Again:
        """Row 0 and the state at row 1 of every trajectory of a run from two points, in whose first step nothing was solved."""
        sol, steps, batch = self.sol, self.steps, self.sol.batch or 1
        data = {name: np.asarray(a)[..., None, :] for name, a in sol.initial.items()}
        if sol.batch is not None:
            data = {name: np.broadcast_to(a, (batch, *a.shape[-2:])) for name, a in data.items()}
        items = ({**data, "t": times_at(sol, np.zeros(1, int))},)
        found = over_rows(eqx.Partial(_from_points, sol.system, sol.step, Same(sol.equation)), sol, items)[:, 0]
        state, u = np.split(found, [self.state_size], axis=1)
        t, params = np.full(batch, times_of(self.sol)[0]), self.params_of(np.arange(batch))
        return self._taken(steps.taken(state, u, t, float(sol.step), params), t, params)

    def params_of(self, lanes: np.ndarray) -> np.ndarray:
        """The numbers of the parameters of these trajectories, (entries, numbers)."""
        sol = self.sol
        return self.steps.parameters(sol.given_params, sol.batch if sol.batch_params else None, lanes)


def _begun(system: Any, step: Any, same: Same, anew: bool, row: dict, params: Any):
    """State and first guesses of all stages of the step that leaves a saved row, or of a run that starts `anew` from it."""
    equation = same.object
    data = SavedRow({**row, **system.complete(SavedRow(row), params, False), "t": row["t"]})
    begun: list[Any] = [None] * len(equation.stages)
    for stage in {id(stage): stage for stage, _ in equation.stages}.values():
        places = [i for i, (other, _) in enumerate(equation.stages) if other is stage]
        begin = stage.start if anew else stage.resume
        of_part = lambda part, begin=begin: begin(data, part * step, params)
        parts = [equation.stages[i][1] for i in places]
        # the beginnings of several stages of one equation are traced once
        found = [of_part(parts[0])] if len(parts) == 1 else zip(*jax.vmap(of_part)(np.array(parts)), strict=True)
        for i, of_stage in zip(places, found, strict=True):
            begun[i] = of_stage
    return jnp.concatenate([begun[0][0], *(u for _, u in begun)])


def _from_points(system: Any, step: Any, same: Same, data: dict, params: Any):
    t = data["t"]
    return jnp.concatenate(same.object.stages[0][0].start({**system.complete(data, params, False), "t": t}, step, params))


def _column(good: np.ndarray, values: np.ndarray) -> np.ndarray:
    return good.reshape(-1, *(1,) * (values.ndim - 1))
