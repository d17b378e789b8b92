"""Newton's method run to the roundoff floor, differentiable by the implicit function theorem."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from dirax.engines.linear_solver import AbstractLinearSolver
from dirax.engines.stopping import CONTRACTING, FLOOR, NEAR, NEGLIGIBLE, OWN, STALLED
from dirax.engines.xla.dense import Dense
from dirax.program.derivatives_by_jax import jacobian_by_jax
from dirax.program.given_tangents import implicit


class Search(NamedTuple):
    """Where the iteration stands: the unknowns, and (the last update relative to |u_i| + size_i, its ratio to the
    update before, the number of updates, the update relative to |u_i| + OWN·size_i, the number of updates from the first guess
    where that led nowhere) as one array, which costs XLA one kernel and not five."""

    u: Float[Array, " k"]
    measures: Float[Array, "5"]

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

    @property
    def own(self) -> Float[Array, ""]:
        """inf before the first update."""
        return self.measures[3]

    @property
    def spent(self) -> Float[Array, ""]:
        """Those from the first guess, a whole number; 0 where the iteration is from there."""
        return self.measures[4]


def begun(u: Float[Array, " k"], spent: Any = 0.0) -> Search:
    """Before the first update."""
    return Search(u, jnp.stack([jnp.inf, jnp.nan, 0.0, jnp.inf, spent]))


def newton_root(
    residual: Callable[..., Float[Array, " k"]],
    guess: Float[Array, " k"],
    args: tuple[Any, ...],
    max_iterations: int,
    sizes: Float[Array, " k"] | None = None,
    running: Any = True,
    jacobian: Callable[..., Any] | None = None,
    linear_solver: AbstractLinearSolver | None = None,
    other: Float[Array, " k"] | None = None,
) -> tuple[Float[Array, " k"], Int[Array, ""], Bool[Array, ""]]:
    """(u, number of updates, converged) of residual(u, *args) = 0; not for reverse mode, see `as_function`.

    `sizes` are those of the unknowns (`dirax/engines/sizes.py`), 1 where they are not given. The guess comes
    back where `running` is false. `jacobian(u, *args)` is that of the residual, derived here where it is not given, or what
    `linear_solver` takes for it, without sizes; that is `Dense()` where none is. Where the guess leads nowhere the iteration
    begins once more, from the `other` one.
    """
    if guess.shape[0] == 0:
        return guess, jnp.zeros((), jnp.int64), jnp.array(True)
    equation = lambda u: residual(u, *args)
    slopes = (lambda u: jacobian(u, *args)) if jacobian else jacobian_by_jax(equation)
    found = newton(equation, slopes, linear_solver or Dense(), guess, other, max_iterations, sizes, running)
    return found.u, (found.updates + found.spent).astype(int), at_floor(found)


def as_function(
    residual: Callable[..., Float[Array, " k"]],
    root: Float[Array, " k"],
    args: tuple[Any, ...],
    linear_solver: AbstractLinearSolver | None = None,
    jacobian: Callable[..., Any] | None = None,
    sizes: Float[Array, " k"] | None = None,
) -> Float[Array, " k"]:
    """`root`, with its derivatives as the function of args that residual(root, *args) = 0 makes of it; `jacobian` where the
    solver takes another matrix than a dense one, `sizes` of the unknowns as above."""
    if root.shape[0] == 0:
        return root

    solver = linear_solver or Dense()

    if jacobian is not None:

        def by_jacobian(linear, right):
            factors = solver.factorise(jax.lax.stop_gradient(jacobian(root, *args)))
            solve, transposed = (lambda _, b, by=by: by(factors, b) for by in (solver.solve, solver.solve_transposed))
            return jax.lax.custom_linear_solve(linear, right, solve, transposed)

        return jax.lax.custom_root(lambda u: residual(u, *args), root, lambda _, u: u, by_jacobian)

    def solved(matrix, right, *present):
        rows, unit = jax.lax.stop_gradient(matrix), 1.0
        if present:
            rows, unit = solver.in_units(rows, *present)
        factors = solver.factorise(rows)
        solve = lambda _, b: solver.solve(factors, unit * b)
        transposed = lambda _, b: unit * solver.solve_transposed(factors, b)
        return jax.lax.custom_linear_solve(lambda x: matrix @ x, right, solve, transposed)

    present = () if sizes is None else (jnp.abs(root) + sizes,)
    return implicit(lambda u, args: residual(u, *args), root, args, solved, *present)


def newton(
    equation: Callable,
    jacobian: Callable,
    linear_solver: AbstractLinearSolver,
    guess: Float[Array, " k"],
    other: Float[Array, " k"] | None,
    max_iterations: int,
    sizes: Float[Array, " k"] | None,
    running: Any,
) -> Search:
    """Newton's method in which a Jacobian serves several updates while they contract quickly, and is renewed otherwise; from
    the guess, and from the other one, if there is one, where that leads nowhere."""
    size = 1.0 if sizes is None else sizes

    def updated(s: Search, factors: Any, unit: Any) -> Search:
        change = linear_solver.solve(factors, unit * equation(s.u))
        u = s.u - change
        of_size, of_own = (jnp.abs(change) / (jnp.abs(u) + share * size) for share in (1.0, OWN))
        update, own = folded((of_size, jnp.maximum, 0.0), (of_own, jnp.maximum, 0.0))
        ratio = jnp.where(s.updates > 0, update / jnp.minimum(s.update, 1.0), jnp.nan)
        return Search(u, jnp.stack([update, ratio, s.updates + 1, own, s.spent]))

    lost = lambda s: jnp.isnan(s.update) | (s.updates >= max_iterations)

    def unfinished(s: Search):
        return running & ~at_floor(s) & ~(lost(s) & ((s.spent > 0) | (other is None)))

    def contracting(s: Search):
        little = jnp.where(jnp.isnan(s.ratio), s.update < NEAR, s.update < STALLED)
        return running & ~at_floor(s) & ~lost(s) & ((s.ratio < CONTRACTING) | little)

    def with_new_jacobian(s: Search) -> Search:
        if other is not None:
            s = jax.tree.map(lambda a, b: jnp.where(lost(s), a, b), begun(other, s.updates), s)
        matrix, unit = jacobian(s.u), 1.0
        if sizes is not None:
            matrix, unit = linear_solver.in_units(matrix, jnp.abs(s.u) + sizes)
        factors = linear_solver.factorise(matrix)
        return jax.lax.while_loop(contracting, lambda s: updated(s, factors, unit), updated(s, factors, unit))

    return jax.lax.while_loop(unfinished, with_new_jacobian, begun(guess))


def folded(*parts: tuple[Float[Array, " k"], Callable, float]) -> tuple[Float[Array, ""], ...]:
    """Each array folded by its function, from its beginning on: all in one loop, which takes XLA half the time of two."""
    arrays, functions, begun = zip(*parts, strict=True)
    both = lambda a, b: tuple(f(x, y) for f, x, y in zip(functions, a, b, strict=True))
    return jax.lax.reduce(arrays, tuple(jnp.asarray(x, float) for x in begun), both, (0,))


def at_floor(s: Search) -> Bool[Array, ""]:
    """Whether another update would gain nothing: `dirax/engines/stopping.py`."""
    left = 2 * s.ratio * s.update
    stalled = (s.ratio >= 0.5) & (s.update < STALLED)
    rounded = (s.update <= FLOOR) & ~(2 * s.ratio * s.own > FLOOR)
    return rounded | (left <= NEGLIGIBLE) | stalled
