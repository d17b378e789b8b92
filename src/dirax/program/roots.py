"""Roots of small systems of equations by Newton's method, run to the roundoff floor: the nearest one, damped and with a
pseudo-inverse, and that of a regular system."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jax.interpreters import ad
from jaxtyping import Array, Float

from dirax.numerics.newton import damped_step, sizes_of_unknowns
from dirax.numerics.sparse import FEWEST_SPARSE
from dirax.numerics.tolerances import TINY
from dirax.program.given_tangents import implicit, implicit_tangent
from dirax.program.linear_solves import equilibrated_inverse, scaled_pseudo_inverse
from dirax.program.primitives import binds, plain_primitive
from dirax.program.tracing import closed_over, jacobian


def nearest_root(residual: Callable, guess: Float[Array, " k"], max_steps: int = 100) -> Float[Array, " k"]:
    """A root of `residual` (k,) → (k,) near `guess`; where it has several, that of the least changes from the guess.

    A step is halved until the next one would be shorter, so that the units of the equations and of the unknowns do not
    matter and the domain of `residual` is not left. Where there is no root, the last point that was an improvement comes
    back, so check the residual if that can happen. Differentiable any number of times, by the implicit function theorem.
    """
    guess = jnp.asarray(guess)
    if binds(guess):
        closed, captured, result = closed_over(residual, [guess])
        if all(jnp.result_type(x) == jnp.float64 for x in (result, *captured)):
            return root_p.bind(*captured, guess, residual=closed, max_steps=max_steps)[0]
    residual, captured = jax.closure_convert(residual, guess)
    return _root(jax.jit(residual), max_steps, guess, *captured)


def _root(residual: Callable, max_steps: int, guess, *captured):
    """The root for a residual of the unknowns and of what it captured."""
    fixed = lax.stop_gradient(captured)
    of_unknowns = lambda u: residual(u, *fixed)

    sparse = sparse_equations(residual, guess, *captured)
    inverse_at = _least_changes(of_unknowns) if sparse is None else _by_elimination(of_unknowns, sparse)

    def step(carry):
        u, _, count = carry
        value = of_unknowns(u)
        inverse, units, sizes = inverse_at(u, value)
        u, going = damped_step(inverse(value), lambda u: inverse(of_unknowns(u)), u, units, sizes, jnp)
        return u, going, count + 1

    unfinished = lambda carry: carry[1] & (carry[2] < max_steps)
    root = lax.while_loop(unfinished, step, (lax.stop_gradient(guess), jnp.array(True), 0))[0]
    if sparse is not None:
        return sparse.root(lambda u: residual(u, *captured), root)
    return implicit(lambda u, captured: residual(u, *captured), root, captured, _least_change)


def _least_change(matrix, right):
    """The solution of a linear system, regular or not, in the units of its equations and unknowns."""
    return scaled_pseudo_inverse(matrix) @ right


def _least_changes(equations: Callable) -> Callable:
    """(u, r(u)) ↦ (right-hand side ↦ solution of least size with the Jacobian of the `equations` r at u, units and sizes of the
    unknowns)."""

    def at(u, value):
        matrix = jacobian(equations)(u)
        inverse, units = equilibrated_inverse(jnp, matrix)
        return (lambda right: inverse @ right), units, sizes_of_unknowns(matrix, inverse, u, value, jnp)

    return at


def _by_elimination(equations: Callable, sparse: Any) -> Callable:
    """The same of many unknowns, by sparse elimination."""

    def at(u, value):
        factors = sparse.factorise(sparse.values(equations, u))
        size = jnp.full(u.shape, jnp.max(jnp.abs(u), initial=TINY))
        return (lambda right: sparse.solve(factors, right)), jnp.ones(u.shape), size

    return at


def sparse_equations(residual: Callable, unknowns: Any, *others: Any) -> Any:
    """What is known of the sparse Jacobian of residual(unknowns, *others); None for few unknowns, or where it is not sparse."""
    if unknowns.shape[0] < FEWEST_SPARSE or jax.default_backend() != "cpu":
        return None
    from dirax.numerics.sparse.elimination import StructurallySingular  # imported when it is used
    from dirax.program.sparse_equations import SparseEquations
    from dirax.program.sparsity import Dense

    try:
        found = SparseEquations.of(residual, unknowns, *others)
    except (Dense, StructurallySingular):
        return None
    return found if found.slower is None else None


def regular_root(
    residual: Callable, guess: Float[Array, " k"], tolerance: float = 1e-9, max_steps: int = 40
) -> Float[Array, " k"]:
    """A root of `residual` (k,) → (k,) with a regular Jacobian, as `nearest_root` finds it; NaN where it finds none: where the
    residual is above `tolerance`, relative to 1 + ‖root‖."""
    if guess.shape[0] == 0:
        return guess
    root = nearest_root(residual, guess, max_steps)
    missed = jnp.max(jnp.abs(lax.stop_gradient(residual(root))))
    return jnp.where(missed <= tolerance * (1.0 + jnp.max(jnp.abs(root))), root, jnp.nan)


def _unknowns_first(residual: ClosedJaxpr) -> Callable:
    return lambda u, *captured: jaxpr_as_fun(residual)(*captured, u)[0]


def _by_jax(*operands, residual: ClosedJaxpr, max_steps: int):
    *captured, guess = operands
    return [_root(_unknowns_first(residual), max_steps, guess, *captured)]


def _root_p_tangents(primals, tangents, *, residual: ClosedJaxpr, max_steps: int):
    if primals[-1].shape[0] >= FEWEST_SPARSE:
        return _as_plain(primals, tangents, residual=residual, max_steps=max_steps)
    u = root_p.bind(*primals, residual=residual, max_steps=max_steps)[0]
    along = [None if isinstance(t, ad.Zero) else t for t in tangents[:-1]]
    return [u], [implicit_tangent(_unknowns_first(residual), u, primals[:-1], along, _least_change)]


root_p = plain_primitive("dirax_root", _by_jax, lambda *operands, **_: [operands[-1]])
"""The root of a jaxpr of (*captured, unknowns) from the last operand on, the others being what it captured."""
_as_plain = ad.primitive_jvps[root_p]
ad.primitive_jvps[root_p] = _root_p_tangents
