"""Newton's method run to the roundoff floor, as an optimistix root finder with the implicit adjoint."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

UNROLLED = 6
"""Largest number of unknowns whose elimination is written out in scalars; beyond it LAPACK is faster."""

EPSILON = 2.220446049250313e-16


def small_solve(a: Float[Array, "k k"], b: Float[Array, " k"]) -> Float[Array, " k"]:
    """Solve a x = b: elimination with partial pivoting, unrolled into scalars for small k (XLA fuses it into one kernel)."""
    k = b.shape[0]
    if k > UNROLLED:
        return jnp.linalg.solve(a, b)
    rows = [[a[i, j] for j in range(k)] + [b[i]] for i in range(k)]
    for c in range(k):
        for i in range(c + 1, k):  # bubble the largest entry of column c up to row c
            swap = jnp.abs(rows[i][c]) > jnp.abs(rows[c][c])
            for j in range(c, k + 1):
                upper, lower = rows[c][j], rows[i][j]
                rows[c][j], rows[i][j] = jnp.where(swap, lower, upper), jnp.where(swap, upper, lower)
        for i in range(c + 1, k):
            factor = rows[i][c] / rows[c][c]
            for j in range(c + 1, k + 1):
                rows[i][j] = rows[i][j] - factor * rows[c][j]
    x: list[Any] = [None] * k
    for i in reversed(range(k)):
        total = rows[i][k]
        for j in range(i + 1, k):
            total = total - rows[i][j] * x[j]
        x[i] = total / rows[i][i]
    return jnp.stack(x)


class _State(eqx.Module):
    update: Float[Array, ""]
    previous_update: Float[Array, ""]
    residual: Float[Array, ""]


class NewtonToFloor(optx.AbstractRootFinder):
    """Newton's method that stops when its updates no longer shrink, or when the next one is certain to be below roundoff.

    Updates are measured relative to |u_i| + scale_i, `scale` the unit of each unknown.
    """

    scale: tuple[float, ...] = eqx.field(static=True)
    rtol: float = eqx.field(static=True, default=0.0)
    atol: float = eqx.field(static=True, default=0.0)
    norm: Callable = eqx.field(static=True, default=optx.max_norm)

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        # an update of zero ends the iteration before it begins: a trajectory that has stopped costs nothing
        first = jnp.where(options["running"], jnp.inf, 0.0)
        return _State(first, jnp.array(jnp.inf), jnp.array(jnp.inf))

    def step(self, fn, y, args, options, state, tags):
        r, aux = fn(y, args)
        jacobian = jax.jacfwd(lambda y: fn(y, args)[0])(y)
        change = small_solve(jacobian, r)
        new = y - change
        update = jnp.max(jnp.abs(change) / (jnp.abs(new) + jnp.asarray(self.scale)))
        return new, _State(update, state.update, jnp.max(jnp.abs(r))), aux

    def terminate(self, fn, y, args, options, state, tags):
        return at_floor(state.update, state.previous_update), optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        return y, aux, {}


def at_floor(update, previous):
    """Whether Newton has nothing left to gain, from its last two relative updates (inf before there were any).

    Either the updates stopped shrinking far down, or quadratic convergence, next ≈ update·(update/previous)², puts the
    next one far below roundoff.
    """
    stalled = (update >= 0.5 * previous) & (update < 1e-9)
    negligible = update * (update / previous) ** 2 < 1e-6 * EPSILON
    return stalled | (update == 0.0) | (negligible & jnp.isfinite(previous) & (update < 1e-5))


def solve(residual: Callable, scale: tuple[float, ...], u, args, max_iterations: int, running=True):
    """(u, iterations, residual norm, converged) of residual(u, args) = 0 from the guess u; differentiable in args.

    The guess comes back where `running` is false.
    """
    if u.shape[0] == 0:
        return u, jnp.array(0), jnp.array(0.0), jnp.array(True)
    options = {"running": jnp.asarray(running)}
    solution = optx.root_find(residual, NewtonToFloor(scale), u, args, options, max_steps=max_iterations, throw=False)
    converged = solution.result == optx.RESULTS.successful
    return solution.value, solution.stats["num_steps"], solution.state.residual, converged
