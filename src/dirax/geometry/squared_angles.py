"""Numerical building blocks of geometry: functions of a squared angle that are smooth at 0.

Lengths and angles enter geometry through their squares, which are smooth where the norm is not. Each function knows its
own derivative, so that derivatives of any order are accurate and finite, and cost little to compile.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.program.formula import Formula
from dirax.program.tracing import once

Scalar: TypeAlias = Float[Array, ""]

TINY = 1e-30  # a squared distance below which two points of the unit sphere are the same in float64
RADIAL_SERIES = 4.0, 13  # below it so many terms of the series reach 1e-19
ARC_SERIES = 0.05, 18  # so many terms reach 1e-20, those of the third derivative 1e-16
# Of f_0, f_1 and F themselves, which are accurate elsewhere: through √s rounding would seem to move them by all that s is off.
RADIAL_SERIES_AT_REST = 1e-3, 4
ARC_SERIES_AT_REST = 1e-4, 5


def radial(order: int, s: Scalar) -> Scalar:
    """The functions f_0(s) = cos √s, f_1(s) = sin √s/√s, f_{n+1} = −2 f_n', of a squared angle s ≥ 0 in radians².

    f_n(x²) = j_{n−1}(x)/x^{n−1} with the spherical Bessel functions j, so f_{n+1} = ((2n − 1) f_n − f_{n−1})/s.
    """
    return Radial(order)(s)


@dataclass(frozen=True)
class Radial(Formula):
    """f_n of `radial` as a formula with a derivative of its own, −f_{n+1}/2."""

    order: int

    def value(self, xp, x):
        """f_n(s): its series near 0, the recurrence elsewhere."""
        (s,), order = x, self.order
        below, terms = RADIAL_SERIES if order > 1 else RADIAL_SERIES_AT_REST

        def by_recurrence(s):
            root = xp.sqrt(s)
            if order == 0:
                return xp.cos(root)
            before, value = xp.cos(root), xp.sin(root) / root
            for n in range(1, order):
                before, value = value, ((2.0 * n - 1.0) * value - before) / s
            return value

        odd_factorial = math.prod(range(1, 2 * order, 2))
        coefficients = [1.0 / odd_factorial]
        for k in range(1, terms):
            coefficients.append(coefficients[-1] * -0.5 / (k * (2 * order - 1 + 2 * k)))
        return _piecewise(xp, s, below, coefficients, by_recurrence)

    def slopes(self):
        """−½ f_{n+1}."""
        return ((-0.5, Radial(self.order + 1)),)


def arc_over_sine(order: int, near: Scalar, far: Scalar) -> Scalar:
    """F = φ/sin φ for an arc 0 ≤ φ < π, as a function of near = sin²(φ/2) (its derivative F^(order)); far = cos²(φ/2).

    For points of a unit sphere near and far are |y − x|²/4 and |y + x|²/4, each accurate at its own end of the arc.
    F is the hypergeometric function F(1, 1; 3/2; near). Right up to φ = π − 10⁻¹⁵, and some finite number beyond.
    """
    return ArcOverSine(order)(near, far)


@dataclass(frozen=True)
class ArcOverSine(Formula):
    """F^(n) of `arc_over_sine` as a formula with a derivative of its own."""

    order: int

    def value(self, xp, x):
        """F^(n): its series near 0, the recurrence of the hypergeometric function elsewhere."""
        (near, far), order = x, self.order
        below, terms = ARC_SERIES if order else ARC_SERIES_AT_REST
        far = xp.where(far < TINY, 1.0, far)

        def by_recurrence(near):
            root = xp.sqrt(near * far)
            before = xp.arctan2(xp.sqrt(near), xp.sqrt(far)) / root
            if order == 0:
                return before
            value = (1.0 - (far - near) * before) / (2.0 * near * far)
            for n in range(order - 1):
                slope = (1.5 + n) - (3.0 + 2.0 * n) * near
                before, value = value, ((1.0 + n) ** 2 * before - slope * value) / (near * far)
            return value

        taylor = [4.0**k * math.factorial(k) ** 2 / math.factorial(2 * k + 1) for k in range(terms + order)]
        coefficients = [taylor[k] * math.perm(k, order) for k in range(order, len(taylor))]
        return _piecewise(xp, near, below, coefficients, by_recurrence)

    def slopes(self):
        """F^(n+1), by the first argument alone."""
        return (1.0, ArcOverSine(self.order + 1)), None  # near + far = 1, so F is a function of near alone


def _piecewise(xp: Any, s: Any, below: float, coefficients: Sequence[float], otherwise: Callable) -> Any:
    near, far = xp.where(s < below, s, 0.0), xp.where(s < below, below, s)
    series = coefficients[-1]
    for coefficient in coefficients[-2::-1]:
        series = series * near + coefficient
    return xp.where(s < below, series, otherwise(far))


def norm(v: Float[Array, " n"]) -> Scalar:
    """Euclidean norm with derivative 0, instead of NaN, at v = 0."""
    return once(_norm)(v)


def _norm(v: Float[Array, " n"]) -> Scalar:
    s = jnp.sum(v * v)
    return jnp.where(s == 0.0, 0.0, jnp.sqrt(jnp.where(s == 0.0, 1.0, s)))
