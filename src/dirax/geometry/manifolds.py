"""Manifolds as objects: points, tangent vectors, exponentials and retractions, in the coordinates of an ambient R^N.

A point is a vector x (N,), a tangent vector a vector v (N,) of the tangent space at x. A covector p (N,) at x is the
tangent vector that represents it under the inner product of R^N, so ⟨p, v⟩ = p·v. Every function takes one point;
batches go through `jax.vmap`. The vocabulary is that of pymanopt and ManifoldsBase.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import TypeAlias

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from dirax.geometry.squared_angles import Scalar, norm
from dirax.numerics.tolerances import POINT_DEFECT
from dirax.program.tracing import value_along
from dirax.program.user_functions import evaluated, is_traced, note_values_matter

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

    def check_point(self, x: Vector, name: str = "x", tolerance: float = POINT_DEFECT) -> None:
        """Raise `ValueError` for a wrong shape, and for a concrete x off the manifold, with the defect."""
        self._check_shape(x, name)
        if is_traced(x):
            return
        note_values_matter()
        defect = evaluated(self.defect, x)
        if not is_traced(defect):  # a constant inside a traced function
            self._refuse_off(float(defect), name, tolerance)

    def check_tangent(
        self, x: Vector, v: Vector, name: str = "v", tolerance: float = POINT_DEFECT, point: str | None = None
    ) -> None:
        """Raise `ValueError` for a wrong shape, and for a concrete v that is not tangent at x, with the defect; and, where it
        has a name, for a `point` x off the manifold."""
        if point is not None:
            self._check_shape(x, point)
        self._check_shape(v, name)
        if is_traced(x, v):
            return
        note_values_matter()
        off, defect, size = evaluated(self._defects, x, v)
        if is_traced(off, defect, size):
            return
        if point is not None:
            self._refuse_off(float(off), point, tolerance)
        if not float(defect) <= tolerance * (1.0 + float(size)):
            raise ValueError(
                f"{name} is not tangent to {self} at the given point: its normal part has norm {float(defect):.3g}. "
                "Use `projection` to take it away."
            )

    def _defects(self, x: Vector, v: Vector) -> tuple[Scalar, Scalar, Scalar]:
        return self.defect(x), self.tangent_defect(x, v), norm(v)

    def _refuse_off(self, defect: float, name: str, tolerance: float) -> None:
        if not defect <= tolerance:
            raise ValueError(
                f"{name} is not on {self}: its defect is {defect:.3g}, more than {tolerance:.1g}. Use `nearest` to put it there."
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

    def geodesic(self, x: Vector, v: Vector, t: Scalar) -> tuple[Vector, Vector]:
        """The point exp(x, t v) and the velocity there, at time t on the geodesic that leaves x with velocity v."""
        return value_along(lambda t: self.exp(x, t * v), (t,), (jnp.ones_like(t),))

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
