"""The steps of a run once more, where they are asked for: the state that each leaves and its unknowns, kept once found."""

import contextlib
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.engines.contract import Outcome, Problem
from dirax.engines.in_jax import in_scalars
from dirax.engines.policy import engine_of
from dirax.engines.sizes import sizes_near
from dirax.engines.steps_in_numbers import StepsInNumbers
from dirax.engines.xla.lane import Numerics, first_lane, take_step
from dirax.engines.xla.newton import as_function
from dirax.program.compiled import compiled
from dirax.program.evaluation.functions import in_numpy
from dirax.program.interpreter import UnsupportedPrimitive
from dirax.program.memo import Memo, OfKey, Same, by_value
from dirax.program.on_host import called_on_host
from dirax.schemes.step import CLOCK, Field, StepEquation, composed_row, needs_every_part
from dirax.solution.restarts import refuse_restarting
from dirax.solution.trajectory import SavedRow, Trajectory

MANY = 2000
"""Steps from which on it pays to compile them."""

FEW = 4
"""Steps of one trajectory that take as long in NumPy as a run of an engine does to begin."""

UPDATES = 50
"""Newton's updates a step, where it is solved by JAX."""


def begun(equation: Any, system: Any, row: dict[str, Any], t: Any, h: Any, params: Any) -> tuple[Any, tuple]:
    """State and first guesses of all stages of the step that leaves a row: what the scheme says, and sums since the start."""
    t = row.get(CLOCK, t)
    data = {**row, **system.complete(SavedRow({**row, "t": t}), params, False), "t": t}
    (first, fraction), *others = equation.stages
    state, u = first.resume(data, fraction * h, params)
    parts, layout = first.state_layout.split(state)._asdict(), first.state_layout
    kept = {name: jnp.reshape(row[name], layout[name]) for name in ("work", "energy_defect") if name in row and name in layout}
    state = layout.join(**parts | {name: a for name, a in kept.items() if a.size})
    return state, (u, *(stage.resume(data, part * h, params)[1] for stage, part in others))


def begun_at(
    sol: Trajectory, lane: int, row: int, of_row: dict[str, Any] | None = None, t: float | None = None
) -> tuple[np.ndarray, tuple[np.ndarray, ...], float, Any]:
    """State and first guesses of the step that leaves a saved row of a trajectory, compiled once, the time there, and the params
    of the trajectory. What is known `of_row` and its time `t` may be other than what was saved."""
    lead = () if sol.batch is None else (lane,)
    params = jax.tree.map(lambda leaf: leaf[lane], sol.params) if sol.batch_params else sol.params
    fields = {name: jnp.asarray(a[(*lead, min(row, a.shape[len(lead)] - 1))]) for name, a in sol.fields.items()}
    if "about" in (near := sol.row_fields):
        fields["about"] = jnp.asarray(near["about"][(*lead, row)])
    fields |= {name: jnp.asarray(a) for name, a in (of_row or {}).items()}
    t, h = float(sol.axis[row]) if t is None else t, float(sol.step)
    state, guess = _begun(Same(sol.equation), Same(sol.system), fields, jnp.asarray(t), jnp.asarray(h), params)
    return np.asarray(state), tuple(map(np.asarray, guess)), t, params


def _begun_by(equation: Same, system: Same, row: dict[str, Any], t: Any, h: Any, params: Any) -> tuple[Any, tuple]:
    return begun(equation.object, system.object, row, t, h, params)


_begun = compiled(_begun_by, seldom=True)


def stepped(equation: Any, state: Any, guess: tuple, t: Any, h: Any, params: Any) -> tuple[Any, tuple, tuple]:
    """The state after a step, and of each stage the unknowns and the state that it left, as JAX traces them."""
    roots = _roots_on_host(equation, state, guess, t, h, params)
    if roots is None:
        return sized_step(equation, state, guess, t, h, params)[:3]
    return with_roots(equation, roots, state, t, h, params)


