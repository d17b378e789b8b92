"""The steps of a long run once more, all of them at once by machine code: to look inside of them, not digit by digit."""

import jax
import jax.numpy as jnp
import numpy as np

from dirax.engines.contract import Problem
from dirax.engines.policy import engine_of
from dirax.program.interpreter import UnsupportedPrimitive
from dirax.program.memo import Memo, Same
from dirax.schemes.step import Field, StepEquation
from dirax.solution.steps_again import StepsAgain

TOGETHER = 32
"""Steps from a saved row on: so few that rounding has not grown, and so many that they are begun cheaply."""


def steps_in_bulk(again: StepsAgain, first: int, last: int) -> tuple[np.ndarray, np.ndarray] | None:
    """The states (B, steps, s) that the steps from number `first` to before `last` leave and their unknowns (B, steps, k), of a
    run of one part whose every row was saved; None where there is no machine code for them."""
    sol, equation = again.sol, again.equation
    lanes, numbers = sol.batch or 1, np.arange(first, last, TOGETHER)
    of_lanes, of_rows = np.repeat(np.arange(lanes), len(numbers)), np.tile(numbers, lanes)
    params = sol.given_params
    if sol.batch_params:
        params = jax.tree.unflatten(again.entries.structure, again.entries.params(of_lanes))
    state, u = again.begun_at(of_lanes, of_rows, again.time(of_rows))
    problem = Problem(
        equation=_timed.get(Same(equation), lambda: _with_time(equation)),
        state=np.column_stack([state, again.time(of_rows)]),
        guess=(u,),
        h=float(sol.step),
        t0=0.0,
        steps=TOGETHER,
        params=params,
        batch=len(of_lanes),
        batch_params=sol.batch_params,
    )
    try:
        out = engine_of("native").run(problem)
    except (UnsupportedPrimitive, ImportError):
        return None
    whole = lambda name: out.fields[name].reshape(lanes, len(numbers) * TOGETHER, -1)[:, : last - first]
    return whole("state"), whole("unknowns")


_timed: Memo[StepEquation] = Memo(64)


def _with_time(equation: StepEquation) -> StepEquation:
    """The equation with the time in its state, so that steps from any row can be taken together; rows are state and unknowns."""
    own = lambda function: lambda u, state, t, h, params: function(u, state[:-1], state[-1], h, params)
    advance = own(equation.advance)
    about = lambda size, name: Field((size,), "step", (name,))
    return StepEquation(
        start=equation.start,
        residual=own(equation.residual),
        advance=lambda u, state, t, h, params: jnp.append(advance(u, state, t, h, params), state[-1] + h),
        unpack=lambda state, u, t, h, params: {"state": state[:-1], "unknowns": u},
        guess=lambda state, previous, h, params: equation.guess(state[:-1], previous, h, params),
        state_size=equation.state_size + 1,
        unknowns=equation.unknowns,
        fields={"state": about(equation.state_size, "entry"), "unknowns": about(equation.unknowns, "unknown")},
    )
