"""Numerical building blocks of geometry: functions of a squared angle that are smooth at 0, and a small Newton root.

Lengths and angles enter geometry through their squares, which are smooth where the norm is not. Each function knows its
own derivative, so that derivatives of any order are accurate and finite, and cost little to compile.
"""

import math
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import TypeAlias

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from dirax.tracing import call

Scalar: TypeAlias = Float[Array, ""]

TINY = 1e-30  # a squared distance below which two points of the unit sphere are the same in float64
NO_ANGLE = 1e-200  # a squared angle below which its cosine is 1, and 1/√s still far from overflow
RADIAL_SERIES_BELOW = 4.0  # 13 terms of the series reach 1e-19 here
ARC_SERIES_BELOW = 0.05  # 18 terms of the series reach 1e-20 here, those of its third derivative 1e-16


def radial(order: int, s: Scalar) -> Scalar:
    """The functions f_0(s) = cos √s, f_1(s) = sin √s/√s, f_{n+1} = −2 f_n', of a squared angle s ≥ 0 in radians².

    f_n(x²) = j_{n−1}(x)/x^{n−1} with the spherical Bessel functions j, so f_{n+1} = ((2n − 1) f_n − f_{n−1})/s.
    """
    return call(_of_order(_radial, order), s)


@lru_cache
def _of_order(function: Callable, order: int) -> Callable:
    """The same object for the same order, so that the function of an order is traced once."""
    return partial(function, order)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _radial(order: int, s: Scalar) -> Scalar:
    if order <= 1:
        # finite also for a derivative that is taken through the root, as that of a scalar graph is
        none = s < NO_ANGLE
        root = jnp.sqrt(jnp.where(none, 1.0, s))
        return jnp.where(none, 1.0, jnp.cos(root) if order == 0 else jnp.sin(root) / root)

    def by_recurrence(s):
        before, value = jnp.cos(jnp.sqrt(s)), jnp.sin(jnp.sqrt(s)) / jnp.sqrt(s)
        for n in range(1, order):
            before, value = value, ((2 * n - 1) * value - before) / s
        return value

    odd_factorial = math.prod(range(1, 2 * order, 2))
    coefficients = [1.0 / odd_factorial]
    for k in range(1, 13):
        coefficients.append(coefficients[-1] * -0.5 / (k * (2 * order - 1 + 2 * k)))
    return _piecewise(s, RADIAL_SERIES_BELOW, coefficients, by_recurrence)


@_radial.defjvp
def _radial_jvp(order, primals, tangents):
    return radial(order, *primals), -0.5 * radial(order + 1, *primals) * tangents[0]


def arc_over_sine(order: int, near: Scalar, far: Scalar) -> Scalar:
    """F = φ/sin φ for an arc 0 ≤ φ < π, as a function of near = sin²(φ/2) (its derivative F^(order)); far = cos²(φ/2).

    For points of a unit sphere near and far are |y − x|²/4 and |y + x|²/4, each accurate at its own end of the arc.
    F is the hypergeometric function F(1, 1; 3/2; near). Right up to φ = π − 10⁻¹⁵, and some finite number beyond.
    """
    return call(_of_order(_arc_over_sine, order), near, far)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _arc_over_sine(order: int, near: Scalar, far: Scalar) -> Scalar:
    far = jnp.where(far < TINY, 1.0, far)

    def by_recurrence(near):
        root = jnp.sqrt(near * far)
        before = jnp.arctan2(jnp.sqrt(near), jnp.sqrt(far)) / root
        value = (1.0 - (far - near) * before) / (2.0 * near * far)
        for n in range(order - 1):
            slope = (1.5 + n) - (3.0 + 2.0 * n) * near
            before, value = value, ((1.0 + n) ** 2 * before - slope * value) / (near * far)
        return before if order == 0 else value

    if order == 0:
        return jnp.where(near == 0.0, 1.0, by_recurrence(jnp.where(near == 0.0, 1.0, near)))
    taylor = [4.0**k * math.factorial(k) ** 2 / math.factorial(2 * k + 1) for k in range(18 + order)]
    coefficients = [taylor[k] * math.perm(k, order) for k in range(order, len(taylor))]
    return _piecewise(near, ARC_SERIES_BELOW, coefficients, by_recurrence)


@_arc_over_sine.defjvp
def _arc_over_sine_jvp(order, primals, tangents):
    # near + far = 1, so F is a function of near alone.
    return arc_over_sine(order, *primals), arc_over_sine(order + 1, *primals) * tangents[0]


def _piecewise(s: Scalar, below: float, coefficients: Sequence[float], otherwise: Callable) -> Scalar:
    near, far = jnp.where(s < below, s, 0.0), jnp.where(s < below, below, s)
    series = jnp.full_like(near, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        series = series * near + coefficient
    return jnp.where(s < below, series, otherwise(far))


def norm(v: Float[Array, " n"]) -> Scalar:
    """Euclidean norm with derivative 0, instead of NaN, at v = 0."""
    s = jnp.sum(v * v)
    return jnp.where(s == 0.0, 0.0, jnp.sqrt(jnp.where(s == 0.0, 1.0, s)))


def newton_root(
    residual: Callable, guess: Float[Array, " k"], tolerance: float = 1e-9, max_steps: int = 40
) -> Float[Array, " k"]:
    """A root of `residual` (k,) → (k,) by Newton's method to the roundoff floor; NaN where it does not converge.

    Traceable, and differentiable any number of times, forwards and backwards, by the implicit function theorem.
    `tolerance` is on the last residual, relative to 1 + ‖root‖.
    """

    def solve(residual, guess):
        def step(carry):
            z, size, _, count = carry
            update = jnp.linalg.solve(jax.jacfwd(residual)(z), residual(z))
            return z - update, jnp.max(jnp.abs(update)), size, count + 1

        def unfinished(carry):
            _, size, previous, count = carry
            still_shrinking = (size < 0.5 * previous) | (size > 1e-6)
            return (count < max_steps) & (size > 0.0) & still_shrinking

        start = (guess, jnp.asarray(1e300), jnp.asarray(jnp.inf), 0)
        z, *_ = lax.while_loop(unfinished, step, start)
        converged = jnp.max(jnp.abs(residual(z))) <= tolerance * (1.0 + jnp.max(jnp.abs(z)))
        return jnp.where(converged, z, jnp.nan)

    def tangent_solve(linear, right_side):
        return jnp.linalg.solve(jax.jacfwd(linear)(jnp.zeros_like(right_side)), right_side)

    return lax.custom_root(residual, guess, solve, tangent_solve)