def with_roots(equation: Any, roots: Any, state: Any, t: Any, h: Any, params: Any) -> tuple[Any, tuple, tuple]:
    """The same of a step of which the unknowns of each stage are known as numbers."""
    unknowns, states = [], []
    for (stage, fraction), root in zip(equation.stages, roots, strict=True):
        args = state, t, fraction * h, params
        unknowns.append(as_function(stage.residual, root, args))
        states.append(state)
        state, t = stage.advance(unknowns[-1], *args), t + fraction * h
    return state, tuple(unknowns), tuple(states)


def _roots_on_host(equation: Any, state: Any, guess: tuple, t: Any, h: Any, params: Any) -> list | None:
    """The unknowns of each stage, without derivatives and NaN where there are none, by a call of the host from where XLA runs:
    it takes seconds to compile an iteration. None where the step has no scalar program, or JAX a device of its own."""
    if jax.default_backend() != "cpu" or (steps := StepsInNumbers.found(equation, params, False)) is None:
        return None

    def find(state: np.ndarray, t: np.ndarray, h: np.ndarray, numbers: np.ndarray, *guesses: np.ndarray) -> list[np.ndarray]:
        made = steps.step(state, guesses, t[:, 0], h[:, 0], numbers)
        return [np.where(made.good[:, None], u, np.nan) for u in made.unknowns]

    numbers = jnp.reshape(steps.program.parameters.flatten(params, None, jnp), (-1,))
    one = lambda a: jnp.reshape(jnp.asarray(a, float), (1,))
    widths = [stage.unknowns for stage, _ in equation.stages]
    return called_on_host(find, widths, jnp.asarray(state), one(t), one(h), numbers, *map(jnp.asarray, guess))


def sized_step(
    equation: Any, state: Any, guess: tuple, t: Any, h: Any, params: Any, differentiable: bool = True
) -> tuple[Any, tuple, tuple, tuple]:
    """`stepped`, and the sizes of the unknowns of each stage."""
    written, jacobians = in_scalars(equation, params, False)
    numerics = Numerics(jacobians=jacobians)
    sizes = sizes_near(written, state, guess, t, h, params)
    begun = first_lane(state, guess)
    lane, unknowns, states = take_step(written, begun, t, h, params, sizes, UPDATES, differentiable, numerics)
    return jnp.where(lane.completed > 0, lane.state, jnp.nan), unknowns, states, sizes


def row_of(equation: Any, unknowns: tuple, states: tuple, t: Any, h: Any, params: Any) -> dict[str, Any]:
    """The row that a step leaves."""
    rows = []
    count = len(equation.stages) if needs_every_part(equation) else 1
    for (stage, fraction), u, state in list(zip(equation.stages, unknowns, states, strict=True))[:count]:
        rows.append(stage.unpack(state, u, t, fraction * h, params))
        t = t + fraction * h
    return composed_row(equation, rows)


class Entries:
    """Functions of entries: places of any trajectories of a run, arrays with an axis of entries in front."""

    def __init__(self, sol: Trajectory):
        self.sol = sol
        self.leaves, self.structure = jax.tree.flatten(sol.given_params)
        self.leaves = [np.asarray(leaf) for leaf in self.leaves]

    def params(self, lanes: np.ndarray) -> list[np.ndarray]:
        """The leaves of the params of these trajectories."""
        if self.sol.batch_params and self.sol.batch is not None:
            return [leaf[lanes] for leaf in self.leaves]
        return [np.broadcast_to(leaf, (len(lanes), *leaf.shape)) for leaf in self.leaves]

    def __call__(self, function: Callable, lanes: np.ndarray, values: Any, *key: Any) -> Any:
        """`function(values, params)` of every entry, a pytree of arrays that may be written to; `key` is equal for functions that
        are."""
        leaves, structure = jax.tree.flatten(values)
        if not len(lanes):  # one entry, for the shapes of what there is none of
            one = [np.zeros((1, *np.shape(leaf)[1:])) for leaf in leaves]
            found = self(function, np.zeros(1, int), jax.tree.unflatten(structure, one), *key)
            return jax.tree.map(lambda a: a[:0], found)
        arrays = [np.asarray(leaf, float) for leaf in leaves] + self.params(lanes)
        count, size = len(leaves), len(lanes)

        def flat(*numbers):
            params = jax.tree.unflatten(self.structure, numbers[count:])
            return function(jax.tree.unflatten(structure, numbers[:count]), params)

        found = in_numpy(flat, arrays, (*key, structure, self.structure))
        if found is None:  # no scalar program: by JAX, in sizes that are powers of two
            more = np.minimum(np.arange(1 << max(size - 1, 0).bit_length()), max(size - 1, 0))
            given = [jnp.asarray(a[more]) for a in arrays]
            found = jax.tree.map(
                lambda a: np.array(a)[:size], compiled_call(Keyed(_each(flat), key, structure, self.structure), *given)
            )
        return found


