"""Which steps of a long run may have an event in them: by machine code, which looks at all of them at once."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.program.evaluation.functions import graph_program_of
from dirax.program.memo import Memo, Same, by_value
from dirax.program.scalar_program import ScalarProgram
from dirax.run.event import Event, evaluated
from dirax.schemes.hermite import cubic, hermite
from dirax.schemes.step import CLOCK, STEP_DENSITY
from dirax.schemes.watched_step import velocity
from dirax.solution.dense import Dense
from dirax.solution.steps_in_bulk import steps_in_bulk

FEWEST = 20_000
"""Steps of all trajectories from which on it pays to compile for them."""

BLOCK = 2**13
"""Steps that are looked at together."""

MORE = 3.0
"""How much more than `dips` asks of a bend is asked of it here, where the inside of a step may be known roughly alone."""


class EventScan:
    """Looks for steps in which the function of an event may be zero.

    It is looked at inside the steps on the polynomial of the scheme; where it has none, on the cubic through rows and velocities.
    """

    def __init__(self, dense: Dense, event: Event, number: int, points: int):
        self.dense, self.event, self.number, self.points = dense, event, number, points
        sol = dense.sol
        self.names = [name for name in ("q", "p", "x", CLOCK, STEP_DENSITY) if name in dense.nodes]
        self.leaves, self.structure = jax.tree.flatten(sol.given_params)

    @property
    def _inside_sizes(self) -> tuple[int, ...]:
        """Of the state and of the unknowns of a step, which a polynomial takes."""
        first = self.dense.equation.stages[0][0]
        return () if self.dense.interpolate is None else (first.state_size, first.unknowns)

    def run(self) -> Any:
        """The compiled scan; None where the function or the inside of a step is no scalar program, and without the compiler."""
        sol, key = self.dense.sol, (Same(self.dense.equation), by_value(self.dense.sol.system), self.event, self.structure)
        one = 1 if sol.batch is None else 2
        shapes = [jax.ShapeDtypeStruct(np.shape(sol.fields[name])[one:], jnp.float64) for name in self.names]
        of_params = [np.shape(leaf)[bool(sol.batch_params and sol.batch is not None) :] for leaf in self.leaves]
        number = jax.ShapeDtypeStruct((), jnp.float64)
        inside = [jax.ShapeDtypeStruct((size,), jnp.float64) for size in self._inside_sizes]
        whole = [*shapes, *shapes, *inside, number, number, *(jax.ShapeDtypeStruct(shape, jnp.float64) for shape in of_params)]
        try:
            program = graph_program_of(self._flat, whole, ("scan", *key))
        except (TypeError, ValueError, KeyError):  # as the search will say, or rows without velocities
            return None
        return None if program is None else _compiled.get(Same(program), lambda: _machine_code(program))

    def _flat(self, *numbers: Any) -> Any:
        count, more = len(self.names), len(self._inside_sizes)
        row, then = (dict(zip(self.names, numbers[at : at + count], strict=True)) for at in (0, count))
        state_and_unknowns, (t, h, *leaves) = numbers[2 * count : 2 * count + more], numbers[2 * count + more :]
        return self._may_vanish(row, then, state_and_unknowns, t, h, jax.tree.unflatten(self.structure, leaves))

    def _may_vanish(self, row: dict, after: dict, step: tuple, t: Any, h: Any, params: Any) -> Any:
        """1 where the function may be zero in a step between two rows, else 0."""
        inside = self._inside(row, after, step, t, h, params)
        places = [k / self.points for k in range(-1, self.points + 2)]
        g = [self._value(inside(x), params) for x in places]
        g[1], g[-2] = (self._value(end, params) for end in self._ends(row, after, t, h, params))
        found = jnp.zeros((), bool)
        for k in range(1, len(g) - 1):
            found = found | ~jnp.isfinite(g[k])
            if k > 1:
                found = found | (g[k] * g[k - 1] <= 0.0)
            side = jnp.where(g[k] < 0.0, -1.0, 1.0)
            low, middle, high = side * g[k - 1], side * g[k], side * g[k + 1]
            found = found | ((middle <= low) & (middle <= high) & ((2.0 + 2.0 / MORE) * middle <= low + high))
        if self.dense.interpolate is None and self.dense.between is None:  # the cubic is not what the scheme says of the inside
            ends, inner = (g[1] + g[-2]) / 2.0, g[2:-2]
            bend = jnp.max(jnp.abs(jnp.stack([value - ends for value in inner])))
            found = found | (jnp.min(jnp.abs(jnp.stack([g[1], *inner, g[-2]]))) <= bend)
        return jnp.where(found, 1.0, 0.0)

    def _value(self, fields: dict, params: Any) -> Any:
        if "v" in self.event.arguments and "v" not in fields:
            fields = fields | {"v": self._velocity(fields, fields["about"], params)}
        known = {name: fields[name] for name in self.event.arguments if name in fields}
        return evaluated(self.event, self.number, known, params)

    def _velocity(self, fields: dict, about: Any, params: Any) -> Any:
        system, t = self.dense.sol.system, fields["t"]
        if system.lagrangian_form() is not None:
            return velocity(system, fields["q"], fields["p"], t, about, params)
        complete = system.complete({name: fields[name] for name in ("q", "p", "x") if name in fields} | {"t": t}, params, False)
        return complete["velocity" if "x" in fields else "v"]

    def _ends(self, row: dict, after: dict, t: Any, h: Any, params: Any) -> list[dict]:
        """Both rows, with their times."""
        begins, ends = row.get(CLOCK, t), after.get(CLOCK, t + h)
        place = "q" if "q" in row else "x"
        about = (after[place] - row[place]) / (ends - begins)
        return [a | {"t": s, "about": about} for a, s in ((row, begins), (after, ends))]

    def _inside(self, row: dict, after: dict, step: tuple, t: Any, h: Any, params: Any) -> Any:
        """x ↦ the fields at a part x of the step."""
        first, last = self._ends(row, after, t, h, params)
        begins, length = first["t"], last["t"] - first["t"]
        if (interpolate := self.dense.interpolate) is not None:

            def by_polynomial(x):
                found = interpolate(x, step[1], step[0], t, h, params)
                return found | {"t": found.get(CLOCK, t + x * h), "about": first["about"]}

            return by_polynomial
        place = "q" if "q" in row else "x"
        v, v_after = (self._velocity(end, end["about"], params) for end in (first, last))
        between = self.dense.between or self._between_rows(row)

        def by_cubic(x):
            t = begins + x * length
            if between is not None:
                return between(x, {**first, "v": v}, {**last, "v": v_after}, h, params) | {"t": t}
            moved = cubic(x, row[place], after[place], v, v_after, length)
            others = {name: row[name] + x * (after[name] - row[name]) for name in ("q", "p", "x") if name in row}
            return {**others, place: moved, "t": t, "about": first["about"]}

        return by_cubic

    def _between_rows(self, row: dict) -> Any:
        """`between` of a StepEquation for Lagrangians in coordinates, whose v and p are those of the cubic; None for others."""
        system = self.dense.sol.system
        form = None if system.manifold_form() is not None else system.lagrangian_form()
        return None if form is None or not {"q", "p"} <= row.keys() else hermite(form)

    def steps(self, run: Any, first: int, last: int) -> tuple[np.ndarray, np.ndarray] | None:
        """(trajectories, numbers) of the steps, of those from number `first` to before `last`, that are to be looked into; None
        where the inside of steps is not known by machine code."""
        dense, lanes = self.dense, len(self.dense.ends)
        may, size = np.zeros((lanes, last - first + 1), bool), max(1, BLOCK // lanes)
        for low in range(first, last, size):
            high = min(low + size, last)
            inside = steps_in_bulk(dense.again, low, high) if self._inside_sizes else ()
            if inside is None:
                return None
            may[:, low - first : high - first] = self._block(run, low, high, inside)
        if (impacts := dense.sol.impacts) is not None and len(impacts):  # they divide steps
            of_lanes, of_steps, _ = dense.divided.impacts
            own = (of_steps >= first) & (of_steps < last)
            may[of_lanes[own], of_steps[own] - first] = True
        may[:, 0] = True
        may[:, 1:] |= may[:, :-1]  # what comes near to zero where a step ends is looked for where the next one begins
        of_lanes, numbers = np.nonzero(may[:, :-1] & (np.arange(first, last) < dense.ends[:, None]))
        return of_lanes, numbers + first

    def _block(self, run: Any, low: int, high: int, inside: tuple) -> np.ndarray:
        dense, lanes, count = self.dense, len(self.dense.ends), high - low
        of_lanes = np.repeat(np.arange(lanes), count)
        flat = lambda a: np.reshape(a, (lanes * count, -1))
        rows = [flat(dense.saved[name][:, low:high]) for name in self.names]
        after = [flat(dense.saved[name][:, low + 1 : high + 1]) for name in self.names]
        t = np.tile(float(dense.sol.axis[0]) + np.arange(low, high) * float(dense.sol.step), lanes)
        h = np.full(lanes * count, float(dense.sol.step))
        params = [flat(leaf) for leaf in dense.entries.params(of_lanes)]
        columns = [column for a in (*rows, *after, *map(flat, inside), flat(t), flat(h), *params) for column in a.T]
        return run(columns, lanes * count).reshape(lanes, count) != 0.0


_compiled: Memo[Any] = Memo(64)


def _machine_code(program: ScalarProgram) -> Any:
    """(columns, count) ↦ the results of so many entries; None without the compiler."""
    try:
        from dirax.engines.native.ir.compiled_function import loaded
        from dirax.program import machine_code as llvm
    except ImportError:
        return None
    inputs, width = [node for nodes in program.inputs for node in nodes.ravel().tolist()], llvm.vector_width()
    call = loaded(program.graph, inputs, program.results[0].ravel().tolist(), width)

    def run(columns: list[np.ndarray], count: int) -> np.ndarray:
        rows = -(-count // width)
        packed, out = np.ones((rows, len(inputs), width)), np.empty((rows, width))
        whole = count // width
        for i, column in enumerate(columns):
            packed[:whole, i] = column[: whole * width].reshape(whole, width)
            packed[whole:, i, : count - whole * width] = column[whole * width :]
        call(packed.ctypes.data, out.ctypes.data, rows)
        return out.ravel()[:count]

    return run
