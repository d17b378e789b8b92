"""Manifolds as objects: points, tangent vectors, exponentials and retractions, in the coordinates of an ambient R^N.

A point is a vector x (N,), a tangent vector a vector v (N,) of the tangent space at x. A covector p (N,) at x is the
tangent vector that represents it under the inner product of R^N, so ⟨p, v⟩ = p·v. Every function takes one point;
batches go through `jax.vmap`. The vocabulary is that of pymanopt and ManifoldsBase.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from dirax.functions import evaluated, is_traced
from dirax.geometry.numerics import TINY, Scalar, arc_over_sine, norm, radial

Vector: TypeAlias = Float[Array, " N"]


class AbstractManifold(eqx.Module):
    """A manifold of some `dimension` in R^N, N = `ambient_dimension`: what a scheme needs to put unknowns on it."""

    dimension: eqx.AbstractVar[int]
    ambient_dimension: eqx.AbstractVar[int]

    @abstractmethod
    def defect(self, x: Vector) -> Scalar:
        """How far x is from the manifold: 0 on it, about the distance near it."""

    @abstractmethod
    def nearest(self, x: Vector) -> Vector:
        """A point on the manifold near x, x itself when it is on the manifold: takes roundoff away."""

    @abstractmethod
    def projection(self, x: Vector, v: Vector) -> Vector:
        """The projection of an ambient vector v to the tangent space at x, linear in v (orthogonal unless stated)."""

    @abstractmethod
    def representative(self, x: Vector, near: Vector) -> Vector:
        """The coordinates of the point x nearest to `near`, where a point has several (angles, ±quaternions)."""

    @abstractmethod
    def local_parametrization(self, x: Vector) -> Callable[[Float[Array, " d"]], Vector]:
        """A smooth map r (d,) ↦ point near x, 0 ↦ x, invertible near 0: unknowns of intrinsic dimension.

        Its values are on the manifold to roundoff whatever r is, also after millions of steps.
        """

    @abstractmethod
    def frame(self, x: Vector) -> Float[Array, "N d"]:
        """A basis of the tangent space at x, as columns: the derivative at 0 of `local_parametrization(x)`."""

    @abstractmethod
    def coordinates(self, x: Vector, v: Vector) -> Float[Array, " d"]:
        """The components (d,) of a tangent vector v in `frame(x)`."""

    def tangent_defect(self, x: Vector, v: Vector) -> Scalar:
        """The norm of the part of v that is not tangent at x."""
        return norm(v - self.projection(x, v))

    def contains(self, x: Vector, tolerance: float = 1e-9) -> Bool[Array, ""]:
        """Whether x is on the manifold: `defect(x) <= tolerance`."""
        return self.defect(x) <= tolerance

    def check_point(self, x: Vector, name: str = "x", tolerance: float = 1e-8) -> None:
        """Raise `ValueError` for a wrong shape, and for a concrete x off the manifold, with the defect."""
        self._check_shape(x, name)
        if is_traced(x):
            return
        defect = evaluated(self.defect, x)
        if is_traced(defect):  # a constant inside a traced function
            return
        if not float(defect) <= tolerance:
            raise ValueError(
                f"{name} is not on {self}: its defect is {float(defect):.3g}, more than {tolerance:.1g}. "
                "Use `nearest` to put it there."
            )

    def check_tangent(self, x: Vector, v: Vector, name: str = "v", tolerance: float = 1e-8) -> None:
        """Raise `ValueError` for a wrong shape, and for a concrete v that is not tangent at x, with the defect."""
        self._check_shape(v, name)
        if is_traced(x, v):
            return
        defect, size = evaluated(self.tangent_defect, x, v), evaluated(norm, v)
        if is_traced(defect, size):
            return
        if not float(defect) <= tolerance * (1.0 + float(size)):
            raise ValueError(
                f"{name} is not tangent to {self} at the given point: its normal part has norm {float(defect):.3g}. "
                "Use `projection` to take it away."
            )

    def _check_shape(self, x: Vector, name: str) -> None:
        if jnp.shape(x) != (self.ambient_dimension,):
            raise ValueError(
                f"{name} must have shape ({self.ambient_dimension},), the ambient coordinates of {self}, but it has "
                f"shape {jnp.shape(x)}: use jax.vmap for a batch."
            )


class AbstractGeodesicManifold(AbstractManifold):
    """A manifold with geodesics — of its metric, or the one-parameter subgroups of a Lie group — and a retraction."""

    @abstractmethod
    def exp(self, x: Vector, v: Vector) -> Vector:
        """The point at time 1 on the geodesic that leaves x with velocity v."""

    @abstractmethod
    def log(self, x: Vector, y: Vector) -> Vector:
        """The velocity at x of the shortest geodesic from x to y: exp(x, log(x, y)) = y.

        At the cut locus, where several are shortest, it is one of them; no value or derivative is NaN there.
        """

    @abstractmethod
    def distance(self, x: Vector, y: Vector) -> Scalar:
        """The distance of two points; its derivative at x = y, which does not exist, is 0."""

    @abstractmethod
    def transport(self, x: Vector, v: Vector, y: Vector) -> Vector:
        """The tangent vector v at x, transported to y along the geodesic between them."""

    @abstractmethod
    def retraction(self, x: Vector, v: Vector) -> Vector:
        """A cheap map from the tangent space at x with R(x, 0) = x and D_v R(x, 0) = id ([RL] Def 6.1)."""

    @abstractmethod
    def inverse_retraction(self, x: Vector, y: Vector) -> Vector:
        """The tangent vector v at x with retraction(x, v) = y, for y near x."""

    @abstractmethod
    def exp_reach(self, x: Vector, v: Vector) -> Scalar:
        """‖v‖ over the injectivity radius: v ↦ exp(x, v) can be inverted by `log` where this is below 1."""

    @abstractmethod
    def retraction_reach(self, x: Vector, v: Vector) -> Scalar:
        """The same for `retraction`: between 0 at v = 0 and 1 at the end of the domain of its inverse."""


class Euclidean(AbstractGeodesicManifold):
    """The vector space R^n."""

    dimension: int = eqx.field(static=True)
    ambient_dimension: int = eqx.field(static=True)

    def __init__(self, dimension: int):
        self.dimension = self.ambient_dimension = dimension

    def defect(self, x):
        return jnp.zeros(())

    def nearest(self, x):
        return x

    def projection(self, x, v):
        return v

    def representative(self, x, near):
        return x

    def local_parametrization(self, x):
        return lambda r: x + r

    def frame(self, x):
        return jnp.eye(self.dimension)

    def coordinates(self, x, v):
        return v

    def exp(self, x, v):
        return x + v

    def log(self, x, y):
        return y - x

    def distance(self, x, y):
        return norm(y - x)

    def transport(self, x, v, y):
        return v

    def retraction(self, x, v):
        return x + v

    def inverse_retraction(self, x, y):
        return y - x

    def exp_reach(self, x, v):
        return jnp.zeros(())

    def retraction_reach(self, x, v):
        return jnp.zeros(())


class Torus(AbstractGeodesicManifold):
    """The torus T^n, a point being n angles in radians, any real numbers, equal modulo 2π; `log` is in [−π, π]."""

    dimension: int = eqx.field(static=True)
    ambient_dimension: int = eqx.field(static=True)

    def __init__(self, dimension: int):
        self.dimension = self.ambient_dimension = dimension

    def defect(self, x):
        return jnp.zeros(())

    def nearest(self, x):
        return x

    def projection(self, x, v):
        return v

    def representative(self, x, near):
        return near + self.log(near, x)

    def local_parametrization(self, x):
        return lambda r: x + r

    def frame(self, x):
        return jnp.eye(self.dimension)

    def coordinates(self, x, v):
        return v

    def exp(self, x, v):
        return x + v

    def log(self, x, y):
        turns = jnp.round((y - x) / (2.0 * jnp.pi))
        return (y - x) - 2.0 * jnp.pi * turns

    def distance(self, x, y):
        return norm(self.log(x, y))

    def transport(self, x, v, y):
        return v

    def retraction(self, x, v):
        return x + v

    def inverse_retraction(self, x, y):
        return self.log(x, y)

    def exp_reach(self, x, v):
        return jnp.max(jnp.abs(v)) / jnp.pi

    def retraction_reach(self, x, v):
        return jnp.max(jnp.abs(v)) / jnp.pi


def Circle() -> Torus:
    """The circle, a point being one angle in radians: `Torus(1)`."""
    return Torus(1)


class Sphere(AbstractGeodesicManifold):
    """The unit sphere S^{n−1} of R^n, n ≥ 2, in ambient coordinates, with the round metric.

    The retraction is (x + v)/‖x + v‖, and its inverse y/⟨x, y⟩ − x is defined on the open hemisphere around x.
    Raises `ValueError` for n < 2.
    """

    dimension: int = eqx.field(static=True)
    ambient_dimension: int = eqx.field(static=True)

    def __init__(self, n: int):
        if n < 2:
            raise ValueError(f"Sphere(n) is the unit sphere of R^n with n ≥ 2, but n = {n} came.")
        self.dimension, self.ambient_dimension = n - 1, n

    def defect(self, x):
        return jnp.abs(norm(x) - 1.0)

    def nearest(self, x):
        return x / norm(x)

    def projection(self, x, v):
        return v - x * jnp.dot(x, v)

    def representative(self, x, near):
        return x

    def local_parametrization(self, x):
        # The frame is only a choice of coordinates, so it is held fixed under differentiation in x.
        frame = jax.lax.stop_gradient(orthonormal_complement(x))
        return lambda r: self.nearest(x + frame @ r)

    def frame(self, x):
        return orthonormal_complement(x)

    def coordinates(self, x, v):
        return orthonormal_complement(x).T @ v

    def exp(self, x, v):
        s = jnp.dot(v, v)
        return radial(0, s) * x + radial(1, s) * v

    def log(self, x, y):
        difference, sum_ = y - x, y + x
        near, far = jnp.dot(difference, difference) / 4.0, jnp.dot(sum_, sum_) / 4.0
        # Both differences have the same tangential part; the short one has it without cancellation.
        direction = arc_over_sine(0, near, far) * self.projection(x, jnp.where(near < far, difference, sum_))
        return jnp.where(far < TINY, jnp.pi * orthonormal_complement(x)[:, 0], direction)

    def distance(self, x, y):
        return 2.0 * jnp.arctan2(norm(y - x), norm(y + x))

    def transport(self, x, v, y):
        along = 1.0 + jnp.dot(x, y)
        return v - jnp.dot(y, v) / jnp.where(along < TINY, 1.0, along) * (x + y)

    def retraction(self, x, v):
        return self.nearest(x + v)

    def inverse_retraction(self, x, y):
        return y / jnp.dot(x, y) - x

    def exp_reach(self, x, v):
        return norm(v) / jnp.pi

    def retraction_reach(self, x, v):
        return jnp.arctan(norm(v)) * (2.0 / jnp.pi)


class Product(AbstractGeodesicManifold):
    """The product M1 × M2 × …, its ambient coordinates, vectors and metric joined in this order.

    Raises `TypeError` for a factor that is not a geodesic manifold.
    """

    factors: tuple[AbstractGeodesicManifold, ...]
    dimension: int = eqx.field(static=True)
    ambient_dimension: int = eqx.field(static=True)

    def __init__(self, *factors: AbstractGeodesicManifold):
        for factor in factors:
            if not isinstance(factor, AbstractGeodesicManifold):
                raise TypeError(f"The factors of Product must be manifolds such as Sphere(3), but {factor!r} came.")
        flat = [factor.factors if isinstance(factor, Product) else (factor,) for factor in factors]
        self.factors = tuple(factor for group in flat for factor in group)
        self.dimension = sum(factor.dimension for factor in factors)
        self.ambient_dimension = sum(factor.ambient_dimension for factor in factors)

    def split(self, x: Vector) -> list[Vector]:
        """The ambient blocks of x, one a factor."""
        return jnp.split(x, np.cumsum([factor.ambient_dimension for factor in self.factors])[:-1].tolist())

    def _blocks(self, method: str, *arguments):
        rows = zip(self.factors, *(self.split(argument) for argument in arguments), strict=True)
        return [getattr(factor, method)(*blocks) for factor, *blocks in rows]

    def defect(self, x):
        return jnp.max(jnp.stack(self._blocks("defect", x)))

    def nearest(self, x):
        return jnp.concatenate(self._blocks("nearest", x))

    def projection(self, x, v):
        return jnp.concatenate(self._blocks("projection", x, v))

    def representative(self, x, near):
        return jnp.concatenate(self._blocks("representative", x, near))

    def local_parametrization(self, x):
        maps = self._blocks("local_parametrization", x)
        ends = np.cumsum([factor.dimension for factor in self.factors])[:-1].tolist()
        return lambda r: jnp.concatenate([f(block) for f, block in zip(maps, jnp.split(r, ends), strict=True)])

    def frame(self, x):
        return jax.scipy.linalg.block_diag(*self._blocks("frame", x))

    def coordinates(self, x, v):
        return jnp.concatenate(self._blocks("coordinates", x, v))

    def exp(self, x, v):
        return jnp.concatenate(self._blocks("exp", x, v))

    def log(self, x, y):
        return jnp.concatenate(self._blocks("log", x, y))

    def distance(self, x, y):
        return norm(jnp.stack(self._blocks("distance", x, y)))

    def transport(self, x, v, y):
        return jnp.concatenate(self._blocks("transport", x, v, y))

    def retraction(self, x, v):
        return jnp.concatenate(self._blocks("retraction", x, v))

    def inverse_retraction(self, x, y):
        return jnp.concatenate(self._blocks("inverse_retraction", x, y))

    def exp_reach(self, x, v):
        return jnp.max(jnp.stack(self._blocks("exp_reach", x, v)))

    def retraction_reach(self, x, v):
        return jnp.max(jnp.stack(self._blocks("retraction_reach", x, v)))


def orthonormal_complement(x: Float[Array, " n"]) -> Float[Array, "n n-1"]:
    """An orthonormal basis of the hyperplane orthogonal to a unit vector x: columns of the reflection of x to ±e_n."""
    identity = np.eye(x.shape[0])
    reflector = x + jnp.where(x[-1] >= 0.0, 1.0, -1.0) * identity[-1]
    scaled = reflector * (2.0 / jnp.dot(reflector, reflector))
    return jnp.asarray(identity[:, :-1]) - jnp.outer(reflector, scaled[:-1])