class Keyed(OfKey):
    """A function that is compared by its key."""

    def __init__(self, function: Callable, *key: Any):
        self.function, self.key = function, key


def _call(function: Keyed, *values: Any) -> Any:
    """The function of these values, compiled once for its key."""
    return function.function(*values)


compiled_call = compiled(_call, seldom=True)


def _each(function: Callable) -> Callable:
    return lambda *arrays: jax.vmap(function)(*arrays)


_solved_equations: Memo[StepEquation] = Memo(64)


def _solved(equation: StepEquation) -> StepEquation:
    about = {"unknowns": Field((equation.unknowns,), "step", ("unknown",))}
    return replace(equation, unpack=lambda state, u, t, h, params: {"unknowns": u}, fields=about)


class StepsAgain:
    """The steps of a run by number: `states` (B, steps, s) that they leave, `unknowns` (B, steps, k) of all stages in order."""

    def __init__(self, sol: Trajectory, counts: np.ndarray, entries: Entries):
        self.sol, self.counts, self.entries = sol, counts, entries
        self.equation: Any = sol.equation
        stages = [stage for stage, _ in self.equation.stages]
        shape = (sol.batch or 1, int(counts[-1]))
        self.ends = np.cumsum([stage.unknowns for stage in stages])
        self.known, self.checked = np.zeros(shape, bool), False
        self.states = np.empty((*shape, stages[0].state_size))
        self.unknowns = np.empty((*shape, self.ends[-1]))

    @cached_property
    def in_numbers(self) -> StepsInNumbers | None:
        """The steps in NumPy; None where they are no scalar program."""
        return StepsInNumbers.found(self.equation, self.sol.given_params, self.sol.batch_params)

    @cached_property
    def about(self) -> Any:
        """Near what the velocities of rows are; None where they are not searched."""
        return self.sol.row_fields.get("about")

    @property
    def key(self) -> tuple:
        """Equal for runs of one equation."""
        return Same(self.equation), by_value(self.sol.system)

    def time(self, number: np.ndarray) -> np.ndarray:
        """The times at which steps begin."""
        return float(self.sol.axis[0]) + number * float(self.sol.step)

    def at(self, lanes: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States and unknowns of these steps, NaN where a step has no solution."""
        if not self.checked:
            refuse_restarting(self)
            self.checked = True
        missing = ~self.known[lanes, numbers]
        if np.any(missing):
            self._find(lanes[missing], numbers[missing])
        return self.states[lanes, numbers], self.unknowns[lanes, numbers]

    def _find(self, lanes: np.ndarray, numbers: np.ndarray) -> None:
        rows = np.searchsorted(self.counts, numbers, side="right") - 1
        far = numbers - self.counts[rows] > FEW * len(numbers)
        if np.any(far):
            self._find_by_runs(lanes[far], rows[far], numbers[far])
        left = np.zeros((self.sol.batch or 1, len(self.counts)), np.int64) - 1
        still = ~self.known[lanes, numbers]
        lanes, rows, numbers = lanes[still], rows[still], numbers[still]
        np.maximum.at(left, (lanes, rows), numbers - self.counts[rows])
        lanes, rows = np.nonzero(left >= 0)  # steps from every row that is begun with
        left, number = left[lanes, rows], self.counts[rows]
        state, u = self.begun_at(lanes, rows, self.time(number))
        while len(lanes):
            after, u = self._whole(lanes, state, u, self.time(number))
            self._keep(lanes, number, state, u)
            on = left > 0
            lanes, left, number, state, u = lanes[on], left[on] - 1, number[on] + 1, after[on], u[on]

    def _find_by_runs(self, lanes: np.ndarray, rows: np.ndarray, numbers: np.ndarray) -> None:
        """The same of steps far from rows, by runs of an engine to where they begin, as far as these come there."""
        sol, engine = self.sol, engine_of("auto")
        state, u = self.begun_at(lanes, rows, self.time(self.counts[rows]))
        arrived = np.zeros(len(lanes), bool)
        for i, (lane, first, last) in enumerate(zip(lanes, self.counts[rows], numbers, strict=True)):
            steps = int(last - first)
            problem = Problem(
                equation=self.equation, state=state[i], guess=self._split(u[i]), h=float(sol.step), t0=float(sol.axis[0]),
                steps=steps, save_every=steps - 1, first_step=int(first), params=self._params(lane),
            )  # fmt: skip
            out = engine.run(problem)
            arrived[i] = out.completed[0] == steps
            if arrived[i]:
                row = self._last_row(problem, out)
                state[i], u[i] = out.last_state[0], self.begin(lanes[i : i + 1], row, self.time(numbers[i : i + 1]))[1][0]
        lanes, numbers, state = lanes[arrived], numbers[arrived], state[arrived]
        self._keep(lanes, numbers, state, self._whole(lanes, state, u[arrived], self.time(numbers))[1])

    def _last_row(self, problem: Problem, out: Outcome) -> dict[str, np.ndarray]:
        """The last row of a run whose last step was saved, with the fields of that step, and near what its velocity is."""
        fields = {name: np.asarray(a) for name, a in out.fields.items()}
        row = {name: a[:, -1] for name, a in fields.items()}
        if self.about is not None:
            flat = {name: fields[name].reshape(1, fields[name].shape[1], -1) for name in self.sol.system.searches_near}
            rate = lambda name, a: (a[:, -1] - a[:, -2]) / problem.h if problem.is_node(name) else a[:, -1]
            row["about"] = np.concatenate([rate(name, a) for name, a in flat.items()], axis=1)
        return row

    def _keep(self, lanes: np.ndarray, numbers: np.ndarray, states: np.ndarray, unknowns: np.ndarray) -> None:
        self.states[lanes, numbers], self.unknowns[lanes, numbers] = states, unknowns
        self.known[lanes, numbers] = True

    def begun_at(self, lanes: np.ndarray, rows: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """`begin` at saved rows of these numbers."""
        sol = self.sol
        take = lambda a, at: np.asarray(a)[at] if sol.batch is None else np.asarray(a)[lanes, at]
        row = {name: take(a, rows) for name, a in sol.fields.items() if sol.field_info[name].place == "node"}
        if sol.rows > 1:
            of_steps = {name: a for name, a in sol.fields.items() if sol.field_info[name].place == "step"}
            row |= {name: take(a, np.minimum(rows, sol.rows - 2)) for name, a in of_steps.items()}
        if self.about is not None:
            row["about"] = take(self.about, rows)
        return self.begin(lanes, row, t)

    def begin(self, lanes: np.ndarray, row: dict[str, np.ndarray], t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States and first guesses of steps that leave rows."""
        sol, equation = self.sol, self.equation
        h = np.full(len(lanes), float(sol.step))

        def function(values, params):
            row, t, h = values
            state, guess = begun(equation, sol.system, row, t, h, params)
            return jnp.concatenate([state, *guess])

        found = self.entries(function, lanes, (row, t, h), "begun", *self.key)
        size = equation.stages[0][0].state_size
        return found[:, :size], found[:, size:]

    def step(self, lanes, state, u, t, h) -> tuple[np.ndarray, np.ndarray]:
        """The states after a step of length h, a number or one an entry, and the unknowns of all stages."""
        if self.in_numbers is None:
            return self.entries(self._one_step, lanes, (state, u, t, np.broadcast_to(h, t.shape)), "step", *self.key)
        made = self.in_numbers.step(state, self._split(u), t, h, self._numbers(lanes))
        bad = ~made.good
        made.after[bad] = np.nan
        return made.after, np.concatenate([np.where(bad[:, None], np.nan, part) for part in made.unknowns], axis=1)

    def _whole(self, lanes, state, u, t) -> tuple[np.ndarray, np.ndarray]:
        """`step` with the length of the run's: by machine code where there are many, and they do not depend on the time."""
        if len(lanes) >= MANY and self.solved is not None:
            sol = self.sol
            problem = Problem(
                equation=self.solved, state=state, guess=(u,), h=float(sol.step), t0=float(sol.axis[0]), steps=1,
                params=self._params(lanes), batch=len(lanes), batch_params=sol.batch_params,
            )  # fmt: skip
            with contextlib.suppress(UnsupportedPrimitive, ImportError):
                out = engine_of("native").run(problem)
                good = (out.completed == 1)[:, None]
                return np.where(good, out.last_state, np.nan), np.where(good, out.fields["unknowns"][:, 0], np.nan)
        return self.step(lanes, state, u, t, float(self.sol.step))

    @cached_property
    def solved(self) -> StepEquation | None:
        """The equation with its unknowns for rows; None for a step that depends on the time, of several parts, or that is no
        scalar program."""
        numbers = self.in_numbers
        if numbers is None or len(self.equation.stages) > 1 or not self.ends[-1] or self.sol.stats.get("engine") == "xla":
            return None
        traced, graph = numbers.program.equations[0], numbers.program.graph
        if numbers.program.shared.t in graph.reachable([*traced.residual, *traced.advance]):
            return None
        return _solved_equations.get(Same(self.equation), lambda: _solved(self.equation))

    def row(self, lanes, state, u, t, h) -> dict[str, np.ndarray]:
        """The rows that are at these states, by steps of these lengths that leave them: what is half of the impulses of a step
        before and of one after it is right where both are of one length."""
        if self.in_numbers is None:
            return self.entries(self._one_row, lanes, (state, u, t, h), "row", *self.key)
        made = self.in_numbers.step(state, self._split(u), t, h, self._numbers(lanes))
        rows = self.in_numbers.rows(made, t, h, self._numbers(lanes))
        where = lambda a: made.good.reshape(-1, *(1,) * (a.ndim - 1))
        return {name: np.where(where(a), a, np.nan) for name, a in rows.items()}

    def _one_step(self, values, params):
        state, u, t, h = values
        after, unknowns, _ = stepped(self.equation, state, self._split(u), t, h, params)
        return after, jnp.concatenate(unknowns)

    def _one_row(self, values, params):
        state, u, t, h = values
        _, unknowns, states = stepped(self.equation, state, self._split(u), t, h, params)
        return row_of(self.equation, unknowns, states, t, h, params)

    def _split(self, u: Any) -> tuple:
        """The unknowns of each stage."""
        return tuple(u[..., end - stage.unknowns : end] for end, (stage, _) in zip(self.ends, self.equation.stages, strict=True))

    def _params(self, lanes: Any) -> Any:
        """The params of a trajectory or of several, or those that all share."""
        own = (lambda a: np.asarray(a)[lanes]) if self.sol.batch_params else np.asarray
        return jax.tree.map(own, self.sol.given_params)

    def _numbers(self, lanes: np.ndarray) -> np.ndarray:
        steps, sol = self.in_numbers, self.sol
        assert steps is not None
        return steps.parameters(sol.given_params, sol.batch if sol.batch_params else None, lanes)
