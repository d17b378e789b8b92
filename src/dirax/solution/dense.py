"""Between the rows of a run: the fields at any time, by what the scheme says of the inside of a step."""

from collections.abc import Callable
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.program.memo import Same
from dirax.program.user_functions import is_traced
from dirax.schemes.step import CLOCK, STEP_DENSITY
from dirax.solution.divided_steps import AT_ROW, DividedSteps, step_for
from dirax.solution.selection import rows_of
from dirax.solution.steps_again import Entries, Keyed, StepsAgain, begun, compiled_call, row_of, stepped
from dirax.solution.stored_rows import StoredRows
from dirax.solution.trajectory import Trajectory, last_rows

SHORT = 1e-3
"""Part of a step from which on there is no doubt that it can be solved."""

SLACK = 1e-9
"""Part of a step by which a time may lie outside of the run: what rounding does to t0 + k·h."""


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


class Dense:
    """The inside of the steps of a run.

    By the polynomial of the method, where it has one; by the cubic through saved rows, for methods of second order whose every
    row was saved; else by a step of a part of the length, of which a row is made as the run makes it.
    """

    def __init__(self, sol: Trajectory):
        if sol.equation is None or sol.system is None:
            raise ValueError(
                "this solution does not know by which equations it was made: load it with dx.load(path, system=…, scheme=…)."
            )
        if sol.impacts is not None and sol.save_every != 1:
            raise ValueError("between the rows of a run with impacts sol.at needs every row: leave save_every= out.")
        if sol.has_own_times and sol.save_every != 1:
            raise ValueError("between the rows of a run of variable steps sol.at needs every row: leave save_every= out.")
        if sol.rows < 2:
            raise ValueError("there is no step between the rows of this solution, which has only one.")
        self.sol, self.equation = sol, sol.equation
        first = self.equation.stages[0][0]
        single = len(self.equation.stages) == 1
        self.interpolate = first.interpolate if single else None
        self.between = first.between if single and sol.save_every == 1 else None
        if sol.has_own_times and not single:
            raise ValueError("between the rows of a composition of variable steps nothing is known: compose another scheme.")

    @property
    def nodes(self) -> dict[str, Any]:
        """The saved fields of nodes."""
        return {name: a for name, a in self.sol.fields.items() if self.sol.field_info[name].place == "node"}

    # ------------------------------------------------------------------------------------------ of values that JAX traces

    def traced(self, times: Any) -> dict[str, Any]:
        """The fields at times (T,), (T, …) or (B, T, …), with derivatives. Raises `ValueError` for rows of which some were not
        saved."""
        sol = self.sol
        if sol.impacts is not None:
            raise ValueError(
                "under jax.grad, jit and vmap sol.at does not look into steps that walls divide: use rows and events."
            )
        if sol.save_every != 1:
            raise ValueError("under jax.grad, jit and vmap sol.at needs every row: leave save_every= out.")
        t0, h, last = jnp.asarray(sol.axis[0]), jnp.asarray(sol.step), sol.rows - 2
        numbers = jnp.clip(jnp.floor(jax.lax.stop_gradient((times - t0) / h)).astype(int), 0, last)
        own_times = sol.has_own_times
        rows = {name: jnp.asarray(a) for name, a in self.nodes.items()}
        steps = {name: jnp.asarray(a) for name, a in sol.fields.items() if name not in rows}

        def lane(rows, steps, params, times, numbers, t0, h):
            if own_times:
                numbers = jnp.clip(jnp.searchsorted(jax.lax.stop_gradient(rows[CLOCK]), times, side="right") - 1, 0, last)

            def one(time, number):
                row, after = ({name: a[number + i] for name, a in rows.items()} for i in (0, 1))
                of_step = {name: a[number] for name, a in steps.items()}
                return self._at_one(row, after, of_step, time, t0 + number.astype(float) * h, h, params) | of_step

            return jax.vmap(one)(times, numbers)

        own = (
            lane if sol.batch is None else jax.vmap(lane, in_axes=(0, 0, 0 if sol.batch_params else None, None, None, None, None))
        )
        structure = jax.tree.structure((rows, steps, sol.params))
        whole = Keyed(own, Same(self.equation), Same(sol.system), sol.batch is None, sol.batch_params, structure)
        return compiled_call(whole, rows, steps, jax.tree.map(jnp.asarray, sol.params), times, numbers, t0, h)

    def _at_one(self, row, after, of_step, time, t, h, params) -> dict[str, Any]:
        begins, ends = row.get(CLOCK, t), after.get(CLOCK, t + h)
        length = ends - begins if CLOCK in row else h
        return self.inside_one(row, after, of_step, t, h, params)((time - begins) / length)

    def inside_one(self, row, after, of_step, t, h, params) -> Callable:
        """θ ↦ the fields of nodes at a part θ of the step between two rows, with the fields of the step, as JAX traces them."""
        system, begins, ends = self.sol.system, row.get(CLOCK, t), after.get(CLOCK, t + h)
        if self.interpolate is None and (between := self.between) is not None:
            both = ({**a, "t": s, "v": _velocity(system, a, s, params)} for a, s in ((row, begins), (after, ends)))
            first, last = both
            return lambda theta: {n: a for n, a in between(theta, first, last, h, params).items() if n in self.nodes}
        state, guess = begun(self.equation, system, row | of_step, begins, h, params)
        if (interpolate := self.interpolate) is not None:
            _, (u,), _ = stepped(self.equation, state, guess, begins, h, params)

            def by_polynomial(theta):
                found = interpolate(theta, u, state, begins, h, params)
                return {name: found.get(name, row[name]) for name in row}

            return by_polynomial

        def by_step(theta):
            part = jnp.maximum(theta, AT_ROW) * h
            if CLOCK in row:
                part = step_for(part / h, row[STEP_DENSITY], ends - begins, h)
            there, u, _ = stepped(self.equation, state, guess, begins, part, params)
            _, unknowns, states = stepped(self.equation, there, u, begins + part, h, params)
            made = row_of(self.equation, unknowns, states, begins + part, h, params)
            return {name: jnp.where(theta > AT_ROW, made[name], row[name]) for name in row}

        return by_step

    # ------------------------------------------------------------------------------------------ of numbers

    @cached_property
    def counts(self) -> np.ndarray:
        """The number of the step that leaves each row."""
        t = np.asarray(self.sol.axis, float)
        return np.rint((t - t[0]) / float(self.sol.step)).astype(np.int64)

    @cached_property
    def entries(self) -> Entries:
        """Functions of places in this run."""
        return Entries(self.sol)

    @cached_property
    def again(self) -> StepsAgain:
        """The steps of this run once more."""
        return StepsAgain(self.sol, self.counts, self.entries)

    @cached_property
    def saved(self) -> dict[str, np.ndarray]:
        """The fields with an axis of the batch."""
        one = self.sol.batch is None
        return {name: np.asarray(a)[None] if one else np.asarray(a) for name, a in self.sol.fields.items()}

    @cached_property
    def ends(self) -> np.ndarray:
        """The number of the last step + 1 that each trajectory reached, (B,)."""
        return self.counts[np.maximum(last_rows([self.saved[name] for name in self.nodes]), 0)]

    def velocities(self, lanes: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """v at saved rows, (entries, n)."""
        size = self.saved["q"].shape[1]
        own, which = np.unique(lanes * size + rows, return_inverse=True)
        lanes, rows = own // size, own % size
        fields = {name: self.saved[name][lanes, rows] for name in self.nodes}
        return self.velocity(lanes, fields, np.broadcast_to(np.asarray(self.sol.t), self.saved["q"].shape[:2])[lanes, rows])[
            which
        ]

    def velocity(self, lanes: np.ndarray, fields: dict[str, np.ndarray], t: np.ndarray) -> np.ndarray:
        """The velocities that belong to q and p."""
        system = self.sol.system
        given = {name: fields[name] for name in ("q", "p")}
        function = lambda values, params: _velocity(system, values[0], values[1], params)
        return self.entries(function, lanes, (given, t), "velocity", Same(system))

    def place(self, lanes: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The number of the step in which each time lies, and where in it, from 0 to 1."""
        t0, h = float(self.sol.axis[0]), float(self.sol.step)
        last = np.maximum(self.ends[lanes] - 1, 0)
        if self.sol.has_own_times:
            numbers = np.zeros(len(lanes), np.int64)
            for lane in np.unique(lanes):
                own = lanes == lane
                numbers[own] = np.searchsorted(self.saved[CLOCK][lane, : self.ends[lane] + 1], times[own], side="right") - 1
            numbers = np.clip(numbers, 0, last)
            begins, ends = (self.time_at(lanes, numbers + i, 0.0) for i in (0, 1))
            return numbers, np.clip((times - begins) / (ends - begins), 0.0, 1.0)
        numbers = np.clip(np.floor((times - t0) / h).astype(np.int64), 0, last)
        return numbers, np.clip((times - (t0 + numbers * h)) / h, 0.0, 1.0)

    def inside(self, lanes: np.ndarray, numbers: np.ndarray, theta: np.ndarray) -> dict[str, np.ndarray]:
        """The fields of nodes inside steps (entries, …), and `v` where it is found on the way."""
        sol, again = self.sol, self.again
        h = np.full(len(theta), float(sol.step))
        t = self.time_at(lanes, numbers, 0.0)
        if sol.impacts is not None and np.any(hit := self.divided.among(lanes, numbers)):
            return self.divided.inside(lanes, numbers, theta, hit)
        if self.interpolate is not None:
            states, u = again.at(lanes, numbers)
            interpolate = self.interpolate
            function = lambda values, params: interpolate(*values, params)
            return self.entries(function, lanes, (theta, u, states, t, h), "interpolate", *again.key)
        if self.between is not None:
            pick = lambda at: {name: self.saved[name][lanes, at] for name in self.nodes} | {"v": self.velocities(lanes, at)}
            rows = [pick(numbers + i) | {"t": self.time_at(lanes, numbers + i, 0.0)} for i in (0, 1)]
            between = self.between
            function = lambda values, params: between(*values, params)
            return self.entries(function, lanes, (theta, *rows, h), "between", *again.key)
        return self._by_steps(lanes, numbers, theta, t, h)

    @cached_property
    def divided(self) -> DividedSteps:
        """The steps that walls divide."""
        return DividedSteps(self)

    def _by_steps(self, lanes, numbers, theta, t, h) -> dict[str, np.ndarray]:
        nearest = numbers + (theta > 0.5)
        row = np.minimum(np.searchsorted(self.counts, nearest), self.sol.rows - 1)
        at_row = (np.abs(numbers + theta - nearest) <= AT_ROW) & (self.counts[row] == nearest)
        found = {name: self.saved[name][lanes, row].astype(float) for name in self.nodes}
        if not np.all(at_row):
            off = ~at_row
            lanes_all, lanes, t, part = lanes, lanes[off], t[off], np.maximum(theta[off], AT_ROW) * h[off]
            if self.sol.has_own_times:
                at = numbers[off]
                length = self.time_at(lanes, at + 1, 0.0) - t
                part = step_for(part / h[off], self.saved[STEP_DENSITY][lanes, at], length, h[off])
            states, u = self.again.at(lanes, numbers[off])
            states, u = self.again.step(lanes, states, u, t, part)
            made = self.again.row(lanes, states, u, t + part)
            for name, values in found.items():
                values[off] = made[name]
            fails = np.flatnonzero(off)[~np.isfinite(states).all(axis=1) & (theta[off] < SHORT)]
            if len(fails):
                for name, values in self._near_row(lanes_all[fails], numbers[fails], theta[fails]).items():
                    found[name][fails] = values
        return found

    def _near_row(self, lanes: np.ndarray, numbers: np.ndarray, theta: np.ndarray) -> dict[str, np.ndarray]:
        """The same so near to a row that the equations of a step of this length are not solved in floats: by the cubic through
        the row and longer steps."""
        places = np.arange(4) * 2 * SHORT
        points = [self.inside(lanes, numbers, np.full(len(theta), place)) for place in places]
        weights = [np.prod([(theta - b) / (a - b) for b in places if b != a], axis=0) for a in places]
        column = lambda w, a: w.reshape(-1, *(1,) * (a.ndim - 1)) * a
        whole = lambda name: np.sum([column(w, p[name]) for w, p in zip(weights, points, strict=True)], axis=0)
        return {name: whole(name) for name in self.nodes}

    def at(self, times: np.ndarray) -> dict[str, np.ndarray]:
        """The fields at times (T,) or (B, T): (B, T, …). Raises `ValueError` for times outside of the run."""
        sol = self.sol
        batch = sol.batch or 1
        times = np.broadcast_to(times, (batch, times.shape[-1]))
        self._refuse_outside(times)
        lanes, flat = np.repeat(np.arange(batch), times.shape[1]), times.ravel()
        numbers, theta = self.place(lanes, flat)
        found = self.inside(lanes, numbers, theta)
        fields: dict[str, Any] = {name: found.get(name, self.of_rows(name, lanes, numbers)) for name in self.nodes}
        if sol.save_every == 1:
            steps = {name: a for name, a in self.saved.items() if name not in fields}
            fields |= {name: a[lanes, np.minimum(numbers, a.shape[1] - 1)] for name, a in steps.items()}
        if sol.batch is not None:
            beyond = flat > self.time_at(lanes, self.ends[lanes], 0.0) + SLACK * float(sol.step)
            for a in fields.values():
                a[beyond] = np.nan
        return {name: a.reshape(batch, times.shape[1], *a.shape[1:]) for name, a in fields.items()}

    def of_rows(self, name: str, lanes: np.ndarray, numbers: np.ndarray) -> Any:
        """A field of which a polynomial says nothing: that of the row before."""
        return self.saved[name][lanes, np.searchsorted(self.counts, numbers, side="right") - 1]

    def time_at(self, lanes: np.ndarray, numbers: np.ndarray, theta: Any) -> np.ndarray:
        """The times of places inside steps."""
        if not self.sol.has_own_times:
            return float(self.sol.axis[0]) + (numbers + theta) * float(self.sol.step)
        t = self.saved[CLOCK]
        begins = t[lanes, numbers]
        return begins + np.where(theta > 0.0, theta * (t[lanes, np.minimum(numbers + 1, t.shape[1] - 1)] - begins), 0.0)

    def _refuse_outside(self, times: np.ndarray) -> None:
        first, last = float(self.sol.axis[0]), float(self.sol.axis[-1])
        if self.sol.has_own_times:  # those that have failed are NaN after their end
            t, whole = self.saved[CLOCK], self.ends == np.max(self.ends)
            first, last = float(np.max(t[:, 0])), float(np.min(t[whole, np.max(self.ends)]))
        slack = SLACK * float(self.sol.step) + 4 * np.spacing(max(abs(first), abs(last)))
        outside = ~((times >= first - slack) & (times <= last + slack))
        if np.any(outside):
            raise ValueError(
                f"sol.at takes times inside the run, from {first:.6g} to {last:.6g}, but {times[outside].flat[0]!r} is not among "
                "them: run more steps, or go on with sol.extend(steps)."
            )


def _velocity(system: Any, row: dict, t: Any, params: Any) -> Any:
    return system.complete({"q": row["q"], "p": row["p"], "t": t}, params, False)["v"]


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
    if is_traced(t, sol.t, sol.fields, sol.step, sol.params):
        times = jnp.asarray(t, float)
        if times.ndim > 1:
            raise ValueError(
                f"under jax.grad, jit and vmap sol.at takes one time or times (T,), but shape {times.shape} was given."
            )
        found = Dense(sol).traced(jnp.atleast_1d(times))
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
    if times.ndim > 2 or (times.ndim == 2 and times.shape[0] != batch) or not times.size:
        expected = "a number or an array (T,)" + (f" or ({batch}, T), of a batch of {batch}" if batch is not None else "")
        raise ValueError(f"sol.at takes times as {expected}, but an array of shape {times.shape} was given.")
    return times.astype(float)
