"""Between the rows of a run with values that JAX traces."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from dirax.program.memo import Same, by_value
from dirax.schemes.step import CLOCK, STEP_DENSITY
from dirax.solution.between_rows import BetweenRows, velocity_of
from dirax.solution.divided_steps import AT_ROW, step_for
from dirax.solution.restarts import refuse_sums
from dirax.solution.steps_again import Keyed, begun, compiled_call, row_of, stepped, with_roots


class TracedDense(BetweenRows):
    """The inside of the steps of a run with derivatives, where values are not checked."""

    def at(self, times: Any) -> dict[str, Any]:
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
        whole = Keyed(own, Same(self.equation), by_value(sol.system), sol.batch is None, sol.batch_params, structure)
        return compiled_call(whole, rows, steps, jax.tree.map(jnp.asarray, sol.params), times, numbers, t0, h)

    def _at_one(self, row, after, of_step, time, t, h, params) -> dict[str, Any]:
        begins, ends = row.get(CLOCK, t), after.get(CLOCK, t + h)
        length = ends - begins if CLOCK in row else h
        step = row, after, of_step, t, h, params
        return self.inside(self.solved(*step), *step)((time - begins) / length)

    def solved(self, row, after, of_step, t, h, params, roots=None) -> tuple:
        """What has to be solved for the inside of the step between two rows, with the fields of the step: once, not at every
        place in it. `roots`: the unknowns of the steps that are taken for it, those here and those in `inside`, where they are
        known as numbers."""
        begins, ends = row.get(CLOCK, t), after.get(CLOCK, t + h)
        length = ends - begins
        if self.interpolate is None and self.between is not None:
            about = {"about": (after["q"] - row["q"]) / length}
            return tuple(velocity_of(self.sol.system, a | about, s, params) for a, s in ((row, begins), (after, ends)))
        refuse_sums(self.equation.stages[0][0], params)
        state, guess = begun(self.equation, self.sol.system, row | of_step, begins, h, params)
        return state, guess if self.interpolate is None else self._step(roots, 0, state, guess, begins, h, params)[1]

    def _step(self, roots, which, state, guess, *args) -> tuple[Any, tuple, tuple]:
        if roots is None:
            return stepped(self.equation, state, guess, *args)
        return with_roots(self.equation, roots[which], state, *args)

    def inside(self, solved, row, after, of_step, t, h, params, roots=None) -> Callable:
        """θ ↦ the fields of nodes at a part θ of that step, as JAX traces them; of a polynomial those that it knows."""
        begins, ends = row.get(CLOCK, t), after.get(CLOCK, t + h)
        if self.interpolate is None and (between := self.between) is not None:
            first, last = ({**a, "t": s, "v": v} for a, s, v in zip((row, after), (begins, ends), solved, strict=True))
            return lambda theta: {n: a for n, a in between(theta, first, last, h, params).items() if n in self.nodes}
        state, guess = solved
        if (interpolate := self.interpolate) is not None:

            def by_polynomial(theta):
                found = interpolate(theta, guess[0], state, begins, h, params)
                return {name: found[name] for name in row if name in found}

            return by_polynomial

        def by_step(theta):
            part = jnp.maximum(theta, AT_ROW) * h
            if CLOCK in row:
                part = step_for(part / h, row[STEP_DENSITY], ends - begins, h)
            there, u, _ = self._step(roots, 0, state, guess, begins, part, params)
            _, unknowns, states = self._step(roots, 1, there, u, begins + part, part, params)
            made = row_of(self.equation, unknowns, states, begins + part, part, params)
            return {name: jnp.where(theta > AT_ROW, made[name], row[name]) for name in row}

        return by_step
