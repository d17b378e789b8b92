"""The cotangent lift of a discretization map on Q as Methods 1 and 2 of [BLM] use it on Lagrangian systems.

With B = R_d⁻¹, (q, w) = B(q0, q1) and v = w/h, the lift of (p, ṗ) at (q, v) is (−p0, p1) = DB(q0, q1)ᵀ (h ṗ, p). On a
manifold in R^N covectors are the tangent vectors that represent them, and equations of covectors are paired with a frame.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.geometry.manifolds import AbstractGeodesicManifold, AbstractManifold
from dirax.geometry.maps import AbstractDiscretizationMap
from dirax.program.tracing import along, gradient
from dirax.systems.lagrange_dirac import LagrangeDirac
from dirax.systems.manifold_lagrangian import ManifoldLagrangian


class Base(NamedTuple):
    """The base point of a step: its time, q and v there, and the covectors −p0 at q0 and p1 at q1 of given (p, ṗ)."""

    t: Any
    q: Float[Array, " N"]
    v: Float[Array, " N"]
    q0: Float[Array, " N"]
    q1: Float[Array, " N"]


class Lift(NamedTuple):
    """The cotangent lift of a map on a manifold of dimension d in R^N, with what puts unknowns on it."""

    map: AbstractDiscretizationMap
    manifold: AbstractManifold

    @property
    def dimension(self) -> int:
        """That of the manifold."""
        return self.manifold.dimension

    @property
    def flat(self) -> bool:
        """Whether the ambient coordinates are coordinates of the manifold."""
        return self.manifold.dimension == self.manifold.ambient_dimension

    def end(self, q0: Array, change: Float[Array, " d"]) -> Float[Array, " N"]:
        """The point that is `change` away from q0 in a local parametrization there, on the manifold to roundoff."""
        return q0 + change if self.flat else self.manifold.local_parametrization(q0)(change)

    def change(self, q0: Array, q1: Array) -> Float[Array, " d"]:
        """The inverse of `end`; raises `ValueError` for a manifold without a retraction."""
        if self.flat:
            return q1 - q0
        if not isinstance(self.manifold, AbstractGeodesicManifold):
            raise ValueError(f"{self.manifold!r} has no retraction that joins two points: give q= with v= or p=.")
        return self.manifold.coordinates(q0, self.manifold.inverse_retraction(q0, q1))

    def step(self, q0: Array, u: Float[Array, " d"], t: Any, h: Any) -> Base:
        """The base point of the step whose end is h u away from q0."""
        return self.base(q0, self.end(q0, h * u), t, h)

    def base(self, q0: Array, q1: Array, t: Any, h: Any) -> Base:
        """The base point of the step from q0 to q1."""
        q, w = self.map.backward(q0, q1)
        return Base(t + self.map.base_fraction * h, q, w / h, q0, q1)

    def lifted(self, at: Base, force: Array, momentum: Array) -> tuple[Array, Array]:
        """(−p0, p1) = DBᵀ (force, momentum), tangent vectors at q0 and q1."""
        force, momentum = (jnp.asarray(x) for x in (force, momentum))

        def paired(q0, q1):
            q, w = self.map.backward(q0, q1)
            return force @ q + momentum @ w

        first, last = gradient(paired, (0, 1))(at.q0, at.q1)
        return self.tangential(at.q0, first), self.tangential(at.q1, last)

    def balance(self, p0: Array, at: Base, rate: Array, momentum: Array, h: Any) -> Float[Array, " d"]:
        """The components of p0 − (p0 of the lift)."""
        return self.paired(at.q0, p0 + self.lifted(at, h * rate, momentum)[0])

    def first_momentum(self, at: Base, rate: Array, momentum: Array, h: Any) -> Float[Array, " N"]:
        """p0."""
        return -self.lifted(at, h * rate, momentum)[0]

    def last_momentum(self, p0: Array, at: Base, rate: Array, momentum: Array, h: Any) -> Float[Array, " N"]:
        """p1, with what is missed of the balance: v is a difference of points over h, and p has 1/h times their roundoff."""
        minus_p0, p1 = self.lifted(at, h * rate, momentum)
        return p1 + self.tangential(at.q1, self.tangential(at.q0, p0 + minus_p0))

    def tangential(self, q: Array, vector: Array) -> Float[Array, " N"]:
        """The tangent part at q of an ambient vector."""
        return vector if self.flat else self.manifold.projection(q, vector)

    def paired(self, q: Array, covector: Array) -> Float[Array, " d"]:
        """The components of a covector at q, paired with a fixed frame there."""
        if self.flat:
            return covector
        return jax.lax.stop_gradient(self.manifold.frame(q)).T @ self.manifold.projection(q, covector)

    def tangents(self, q0: Array, q: Array) -> Float[Array, "N d"]:
        """A basis of the tangent space at q by columns, smooth in q: a frame at q0, projected."""
        if self.flat:
            return jnp.eye(self.manifold.dimension)
        fixed = jax.lax.stop_gradient(self.manifold.frame(q0))
        return jax.vmap(lambda f: self.manifold.projection(q, f), 1, 1)(fixed)

    def frame(self, q: Array) -> Float[Array, "N d"]:
        """The frame of `end`: a basis of the tangent space at q by columns."""
        return jnp.eye(self.manifold.dimension) if self.flat else self.manifold.frame(q)

    def components(self, q: Array, v: Array) -> Float[Array, " d"]:
        """The components of a tangent vector in the frame of `end`."""
        return v if self.flat else self.manifold.coordinates(q, v)

    def turning(self, q: Array, v: Array) -> Float[Array, " N"]:
        """The normal part of v̇ for a curve with velocity v on the manifold."""
        return along(lambda q: self.manifold.projection(q, v), (q,), (v,))


def lift_of(map: AbstractDiscretizationMap, system: LagrangeDirac | ManifoldLagrangian, size: int) -> Lift:
    """The lift of a map for a Lagrangian system with points of length `size`; raises `ValueError` where the map has another
    manifold than the system."""
    manifold = map.manifold(size)
    if isinstance(system, ManifoldLagrangian):
        if system.manifold != manifold:
            raise ValueError(f"the system is on {system.manifold}, but the map {type(map).__name__} is on {manifold}.")
    elif manifold.dimension != size:
        raise ValueError(
            f"the map {type(map).__name__} is on {manifold}, but the q of a dx.{type(system).__name__} are {size} coordinates: "
            "state the Lagrangian on the manifold, dx.ManifoldLagrangian(lagrangian, manifold, one_forms=…, forces=…)."
        )
    return Lift(map, manifold)


class ThetaLift(NamedTuple):
    """The lift of the θ map on R^n in closed form, (p0, p1) = (p − (1 − θ)h ṗ, p + θh ṗ), without differences of points."""

    theta: float
    dimension: int
    flat = True

    def components(self, q: Array, v: Array) -> Float[Array, " n"]:
        return v

    def change(self, q0: Array, q1: Array) -> Float[Array, " n"]:
        return q1 - q0

    def step(self, q0: Array, u: Float[Array, " n"], t: Any, h: Any) -> Base:
        return Base(t + self.theta * h, q0 + self.theta * h * u, u, q0, q0 + h * u)

    def balance(self, p0: Array, at: Base, rate: Array, momentum: Array, h: Any) -> Float[Array, " n"]:
        return p0 + (1.0 - self.theta) * h * rate - momentum

    def first_momentum(self, at: Base, rate: Array, momentum: Array, h: Any) -> Float[Array, " n"]:
        return momentum - (1.0 - self.theta) * h * rate

    def last_momentum(self, p0: Array, at: Base, rate: Array, momentum: Array, h: Any) -> Float[Array, " n"]:
        # p0 + h ṗ, written from the base point so that p keeps to the image of the Legendre transform
        return momentum + self.theta * h * rate
