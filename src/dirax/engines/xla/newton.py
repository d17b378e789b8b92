"""Newton's method run to the roundoff floor, differentiable by the implicit function theorem."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import lu_factor, lu_solve
from jaxtyping import Array, Bool, Float, Int

LARGEST_INVERSE = 8
"""Largest number of unknowns for which the inverse is written out in array operations; beyond it LAPACK is faster."""

EPSILON = 2.220446049250313e-16
FLOOR = 8 * EPSILON
"""A relative update of this size is roundoff: the unknowns cannot be known better."""

NEGLIGIBLE = 1e-5 * EPSILON
"""Error left by the last update that even 10¹⁰ steps do not add up to more than their roundoff."""

STALLED = 1e-9
"""Updates below this that no longer shrink have reached the floor of an ill-conditioned equation."""

NEAR, CONTRACTING = 1e-3, 1e-2
"""The Jacobian is used again after a first update below NEAR, and as long as updates shrink by the factor CONTRACTING."""


class Search(NamedTuple):
    """Where the iteration stands: the unknowns, and (the size of the last update relative to |u_i| + scale_i, its ratio to
    the update before, the number of updates) as one array, which costs XLA one kernel and not three."""

    u: Float[Array, " k"]
    measures: Float[Array, "3"]

    @property
    def update(self) -> Float[Array, ""]:
        """inf before the first update."""
        return self.measures[0]

    @property
    def ratio(self) -> Float[Array, ""]:
        """nan after the first update."""
        return self.measures[1]

    @property
    def updates(self) -> Float[Array, ""]:
        """A whole number."""
        return self.measures[2]


def solve(
    residual: Callable[..., Float[Array, " k"]],
    scale: tuple[float, ...],
    guess: Float[Array, " k"],
    args: tuple[Any, ...],
    max_iterations: int,
    running: Any = True,
    jacobian: Callable[..., Float[Array, "k k"]] | None = None,
) -> tuple[Float[Array, " k"], Int[Array, ""], Bool[Array, ""]]:
    """(u, number of updates, converged) of residual(u, *args) = 0; not for reverse mode, see `as_function`.

    `scale` (k,) is the unit of each unknown, relative to which updates are measured. The guess comes back where `running`
    is false. `jacobian(u, *args)` is that of the residual, derived here where it is not given.
    """
    if guess.shape[0] == 0:
        return guess, jnp.zeros((), jnp.int64), jnp.array(True)
    equation = lambda u: residual(u, *args)
    slopes = (lambda u: jacobian(u, *args)) if jacobian else jax.jacfwd(equation)
    found = newton(equation, slopes, jnp.asarray(scale), guess, max_iterations, running)
    return found.u, found.updates.astype(int), at_floor(found)


def as_function(
    residual: Callable[..., Float[Array, " k"]], root: Float[Array, " k"], args: tuple[Any, ...]
) -> Float[Array, " k"]:
    """`root`, with its derivatives as the function of args that residual(root, *args) = 0 makes of it."""
    if root.shape[0] == 0:
        return root

    def tangent_solve(linear, right_hand_side):
        matrix = jax.vmap(linear, out_axes=1)(jnp.eye(root.shape[0]))
        return factorised(matrix)(right_hand_side)

    return jax.lax.custom_root(lambda u: residual(u, *args), root, lambda _, u: u, tangent_solve)


def newton(
    equation: Callable,
    jacobian: Callable,
    scale: Float[Array, " k"],
    guess: Float[Array, " k"],
    max_iterations: int,
    running: Any,
) -> Search:
    """Newton's method in which a Jacobian serves several updates while they contract quickly, and is renewed otherwise."""

    def updated(s: Search, solver: Callable) -> Search:
        change = solver(equation(s.u))
        u = s.u - change
        update = jnp.max(jnp.abs(change) / (jnp.abs(u) + scale))
        ratio = jnp.where(s.updates > 0, update / s.update, jnp.nan)
        return Search(u, jnp.stack([update, ratio, s.updates + 1]))

    def unfinished(s: Search):
        return running & ~at_floor(s) & ~jnp.isnan(s.update) & (s.updates < max_iterations)

    def contracting(s: Search):
        return unfinished(s) & ((s.ratio < CONTRACTING) | (jnp.isnan(s.ratio) & (s.update < NEAR)))

    def with_new_jacobian(s: Search) -> Search:
        solver = factorised(jacobian(s.u))
        return jax.lax.while_loop(contracting, lambda s: updated(s, solver), updated(s, solver))

    start = Search(guess, jnp.array([jnp.inf, jnp.nan, 0.0]))
    return jax.lax.while_loop(unfinished, with_new_jacobian, start)


def at_floor(s: Search) -> Bool[Array, ""]:
    """Whether another update would gain nothing.

    With a Jacobian from a distance e of the root the error shrinks by 2Ce in an update, C the curvature, and Ce is the
    ratio of the first two updates: what the last update leaves is at most 2·ratio·update.
    """
    left = 2 * s.ratio * s.update
    stalled = (s.ratio >= 0.5) & (s.update < STALLED)
    return (s.update <= FLOOR) | (left <= NEGLIGIBLE) | stalled


def factorised(matrix: Float[Array, "k k"]) -> Callable[[Float[Array, " k"]], Float[Array, " k"]]:
    """b ↦ the solution x of matrix·x = b; the elimination is done once."""
    k = matrix.shape[0]
    if k > LARGEST_INVERSE:
        factors = lu_factor(matrix)
        return lambda b: lu_solve(factors, b)
    if k > 3:
        inverse, order = _gauss_jordan_inverse(matrix)
        return lambda b: jnp.sum(inverse * b[order][None, :], axis=1)
    inverse = _cofactor_inverse(matrix)
    return lambda b: jnp.sum(inverse * b[None, :], axis=1)


def _cofactor_inverse(matrix):
    """The inverse of a 1×1, 2×2 or 3×3 matrix by its cofactors, which fuses into one kernel."""
    if matrix.shape[0] == 1:
        return 1.0 / matrix
    if matrix.shape[0] == 2:
        (a, b), (c, d) = matrix
        return jnp.array([[d, -b], [-c, a]]) / (a * d - b * c)
    x, y, z = matrix
    columns = jnp.stack([jnp.cross(y, z), jnp.cross(z, x), jnp.cross(x, y)], axis=1)
    return columns / jnp.sum(x * columns[:, 0])


def _gauss_jordan_inverse(matrix):
    """The inverse of the matrix with its rows in `order`, and that order: elimination in place with partial pivoting, a few
    array operations a column."""
    k = matrix.shape[0]
    row, column = np.arange(k)[:, None], np.arange(k + 1)[None, :]
    # the last column says which row of the matrix stands here
    table = jnp.concatenate([matrix, jnp.arange(k, dtype=matrix.dtype)[:, None]], axis=1)
    for c in range(k):
        if c < k - 1:
            pivot = c + jnp.argmax(jnp.abs(table[c:, c]))
            upper, lower = table[c : c + 1], jax.lax.dynamic_slice_in_dim(table, pivot, 1)
            table = jnp.where(row == c, lower, jnp.where(row == pivot, upper, table))
        scaled = jnp.where(column == c, 1.0, table[c : c + 1]) / table[c, c]
        reduced = jnp.where(column == c, 0.0, table) - table[:, c : c + 1] * scaled
        table = jnp.where(column == k, table, jnp.where(row == c, scaled, reduced))
    return table[:, :k], table[:, k].astype(int)
