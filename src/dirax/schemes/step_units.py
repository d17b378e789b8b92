"""Units in which the discrete constraint algorithm measures: of the state, of the unknowns and of the equations of a step.

As in `dirax.systems.constraint_units`, from the numbers of r(u, x) = 0 and x' = a(u, x) at one point: in other units by powers of
two all numbers of the search are the same.
"""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from dirax.program.tracing import jacobian, once
from dirax.program.user_functions import evaluated
from dirax.schemes.layout import Layout
from dirax.schemes.step import StepEquation
from dirax.systems.constraint_units import Terms


def step_units(equation: StepEquation, state: np.ndarray, unknowns: np.ndarray, h: float, params) -> list[np.ndarray]:
    """Of the state (s,), the unknowns (k,) and the equations (r,) of a step near these."""

    @once
    def numbers(x, u, params):
        residual = lambda u, x: equation.residual(u, x, 0.0, h, params)
        advance = lambda u, x: equation.advance(u, x, 0.0, h, params)
        return advance(u, x), *(jacobian(f, (0, 1))(u, x) for f in (residual, advance))

    after, (by_u, by_x), (on_by_u, on_by_x) = evaluated(numbers, state, unknowns, params)
    s, k, count = state.size, unknowns.size, np.shape(by_u)[0]
    x, u, r = 0, s, s + k
    terms = Terms(s + k + count)
    for matrix, rows, columns in ((by_u, r, u), (by_x, r, x), (on_by_u, x, u), (on_by_x, x, x)):
        values = np.nan_to_num(np.asarray(matrix), posinf=0.0, neginf=0.0)
        i, j = np.nonzero(values)
        terms.add(values[i, j], rows + i, (rows + i, 1.0), (columns + j, -1.0))
    for values, begin in ((state, x), (unknowns, u), (np.nan_to_num(np.asarray(after), posinf=0.0, neginf=0.0), x)):
        there = np.flatnonzero(values)
        terms.add(values[there], None, (begin + there, 1.0))
    named = (slice(x, u), _names(equation.state_layout)), (slice(u, r), _names(equation.unknown_layout))
    return np.split(terms.units(*named), [u, r])


def in_step_units(equation: StepEquation, units: list[np.ndarray]) -> StepEquation:
    """The step for states and unknowns in these units, with its equations in theirs; rows are those of the step."""
    x_unit, u_unit, r_unit = map(jnp.asarray, units)
    residual = lambda u, x, t, h, params: equation.residual(u * u_unit, x * x_unit, t, h, params) / r_unit
    advance = lambda u, x, t, h, params: equation.advance(u * u_unit, x * x_unit, t, h, params) / x_unit
    unpack = lambda x, u, t, h, params: equation.unpack(x * x_unit, u * u_unit, t, h, params)
    return replace(equation, residual=residual, advance=advance, unpack=unpack)


def _names(layout: Layout) -> tuple[str, ...]:
    """Of all numbers, with the letter of their part."""
    found = [""] * layout.size
    for name in layout:
        place = layout.place(name)
        found[place] = [name.rstrip("0123456789")] * len(found[place])
    return tuple(found)
