"""Retraction-compatible charts and atlases ([RL] §6): coordinates in which the theory on a vector space holds globally.

A system on a manifold is computed in the chart at a point, (r, ṙ) or (r, p) with r (d,), and changes chart before it
leaves the domain. Everything here is traceable, so a chart may be changed inside a compiled loop.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from dirax.geometry.manifolds import AbstractGeodesicManifold, Vector
from dirax.geometry.squared_angles import Scalar
from dirax.program.tracing import gradient, once, value_along

Local = Float[Array, " d"]


class RetractionChart(eqx.Module):
    """The chart φ at a point m of a manifold with φ(m) = 0 and R(v) = φ⁻¹(dφ_m v) ([RL] Definition 6.2).

    R is the manifold's `retraction`, or its exponential with `exponential=True` (normal coordinates; on a Lie group
    canonical coordinates of the first kind). Coordinates are components in `frame` (N, d), a basis of the tangent space
    at m. Make it with `chart_at(manifold, m)`, which checks m.
    """

    manifold: AbstractGeodesicManifold
    base: Vector
    frame: Float[Array, "N d"]
    exponential: bool = eqx.field(static=True, default=False)

    def to_manifold(self, r: Local) -> Vector:
        """The point φ⁻¹(r) (N,)."""
        return once(_to_manifold)(self, r)

    def to_local(self, x: Vector) -> Local:
        """The coordinates r = φ(x) (d,) of a point of the domain."""
        return once(_to_local)(self, x)

    def components(self, v: Vector) -> Local:
        """The components (d,) in `frame` of a tangent vector v (N,) at m."""
        return (v @ self.frame) / jnp.sum(self.frame**2, axis=0)  # frames of all manifolds have orthogonal columns

    def velocity_to_manifold(self, r: Local, velocity: Local) -> tuple[Vector, Vector]:
        """The point and the tangent vector with coordinates (r, ṙ)."""
        return value_along(self.to_manifold, (r,), (velocity,))

    def velocity_to_local(self, x: Vector, v: Vector) -> tuple[Local, Local]:
        """The coordinates (r, ṙ) of a tangent vector v at x."""
        return value_along(self.to_local, (x,), (v,))

    def momentum_to_manifold(self, r: Local, momentum: Local) -> tuple[Vector, Vector]:
        """The point and the covector (N,), as a tangent vector, with coordinates (r, p)."""
        x = self.to_manifold(r)
        return x, self.manifold.projection(x, _pulled(self.to_local, x, momentum))

    def momentum_to_local(self, x: Vector, p: Vector) -> tuple[Local, Local]:
        """The coordinates (r, p) (d,) of a covector p (N,) at x, given by any vector with the right pairing."""
        x, p = value_along(lambda x: self.manifold.representative(x, self.base), (x,), (p,))
        r = self.to_local(x)
        return r, _pulled(self.to_manifold, r, p)

    def transition(self, r: Local, other: "RetractionChart") -> Local:
        """The coordinates in another chart of the point with coordinates r in this one."""
        return other.to_local(self.to_manifold(r))

    def transition_velocity(self, r: Local, velocity: Local, other: "RetractionChart") -> tuple[Local, Local]:
        """The tangent vector (r, ṙ) in another chart."""
        return value_along(lambda r: self.transition(r, other), (r,), (velocity,))

    def transition_momentum(self, r: Local, momentum: Local, other: "RetractionChart") -> tuple[Local, Local]:
        """The covector (r, p) in another chart: p' = Dτ(r)^{−T} p, through the derivative of the way back τ⁻¹."""
        there = self.transition(r, other)
        return there, _pulled(lambda r: other.transition(r, self), there, momentum)

    def reach(self, r: Local) -> Scalar:
        """How much of the domain is used at r: 0 at m, 1 at the border, where the coordinates end."""
        v = self.frame @ r
        manifold = self.manifold
        return manifold.exp_reach(self.base, v) if self.exponential else manifold.retraction_reach(self.base, v)

    def leaving(self, r: Local, at: float = 0.5) -> Bool[Array, ""]:
        """Whether it is time to change chart: `reach(r) > at`, or r is not finite."""
        return ~(self.reach(r) <= at)


def _to_manifold(chart: RetractionChart, r: Local) -> Vector:
    v = chart.frame @ r
    return chart.manifold.exp(chart.base, v) if chart.exponential else chart.manifold.retraction(chart.base, v)


def _to_local(chart: RetractionChart, x: Vector) -> Local:
    x = chart.manifold.representative(x, chart.base)
    v = chart.manifold.log(chart.base, x) if chart.exponential else chart.manifold.inverse_retraction(chart.base, x)
    return chart.components(v)


