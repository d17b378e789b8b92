"""Roots of small systems of equations by Newton's method, run to the roundoff floor: the nearest one, damped and with a
pseudo-inverse, and that of a regular system."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jax.interpreters import ad, batching
from jaxtyping import Array, Float

from dirax.numerics.newton import damped_step, sizes_of_unknowns
from dirax.numerics.sparse import FEWEST_SPARSE
from dirax.numerics.tolerances import TINY
from dirax.program.given_tangents import Axes, implicit, implicit_tangent, lead_of, over, stays_one, tangent_over
from dirax.program.linear_solves import equilibrated_inverse, scaled_pseudo_inverse
from dirax.program.primitives import binds, plain_primitive
from dirax.program.tracing import closed_over, jacobian


def nearest_root(residual: Callable, guess: Float[Array, " k"], max_steps: int = 100, strict: bool = False) -> Float[Array, " k"]:
    """A root of `residual` (k,) → (k,) near `guess`; where it has several, that of the least changes from the guess.

    A step is halved until the next one would be shorter, so that the units of the equations and of the unknowns do not
    matter and the domain of `residual` is not left. Where there is no root, the last point that was an improvement comes
    back, so check the residual if that can happen; `strict`: NaN where steps do not become small there. Differentiable any
    number of times, by the implicit function theorem.
    """
    guess = jnp.asarray(guess)
    if binds(guess):
        closed, captured, result = closed_over(residual, [guess])
        if all(jnp.result_type(x) == jnp.float64 for x in (result, *captured)):
            return root_p.bind(*captured, guess, residual=closed, max_steps=max_steps, strict=strict, axes=())[0]
    residual, captured = jax.closure_convert(residual, guess)
    return _root(jax.jit(residual), max_steps, strict, guess, *captured)


def _root(residual: Callable, max_steps: int, strict: bool, guess, *captured):
    """The root for a residual of the unknowns and of what it captured."""
    fixed = lax.stop_gradient(captured)
    of_unknowns = lambda u: residual(u, *fixed)

    sparse = sparse_equations(residual, guess, *captured)
    inverse_at = _least_changes(of_unknowns) if sparse is None else _by_elimination(of_unknowns, sparse)

    def step(carry):
        u, _, _, count = carry
        value = of_unknowns(u)
        inverse, units, sizes = inverse_at(u, value)
        u, going, near = damped_step(inverse(value), lambda u: inverse(of_unknowns(u)), u, units, sizes, jnp)
        return u, near, going, count + 1

    unfinished = lambda carry: carry[2] & (carry[3] < max_steps)
    begun = lax.stop_gradient(guess), jnp.array(False), jnp.array(True), 0
    root, near, *_ = lax.while_loop(unfinished, step, begun)
    root = jnp.where(near, root, jnp.nan) if strict else root
    if sparse is not None:
        return sparse.root(lambda u: residual(u, *captured), root)
    return implicit(lambda u, captured: residual(u, *captured), root, captured, least_change)


def least_change(matrix: Float[Array, "k k"], right: Float[Array, " k"]) -> Float[Array, " k"]:
    """The solution of linear equations, regular or not, in the units of its equations and unknowns."""
    return least_change_p.bind(matrix, right, axes=())[0] if binds(matrix, right) else scaled_pseudo_inverse(matrix) @ right


def _least_change_by_jax(matrix, right, *, axes: Axes):
    return [over(lambda matrix, right: scaled_pseudo_inverse(matrix) @ right, axes)(matrix, right)]


def _least_change_tangents(primals, tangents, *, axes: Axes):
    """x' of A x = b is the solution of A x' = b' − A'x."""
    (matrix, right), (along_matrix, along_right) = primals, map(ad.instantiate_zeros, tangents)
    (x,) = least_change_p.bind(matrix, right, axes=axes)
    return [x], least_change_p.bind(matrix, along_right - over(jnp.matmul, axes)(along_matrix, x), axes=axes)


def _least_change_transposed(along, matrix, right, *, axes: Axes):
    return [None, least_change_p.bind(jnp.swapaxes(matrix, -1, -2), along[0], axes=axes)[0]]


def _least_change_batched(operands, dimensions, *, axes: Axes):
    """Right-hand sides have every axis."""
    (matrix, right), (of_matrix, of_right) = operands, dimensions
    if of_right is None:
        right, of_right = jnp.broadcast_to(right, (matrix.shape[of_matrix], *right.shape)), 0
    return stays_one(least_change_p)((matrix, right), (of_matrix, of_right), axes=axes)


least_change_p = plain_primitive("dirax_least_change", _least_change_by_jax, lambda a, b, **_: [ShapedArray(b.shape, b.dtype)])
ad.primitive_jvps[least_change_p] = _least_change_tangents
ad.primitive_transposes[least_change_p] = _least_change_transposed
batching.primitive_batchers[least_change_p] = _least_change_batched


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


def _by_jax(*operands, residual: ClosedJaxpr, max_steps: int, strict: bool, axes: Axes):
    one = lambda *operands: _root(_unknowns_first(residual), max_steps, strict, operands[-1], *operands[:-1])
    return [over(one, axes)(*operands)]


def _shapes(*operands, residual: ClosedJaxpr, axes: Axes, **_):
    (one,) = residual.out_avals
    return [ShapedArray((*lead_of(operands, axes), *one.shape), one.dtype)]


def _root_p_tangents(primals, tangents, *, residual: ClosedJaxpr, axes: Axes, **options):
    if residual.out_avals[0].shape[0] >= FEWEST_SPARSE:
        return _as_plain(primals, tangents, residual=residual, axes=axes, **options)
    u = root_p.bind(*primals, residual=residual, axes=axes, **options)[0]
    one = lambda u, captured, along: implicit_tangent(_unknowns_first(residual), u, captured, along, least_change)
    return [u], [tangent_over(one, u, primals[:-1], tangents[:-1], tuple(level[:-1] for level in axes))]


root_p = plain_primitive("dirax_root", _by_jax, _shapes)
"""The root of a jaxpr of (*captured, unknowns) from the last operand on, the others being what it captured."""
_as_plain = ad.primitive_jvps[root_p]
ad.primitive_jvps[root_p] = _root_p_tangents
batching.primitive_batchers[root_p] = stays_one(root_p)
