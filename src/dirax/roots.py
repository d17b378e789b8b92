"""Roots of small systems of equations, regular or not: damped Newton with a pseudo-inverse, run to the roundoff floor."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from dirax.tracing import call, jacobian

EPSILON = 2.220446049250313e-16
RANK_TOLERANCE = 1e-12
"""Singular values below this, relative to the largest of the equilibrated matrix, count as zero."""
SHORTEST = 2.0**-30
"""Smallest fraction of a Newton step that is tried."""


def nearest_root(residual: Callable, guess: Float[Array, " k"], max_steps: int = 100) -> Float[Array, " k"]:
    """A root of `residual` (k,) → (k,) near `guess`; where it has several, that of the least changes from the guess.

    A step is halved until the next one would be shorter, so that the units of the equations and of the unknowns do not
    matter and the domain of `residual` is not left. Where there is no root, the last point that was an improvement comes
    back, so check the residual if that can happen. Differentiable any number of times, by the implicit function theorem.
    """
    residual, captured = jax.closure_convert(residual, guess)
    return _root(jax.jit(residual), max_steps, guess, *captured)


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _root(residual: Callable, max_steps: int, guess, *captured):
    """The root for a residual of the unknowns and of what it captured."""
    of_captured = residual
    residual = lambda u: of_captured(u, *captured)

    def step(carry):
        u, _, count = carry
        inverse, unit = scaled_pseudo_inverse(jacobian(residual)(u))
        change = inverse @ residual(u)
        size = lambda v: jnp.max(jnp.abs(v) / unit)
        here = size(change)
        at_floor = here <= 4.0 * EPSILON * size(u)

        def shorter(fraction):
            following = inverse @ residual(u - fraction * change)
            # not left to the comparison: XLA's vectorized maximum of NaNs can be −∞ on a CPU
            return jnp.all(jnp.isfinite(following)) & (size(following) <= (1.0 - fraction / 4.0) * here)

        def halve(carry):
            fraction = carry[0] / 2.0
            return fraction, shorter(fraction)

        fraction, better = lax.while_loop(lambda c: ~c[1] & (c[0] > SHORTEST), halve, (jnp.ones(()), shorter(1.0) | at_floor))
        return jnp.where(better, u - fraction * change, u), ~better | at_floor, count + 1

    unfinished = lambda carry: ~carry[1] & (carry[2] < max_steps)
    return lax.while_loop(unfinished, step, (guess, jnp.array(False), 0))[0]


@_root.defjvp
def _root_jvp(residual, max_steps, primals, tangents):
    """By the implicit function theorem; the guess has no influence."""
    guess, *captured = primals
    u = _root(residual, max_steps, guess, *captured)
    along = jax.jvp(lambda *values: residual(u, *values), tuple(captured), tuple(tangents[1:]))[1] if captured else 0.0 * u
    inverse, _ = scaled_pseudo_inverse(jax.jacfwd(residual)(u, *captured))
    return u, -(inverse @ along)


def scaled_pseudo_inverse(matrix: Float[Array, "k l"]) -> tuple[Float[Array, "l k"], Float[Array, " l"]]:
    """The pseudo-inverse of a matrix with rows and columns scaled to unit size, and the units that this gives the columns."""
    return call(_scaled_pseudo_inverse, matrix)


def _scaled_pseudo_inverse(matrix):
    rows, columns = jnp.ones((matrix.shape[0], 1)), jnp.ones((1, matrix.shape[1]))
    fitting = lambda sizes: jnp.sqrt(jnp.where(sizes > 0.0, sizes, 1.0))
    for _ in range(3):
        left = jnp.abs(lax.stop_gradient(matrix)) / rows / columns  # units have no derivative, which would be ∞ at zero
        rows = rows * fitting(jnp.max(left, axis=1, keepdims=True))
        columns = columns * fitting(jnp.max(left, axis=0, keepdims=True))
    inverse = jnp.linalg.pinv(matrix / rows / columns, rtol=RANK_TOLERANCE)
    return inverse / columns.T / rows.T, 1.0 / columns[0]
