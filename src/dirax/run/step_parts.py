"""A part of a step as a function of the state that it begins with: what a step is made of that walls divide."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.engines.contract import Problem
from dirax.engines.parameters import Parameters
from dirax.engines.xla.newton import as_function
from dirax.program.memo import Same, by_value
from dirax.program.on_host import host_program, on_host
from dirax.run.impact import Impact, gaps_of, jump, restitutions_of
from dirax.schemes.step import CLOCK, StepEquation

KNOWN = 2
"""Arguments of a part that are known as numbers: a mark, and what is known of it, as of `Flown`."""


@dataclass(frozen=True, eq=False)
class StepParts:
    """The parts of the steps of a problem with walls, by scalar programs of entries (…) side by side; `leaves` say how params are
    numbers. An entry depends on x, which is its state, the part of the step that is over there, t, h and params."""

    system: Any
    problem: Problem
    walls: tuple[Impact, ...]
    leaves: Parameters

    @cached_property
    def stage(self) -> StepEquation:
        """The equation of the only stage of a step."""
        return self.problem.equation.stages[0][0]

    @cached_property
    def _same(self) -> tuple:
        return by_value(self.system), Same(self.stage), *self.walls, self.leaves.key

    # ------------------------------------------------------------------------------------------ one entry

    def _split(self, x: Any) -> tuple:
        s = self.stage.state_size
        return x[:s], x[s], x[s + 1], x[s + 2], self.leaves.split(x[s + 3 :])

    def _row(self, state, u, t, h, params) -> Any:
        row = self.stage.unpack(state, u, t, h, params)
        return jnp.concatenate([jnp.ravel(row[name]) for name in self.problem.fields])

    def _free(self, mark, known, x) -> tuple[Any, Any]:
        """Where the rest of a step leads, and its row."""
        state, at, t, h, params = self._split(x)
        args = state, t + at * h, (1.0 - at + known[-1]) * h, params
        u = as_function(self.stage.residual, known[:-2], args)
        return jnp.append(self.stage.advance(u, *args), 0.0), self._row(state, u, *args[1:])

    def _onto_wall(self, length, known, x) -> tuple[Any, Any]:
        """Where a part leads that ends on a wall, and is of this length, and the row at its beginning."""
        stage, gaps, place = self.stage, gaps_of(self.walls), self.stage.state_layout.place
        of_wall = lambda values: sum(jnp.where(known[-2] == i, values[i], 0.0) for i in range(len(self.walls)))
        time = lambda there, t: there[place(CLOCK)][0] if CLOCK in stage.state_layout else t
        step = lambda z, state, at, t, h, params: (z[:-1], state, t + at * h, z[-1] * h, params)

        def residual(z, state, at, t, h, params):
            args = step(z, state, at, t, h, params)
            there = stage.advance(*args)
            gap = of_wall(gaps(time(there, t + (at + z[-1]) * h), there[place("q")], params))
            return jnp.append(stage.residual(*args), gap)

        args = state, at, t, h, params = self._split(x)
        z = as_function(residual, jnp.append(known[:-2], length), args)
        there, over = stage.advance(*step(z, *args)), at + z[-1]
        own, restitution = (lambda t, q, params, of=of: of_wall(of(t, q, params)) for of in (gaps, restitutions_of(self.walls)))
        after = jump(self.system, stage, own, restitution, there, time(there, t + over * h), h, params)[0]
        return jnp.append(after, over), self._row(state, z[:-1], t + at * h, z[-1] * h, params)

    def _as_it_is(self, mark, u, x) -> Any:
        """The row at a state, of given unknowns."""
        state, _, t, h, params = self._split(x)
        return self._row(state, u, t, h, params)

    # ------------------------------------------------------------------------------------------ many

    @property
    def have_programs(self) -> bool:
        """Whether they are scalar programs."""
        k, shape = self.stage.unknowns, lambda *sizes: jax.ShapeDtypeStruct(sizes, np.float64)
        x = shape(self.stage.state_size + 3 + self.leaves.size)
        kinds = (self._free, k + 2), (self._onto_wall, k + 2), (self._as_it_is, k)
        return all(host_program(part, [shape(), shape(known), x], self._key(part), KNOWN) for part, known in kinds)

    def _key(self, part: Any) -> tuple:
        return part.__name__, *self._same

    def _of_entries(self, part: Any, mark: Any, known: Any, x: Any) -> Any:
        lead = mark.shape
        found = on_host(part, [a.reshape(mark.size, *a.shape[len(lead) :]) for a in (mark, known, x)], self._key(part), KNOWN)
        return jax.tree.map(lambda a: a.reshape(*lead, *a.shape[1:]), found)

    def __call__(self, marks: Any, known: Any, x: Any) -> tuple[Any, Any]:
        """(states after, rows) of parts, free or onto a wall, as the marks say; NaN without a mark, with derivatives of zero."""
        free, onto = (self._of_entries(part, marks[..., i], known, x) for i, part in enumerate((self._free, self._onto_wall)))
        hits = jnp.isfinite(marks[..., 1:])
        after, row = (jnp.where(hits, b, a) for a, b in zip(free, onto, strict=True))
        return after, row

    def rows_at(self, mark: Any, u: Any, x: Any) -> Any:
        """The rows at states, of given unknowns."""
        return self._of_entries(self._as_it_is, mark, u, x)

    def fields(self, rows: Any) -> dict[str, Any]:
        """The fields of rows (B, R, ·)."""
        sizes = [math.prod(field.shape) for field in self.problem.fields.values()]
        parts = jnp.split(rows, np.cumsum(sizes)[:-1].tolist(), axis=-1)
        named = zip(self.problem.fields.items(), parts, strict=True)
        return {name: part.reshape(*part.shape[:2], *field.shape) for (name, field), part in named}
