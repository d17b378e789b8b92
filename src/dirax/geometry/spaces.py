"""Vector spaces, tori and spheres as manifolds."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dirax.geometry.manifolds import AbstractGeodesicManifold
from dirax.geometry.squared_angles import TINY, arc_over_sine, norm, radial
from dirax.numerics.arrays import is_whole
from dirax.program.tracing import once


class AbstractFlat(AbstractGeodesicManifold):
    """R^n, or R^n modulo a lattice: geodesics are the straight lines x + tv, and every vector is tangent everywhere.

    It is an abelian group by addition, with the names that Lie groups have for theirs.
    """

    def identity(self):
        """0."""
        return jnp.zeros(self.dimension)

    def multiply(self, g, h):
        """g + h."""
        return g + h

    def group_exp(self, xi):
        """ξ."""
        return xi

    def defect(self, x):
        """0."""
        return jnp.zeros(())

    def nearest(self, x):
        """x."""
        return x

    def projection(self, x, v):
        """v."""
        return v

    def local_parametrization(self, x):
        """r ↦ x + r."""
        return lambda r: x + r

    def frame(self, x):
        """The unit matrix."""
        return jnp.eye(self.dimension)

    def coordinates(self, x, v):
        """v."""
        return v

    def exp(self, x, v):
        """x + v."""
        return x + v

    def geodesic(self, x, v, t):
        """(x + tv, v)."""
        return x + t * v, v

    def distance(self, x, y):
        """‖log(x, y)‖."""
        return norm(self.log(x, y))

    def transport(self, x, v, y):
        """v."""
        return v

    def retraction(self, x, v):
        """x + v."""
        return x + v

    def inverse_retraction(self, x, y):
        """log(x, y)."""
        return self.log(x, y)

    def retraction_reach(self, x, v):
        """That of `exp`."""
        return self.exp_reach(x, v)


class Euclidean(AbstractFlat):
    """The vector space R^n. Raises `ValueError` for n that is no whole number ≥ 0."""

    dimension: int = eqx.field(static=True)
    ambient_dimension: int = eqx.field(static=True)

    def __init__(self, dimension: int):
        self.dimension = self.ambient_dimension = _whole("Euclidean(n), the vector space R^n", dimension, 0)

    def representative(self, x, near):
        """x."""
        return x

    def log(self, x, y):
        """y − x."""
        return y - x

    def exp_reach(self, x, v):
        """0: all of R^n is reached."""
        return jnp.zeros(())


class Torus(AbstractFlat):
    """The torus T^n, a point being n angles in radians, any real numbers, equal modulo 2π; `log` is in [−π, π].

    Raises `ValueError` for n that is no whole number ≥ 1.
    """

    dimension: int = eqx.field(static=True)
    ambient_dimension: int = eqx.field(static=True)

    def __init__(self, dimension: int):
        self.dimension = self.ambient_dimension = _whole("Torus(n), the torus of n angles", dimension, 1)

    def representative(self, x, near):
        """x with whole turns added so that every angle is within π of that of `near`."""
        return near + self.log(near, x)

    def log(self, x, y):
        """y − x without whole turns, each angle in [−π, π]."""
        turns = jnp.round((y - x) / (2.0 * jnp.pi))
        return (y - x) - 2.0 * jnp.pi * turns

    def exp_reach(self, x, v):
        """The largest angle over π."""
        return jnp.max(jnp.abs(v)) / jnp.pi


def Circle() -> Torus:
    """The circle, a point being one angle in radians: `Torus(1)`."""
    return Torus(1)


class Sphere(AbstractGeodesicManifold):
    """The unit sphere S^{n−1} of R^n, n ≥ 2, in ambient coordinates, with the round metric.

    The retraction is (x + v)/‖x + v‖, and its inverse y/⟨x, y⟩ − x is defined on the open hemisphere around x.
    Raises `ValueError` for n that is no whole number ≥ 2.
    """

    dimension: int = eqx.field(static=True)
    ambient_dimension: int = eqx.field(static=True)

    def __init__(self, n: int):
        n = _whole("Sphere(n), the unit sphere of R^n", n, 2)
        self.dimension, self.ambient_dimension = n - 1, n

    def defect(self, x):
        """| ‖x‖ − 1 |."""
        return jnp.abs(norm(x) - 1.0)

    def nearest(self, x):
        """x/‖x‖."""
        return x / jnp.sqrt(jnp.dot(x, x))

    def projection(self, x, v):
        """v − ⟨x, v⟩x."""
        return v - x * jnp.dot(x, v)

    def representative(self, x, near):
        """x."""
        return x

    def local_parametrization(self, x):
        """r ↦ (x + Fr)/‖x + Fr‖ with the frame F."""
        # The frame is only a choice of coordinates, so it is held fixed under differentiation in x.
        frame = jax.lax.stop_gradient(once(orthonormal_complement)(x))
        return lambda r: self.nearest(x + frame @ r)

    def frame(self, x):
        """An orthonormal basis of the hyperplane orthogonal to x."""
        return once(orthonormal_complement)(x)

    def coordinates(self, x, v):
        """Fᵀv with the frame F."""
        return once(orthonormal_complement)(x).T @ v

    def exp(self, x, v):
        """cos‖v‖ x + sin‖v‖ v/‖v‖."""
        s = jnp.dot(v, v)
        return radial(0, s) * x + radial(1, s) * v

    def geodesic(self, x, v, t):
        """The great circle through x with velocity v: its point at time t and the velocity there."""
        s = jnp.dot(v, v)
        cosine, sine = radial(0, t * t * s), t * radial(1, t * t * s)
        return cosine * x + sine * v, cosine * v - (s * sine) * x

    def log(self, x, y):
        """(φ/sin φ)(y − cos φ x), φ the angle between x and y; of all directions to the antipode, one."""
        difference, sum_ = y - x, y + x
        near, far = jnp.dot(difference, difference) / 4.0, jnp.dot(sum_, sum_) / 4.0
        # Both differences have the same tangential part; the short one has it without cancellation.
        direction = arc_over_sine(0, near, far) * self.projection(x, jnp.where(near < far, difference, sum_))
        return jnp.where(far < TINY, jnp.pi * orthonormal_complement(x)[:, 0], direction)

    def distance(self, x, y):
        """The angle between x and y, accurate at both ends."""
        return 2.0 * jnp.arctan2(norm(y - x), norm(y + x))

    def transport(self, x, v, y):
        """v − ⟨y, v⟩(x + y)/(1 + ⟨x, y⟩), along the great circle."""
        along = 1.0 + jnp.dot(x, y)
        return v - jnp.dot(y, v) / jnp.where(along < TINY, 1.0, along) * (x + y)

    def retraction(self, x, v):
        """(x + v)/‖x + v‖."""
        return self.nearest(x + v)

    def inverse_retraction(self, x, y):
        """y/⟨x, y⟩ − x."""
        return y / jnp.dot(x, y) - x

    def exp_reach(self, x, v):
        """‖v‖/π."""
        return norm(v) / jnp.pi

    def retraction_reach(self, x, v):
        """The angle arctan‖v‖ over π/2."""
        return jnp.arctan(norm(v)) * (2.0 / jnp.pi)


def _whole(what: str, n: Any, least: int) -> int:
    if not is_whole(n) or n < least:
        raise ValueError(f"{what}, needs a whole number n ≥ {least}, but n = {n!r} came.")
    return int(n)


def orthonormal_complement(x: Float[Array, " n"]) -> Float[Array, "n n-1"]:
    """An orthonormal basis of the hyperplane orthogonal to a unit vector x: columns of the reflection of x to ±e_n."""
    identity = np.eye(x.shape[0])
    reflector = x + jnp.where(x[-1] >= 0.0, 1.0, -1.0) * identity[-1]
    scaled = reflector * (2.0 / jnp.dot(reflector, reflector))
    return jnp.asarray(identity[:, :-1]) - jnp.outer(reflector, scaled[:-1])