def _pulled(function: Callable, at: Float[Array, " k"], covector: Float[Array, " l"]) -> Float[Array, " k"]:
    """The covector pulled back by the derivative of a function."""
    return gradient(lambda x: function(x) @ covector)(at)


def chart_at(
    manifold: AbstractGeodesicManifold, m: ArrayLike, exponential: bool = False, frame: Float[Array, "N d"] | None = None
) -> RetractionChart:
    """The chart at m (N,) compatible with the manifold's retraction, or its exponential ([RL] Definition 6.2).

    `frame` (N, d), with orthogonal columns, chooses the basis of the tangent space; `manifold.frame(m)` by default.

        chart = dx.chart_at(dx.Sphere(3), jnp.array([0.0, 0.0, 1.0]))
        chart.to_manifold(jnp.array([0.3, 0.1]))

    Raises `ValueError` for a point off the manifold, with the defect, or a frame of a wrong shape.
    """
    m = jnp.asarray(m, dtype=float)
    manifold.check_point(m, "m")
    if frame is None:
        frame = manifold.frame(m)
    if frame.shape != (manifold.ambient_dimension, manifold.dimension):
        raise ValueError(
            f"frame must have shape ({manifold.ambient_dimension}, {manifold.dimension}), a basis of the tangent space "
            f"as columns, but it has shape {frame.shape}."
        )
    return RetractionChart(manifold, m, frame, exponential)


class Atlas(eqx.Module):
    """Compatible charts at every point of a manifold, or at the given `centres` (k, N) only, and when to change them.

    A chart is left where more than `leave_at` of its domain is used; with `centres` each point needs one of them nearer
    than that.
    """

    manifold: AbstractGeodesicManifold
    exponential: bool = eqx.field(static=True, default=False)
    leave_at: float = eqx.field(static=True, default=0.5)
    centres: Float[Array, "k N"] | None = None

    def chart_at(self, x: ArrayLike) -> RetractionChart:
        """The chart centred at x, or at the centre nearest to x; raises `ValueError` for a point off the manifold."""
        base = jnp.asarray(x, dtype=float)
        self.manifold.check_point(base)
        if self.centres is not None:
            base = self.centres[jnp.argmin(jax.vmap(self.manifold.distance, (0, None))(self.centres, base))]
        return RetractionChart(self.manifold, base, self.manifold.frame(base), self.exponential)

    def enter(self, x: Vector, p: Vector) -> tuple[RetractionChart, Local, Local]:
        """(chart, r, p): the chart at x and the coordinates of a covector p (N,) at x, given by any vector with the right
        pairing. At its own centre a chart has the derivative `frame`."""
        chart = self.chart_at(x)
        if self.centres is None:
            return chart, jnp.zeros(self.manifold.dimension), chart.frame.T @ p
        return chart, *chart.momentum_to_local(x, p)

    def follow(self, chart: RetractionChart, r: Local, momentum: Local) -> tuple[RetractionChart, Local, Local]:
        """(chart, r, p) as it is while inside the chart, else the same covector in the chart at its point."""

        def change():
            x, p = chart.momentum_to_manifold(r, momentum)
            return self.enter(self.manifold.nearest(x), p)

        return jax.lax.cond(chart.leaving(r, self.leave_at), change, lambda: (chart, r, momentum))


class ChartReport(eqx.Module):
    """What `check_chart` found; all numbers are 0 for a compatible chart."""

    origin_defect: Float[Array, ""]
    """Largest component of φ(m)."""
    retraction_defect: Float[Array, ""]
    """Largest component of R(v) − φ⁻¹(dφ_m v), v the tangent vector at m with components r."""
    pairing_defect: Float[Array, ""]
    """|⟨p, R_m⁻¹(φ⁻¹(r))⟩ − Σ p_i r^i| for p the covector at m with components p_i ([RL] Proposition 6.3)."""


def check_chart(chart: RetractionChart, r: Local, momentum: Local) -> ChartReport:
    """How far a chart fails the identities of [RL] Definition 6.2 and Proposition 6.3, at coordinates r and p (d,)."""
    manifold, m = chart.manifold, chart.base
    origin = jnp.zeros_like(r)
    v = chart.frame @ r
    retracted = manifold.exp(m, v) if chart.exponential else manifold.retraction(m, v)
    components = jax.jvp(chart.to_local, (m,), (v,))[1]
    _, p = chart.momentum_to_manifold(origin, momentum)
    x = chart.to_manifold(r)
    back = manifold.log(m, x) if chart.exponential else manifold.inverse_retraction(m, x)
    return ChartReport(
        origin_defect=jnp.max(jnp.abs(chart.to_local(m))),
        retraction_defect=jnp.max(jnp.abs(retracted - chart.to_manifold(components))),
        pairing_defect=jnp.abs(jnp.dot(p, back) - jnp.dot(momentum, r)),
    )
