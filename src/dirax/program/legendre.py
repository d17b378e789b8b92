"""The Legendre transform on an affine distribution: the velocity and the multipliers that belong to a momentum."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.interpreters import partial_eval
from jaxtyping import Array, Float

from dirax.program.linear_solves import solve
from dirax.program.tracing import gradient, jacobian

UPDATES = 4
"""Updates of Newton's method from a guess that is nearly right: of an error e they leave e to the 16th power."""


def constrained_velocity(
    lagrangian: Callable, p: Float[Array, " n"], rows: Float[Array, "m n"], offset: Float[Array, " m"], guess: Float[Array, " n"]
) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
    """(v, ν) with ∂L/∂v = p + rowsᵀν and rows v + offset = 0, for `lagrangian(v)`: the velocity where ⟨p, v⟩ − L is stationary
    on the affine space {rows v + offset = 0}. By Newton's method from `guess`; where L is quadratic in v, at once.

    ∂²L/∂v² must be invertible.
    """
    momentum, quadratic = gradient(lagrangian), not moves(jax.hessian(lagrangian), guess)
    v, multipliers = jnp.zeros_like(guess) if quadratic else guess, jnp.zeros(rows.shape[0])
    for _ in range(1 if quadratic else UPDATES):
        solved = solve(jacobian(momentum)(v), jnp.concatenate([(momentum(v) - p)[:, None], rows.T], axis=1))
        v, lifted = v - solved[:, 0], solved[:, 1:]
        if rows.shape[0]:
            multipliers = -solve(rows @ lifted, rows @ v + offset)
            v = v + lifted @ multipliers
    return v, multipliers


def moves(function: Callable, argument: Any) -> bool:
    """Whether the value of a function of one array depends on it, as far as its jaxpr says."""
    closed = jax.make_jaxpr(function)(argument)
    _, used = partial_eval.dce_jaxpr(closed.jaxpr, [True] * len(closed.jaxpr.outvars))
    return any(used)
