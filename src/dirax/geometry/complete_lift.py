"""Two-forms lifted to the tangent bundle, and when a discretization map is symplectic for one ([BLM] Proposition 6.2)."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from dirax.geometry.maps import AbstractDiscretizationMap
from dirax.program.tracing import once
from dirax.program.user_functions import UserFunction, evaluated

Form = Float[Array, "k k"]


def complete_lift(two_form: Callable, x: ArrayLike, v: ArrayLike) -> Form:
    """d_T ω at (x, ẋ): the matrix (2n, 2n), in the order (x, ẋ), of the complete lift to TM of a two-form ω on M = R^n.

    `two_form(x)` is the matrix (n, n) with ω_ij = ω(e_i, e_j), such as `two_form` of a `dx.PhaseSpaceLagrangian`; then
    d_T ω = [[ẋ·∂ω, ω], [ω, 0]] ([BLM] (19) for ω = dα). Raises `ValueError` for shapes that do not belong together.
    """
    x, v = _checked(two_form, x, v)
    return jnp.asarray(evaluated(once(_lift, two_form), x, v))


def _lift(two_form: Callable, x: Array, v: Array) -> Form:
    value, along = jax.jvp(_form(two_form, x), (x,), (v,))
    return jnp.block([[along, value], [value, jnp.zeros_like(value)]])


def symplectic_equations(map: AbstractDiscretizationMap, two_form: Callable, x: ArrayLike, v: ArrayLike) -> tuple[Array, ...]:
    """By how much a discretization map misses (16), (17) and (18) of [BLM] Proposition 6.2 at (x, ẋ): three matrices (n, n).

    They are the blocks dx ∧ dx, dx ∧ dẋ and dẋ ∧ dẋ of R_d*(−ω ⊕ ω) − d_T ω, all zero where R_d is symplectic from
    (TM, d_T ω) to (M × M, −ω ⊕ ω), so that steps preserve ω. `map` is one on R^n, `two_form` as in `complete_lift`. Raises
    `ValueError` as that does.

        dx.symplectic_equations(dx.Midpoint(), vortices.two_form, q, v)     # zeros where dα is constant
    """
    x, v = _checked(two_form, x, v)
    return tuple(jnp.asarray(block) for block in evaluated(once(_equations, map, two_form), x, v))


def _equations(map: AbstractDiscretizationMap, two_form: Callable, x: Array, v: Array) -> tuple[Array, ...]:
    form, n = _form(two_form, x), x.shape[0]
    pair = lambda z: jnp.concatenate(map.forward(z[:n], z[n:]))
    (x0, x1), slopes = map.forward(x, v), jax.jacfwd(pair)(jnp.concatenate([x, v]))
    first, last = slopes[:n], slopes[n:]
    missed = last.T @ form(x1) @ last - first.T @ form(x0) @ first - _lift(two_form, x, v)
    return missed[:n, :n], missed[:n, n:], missed[n:, n:]


def _checked(two_form: Callable, x: ArrayLike, v: ArrayLike) -> tuple[Array, Array]:
    x, v = jnp.asarray(x, dtype=float), jnp.asarray(v, dtype=float)
    if x.ndim != 1 or v.shape != x.shape:
        raise ValueError(f"x and v must be a point and a vector of one length, but their shapes are {x.shape} and {v.shape}.")
    _form(two_form, x)
    return x, v


def _form(two_form: Callable, x: Array) -> Callable:
    form = UserFunction(two_form, "two_form", ("x",)).returning((x.shape[0], x.shape[0]))
    return lambda x: form(x, None)
