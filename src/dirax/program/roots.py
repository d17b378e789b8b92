"""Roots of small systems of equations, regular or not: damped Newton with a pseudo-inverse, run to the roundoff floor."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jax.interpreters import ad
from jaxtyping import Array, Float

from dirax.numerics.newton import damped_step
from dirax.program.linear_solves import scaled_pseudo_inverse
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


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _root(residual: Callable, max_steps: int, guess, *captured):
    """The root for a residual of the unknowns and of what it captured."""
    of_captured = residual
    residual = lambda u: of_captured(u, *captured)

    def step(carry):
        u, _, count = carry
        inverse, units = scaled_pseudo_inverse(jacobian(residual)(u))
        u, going = damped_step(lambda u: inverse @ residual(u), u, units, jnp)
        return u, going, count + 1

    unfinished = lambda carry: carry[1] & (carry[2] < max_steps)
    return lax.while_loop(unfinished, step, (guess, jnp.array(True), 0))[0]


@_root.defjvp
def _root_jvp(residual, max_steps, primals, tangents):
    u = _root(residual, max_steps, *primals)
    return u, _tangent(residual, u, primals[1:], tangents[1:])


def _tangent(residual: Callable, u, captured, tangents):
    """The root's derivative by the implicit function theorem; the guess has no influence."""
    along = jax.jvp(lambda *values: residual(u, *values), tuple(captured), tuple(tangents))[1] if captured else 0.0 * u
    inverse, _ = scaled_pseudo_inverse(jacobian(residual)(u, *captured))
    return -(inverse @ along)


def _unknowns_first(residual: ClosedJaxpr) -> Callable:
    return lambda u, *captured: jaxpr_as_fun(residual)(*captured, u)[0]


def _by_jax(*operands, residual: ClosedJaxpr, max_steps: int):
    *captured, guess = operands
    return [_root(_unknowns_first(residual), max_steps, guess, *captured)]


def _root_p_tangents(primals, tangents, *, residual: ClosedJaxpr, max_steps: int):
    u = root_p.bind(*primals, residual=residual, max_steps=max_steps)[0]
    along = map(ad.instantiate_zeros, tangents[:-1])
    return [u], [_tangent(_unknowns_first(residual), u, primals[:-1], tuple(along))]


root_p = plain_primitive("dirax_root", _by_jax, lambda *operands, **_: [operands[-1]])
"""The root of a jaxpr of (*captured, unknowns) from the last operand on, the others being what it captured."""
ad.primitive_jvps[root_p] = _root_p_tangents
