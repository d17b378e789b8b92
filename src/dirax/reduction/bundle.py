"""Trivial principal bundles Q = Σ × G of manifolds in R^N, with the group acting on its factor from the left ([RL] §6)."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dirax.geometry.charts import RetractionChart
from dirax.geometry.lie_group import AbstractLieGroup
from dirax.geometry.manifolds import AbstractGeodesicManifold, AbstractManifold
from dirax.geometry.products import Product
from dirax.geometry.spaces import AbstractFlat, Euclidean
from dirax.numerics.tolerances import STRUCTURE_DEFECT
from dirax.program.tracing import gradient, jacobian
from dirax.program.user_functions import UserFunction, evaluated
from dirax.reduction.actions import AbstractAction
from dirax.reduction.connection import SAMPLES, AbstractConnection, LinearConnection, check_fibre, picked


class GroupConnection(eqx.Module):
    """A discrete principal connection on Q = Σ × G, where G acts on its factor of a product of manifolds from the left.

    `lift(x0, x1)` is h⁰_d(x0, x1) ∈ G of two points of Σ, an element (N_G,), e where x0 = x1: the horizontal point over x1 from
    (x0, g) is (x1, g h⁰_d(x0, x1)), and the vertical part of a pair is (h⁰_d)⁻¹ g0⁻¹ g1 ([RL] Definition 2.1, abelian).
    By default e, the product connection. `group` is the factor of the system's manifold, a `dx.SO3()` and others, or a
    `dx.Euclidean` or `dx.Torus`; `factor` its number, where several are equal.

        tilted = dx.GroupConnection(dx.SO3(), lambda x0, x1: dx.SO3().group_exp(0.3 * jnp.cross(x0, x1)))
        dx.reduce(dx.ManifoldLagrangian(L, dx.Product(dx.Sphere(3), dx.SO3())), tilted)

    Raises `TypeError` for what is no group, and for a lift of other arguments.
    """

    group: AbstractLieGroup | AbstractFlat
    lift: UserFunction | None
    factor: int | None = eqx.field(static=True)

    def __init__(self, group: AbstractLieGroup | AbstractFlat, lift: Callable | None = None, factor: int | None = None):
        if not isinstance(group, AbstractLieGroup | AbstractFlat):
            raise TypeError(f"group must be one such as dx.SO3() or dx.Torus(2), but {group!r} was given.")
        self.group, self.factor = group, factor
        self.lift = None if lift is None else UserFunction(lift, "lift", ("x0", "x1"))
        if self.lift is not None and self.lift.takes_params:
            raise TypeError("lift takes (x0, x1) alone: a connection has no parameters.")

    def on(self, manifold: AbstractManifold) -> "TrivialBundle":
        """The bundle over the other factors; raises `ValueError` for a manifold that the group is no factor of."""
        factors = manifold.factors if isinstance(manifold, Product) else (manifold,)
        equal = [number for number, factor in enumerate(factors) if factor == self.group]
        if self.factor is not None:
            equal = [number for number in equal if number == self.factor]
        if len(equal) != 1 or len(factors) == 1:
            name, whole = type(self.group).__name__, " × ".join(type(factor).__name__ for factor in factors)
            if len(equal) > 1:
                raise ValueError(f"{name} is {len(equal)} factors of {whole}, numbers {equal}: say which, factor=….")
            found = "all" if equal else "no factor" if self.factor is None else f"not factor number {self.factor}"
            raise ValueError(
                f"dx.reduce by a factor G takes a manifold Q = Σ × G, but {name} is {found} of {whole}: take a factor of it, or "
                "where it is all reduce by the Lie group, dx.reduce(system, group)."
            )
        number = equal[0]
        first = sum(factor.ambient_dimension for factor in factors[:number])
        fibre = tuple(range(first, first + self.group.ambient_dimension))
        return _bundle(manifold, factors, fibre, self.group, None if self.lift is None else self)

    def lift_of_shapes(self, x0: Array, x1: Array) -> Array:
        """h⁰_d(x0, x1)."""
        return self.group.identity() if self.lift is None else self.lift(x0, x1, None)


def translations_on(manifold: AbstractManifold, connection: AbstractConnection) -> "TrivialBundle":
    """The bundle of translations in the `fibre` of a connection, coordinates of flat factors, whose horizontal lift is a
    function of the points of Σ in R^N. Raises `ValueError` for other coordinates."""
    factors = manifold.factors if isinstance(manifold, Product) else (manifold,)
    check_fibre(connection.fibre, manifold.ambient_dimension)
    connection.check(manifold.ambient_dimension, lambda q: np.asarray(manifold.nearest(jnp.asarray(q))))
    owners = [factor for factor in factors for _ in range(factor.ambient_dimension)]
    for index in connection.fibre:
        if not isinstance(owners[index], AbstractFlat):
            raise ValueError(
                f"fibre {list(connection.fibre)} has q[{index}], a coordinate of {owners[index]}, in which translations do not "
                "act: take coordinates of R^n or of a torus, name a group by dx.GroupConnection, or write the system in "
                "coordinates of its manifold in which they do, dx.in_coordinates."
            )
    plain = isinstance(connection, LinearConnection) and connection.horizontal is None
    return _bundle(manifold, factors, connection.fibre, Euclidean(len(connection.fibre)), None if plain else connection)


def _bundle(manifold: Any, factors: Any, fibre: tuple[int, ...], group: Any, connection: Any) -> "TrivialBundle":
    """Over the factors without the coordinates of the fibre."""
    rest, number_of, first, first_local = [], {}, 0, 0
    for factor in factors:
        taken = [i for i in fibre if first <= i < first + factor.ambient_dimension]
        if len(taken) < factor.ambient_dimension:
            rest.append(factor if not taken else type(factor)(factor.ambient_dimension - len(taken)))
        if taken and isinstance(factor, AbstractFlat):
            number_of |= {i: (first_local + i - first,) for i in taken}
        elif taken:
            number_of[first] = tuple(range(first_local, first_local + factor.dimension))
        first, first_local = first + factor.ambient_dimension, first_local + factor.dimension
    if not rest:
        raise ValueError(f"the group is all of {manifold}: reduce by a smaller one, or by a Lie group alone.")
    local_fibre = tuple(number for i in fibre for number in number_of.get(i, ()))
    return TrivialBundle(manifold, rest[0] if len(rest) == 1 else Product(*rest), group, fibre, local_fibre, connection)


class TrivialBundle(eqx.Module):
    """Q = Σ × G with a discrete connection: points q = (x, g) in R^N, coordinates (r, s) in retraction-compatible charts.

    The chart of G at g is left-invariant, so that its coordinates at g h are those at h: what is invariant is computed at e.
    """

    manifold: AbstractGeodesicManifold
    shapes: AbstractGeodesicManifold
    group: AbstractLieGroup | AbstractFlat
    fibre: tuple[int, ...] = eqx.field(static=True)
    local_fibre: tuple[int, ...] = eqx.field(static=True)
    connection: GroupConnection | AbstractConnection | None
    """h⁰_d of points x; None where it is e."""

    @property
    def k(self) -> int:
        """The dimension of G."""
        return self.group.dimension

    @property
    def abelian(self) -> bool:
        """Whether G is one of translations, or of rotations of the plane."""
        return isinstance(self.group, AbstractFlat) or self.k == 1

    def split(self, q: Array) -> tuple[Array, Array]:
        """(x, g) of a point, a vector or a covector in R^N."""
        return _split(q, self.fibre)

    def join(self, x: Array, g: Array) -> Array:
        """The inverse of `split`."""
        return _join(x, g, self.fibre)

    def split_local(self, r: Array) -> tuple[Array, Array]:
        """The coordinates of Σ and of G."""
        return _split(r, self.local_fibre)

    def join_local(self, r: Array, s: Array) -> Array:
        """The inverse of `split_local`."""
        return _join(r, s, self.local_fibre)

    # ------------------------------------------------------------------ charts

    def chart_of_shapes(self, m: Array) -> RetractionChart:
        """The chart of Σ at m."""
        return RetractionChart(self.shapes, m, self.shapes.frame(m))

    def chart_of_group(self, g: Array) -> RetractionChart:
        """The chart of G at g, left-invariant."""
        return RetractionChart(self.group, g, self.group.frame(g))

    def body(self, q: Array, p: Array) -> tuple[Array, Array]:
        """(p_x, μ) of a covector p at q, with μ (k,) its components along left-invariant vectors: the body momentum."""
        (_, g), (p_x, p_g) = self.split(q), self.split(p)
        return p_x, self.group.frame(g).T @ p_g

    def covector(self, q: Array, p_x: Array, mu: Array) -> Array:
        """The inverse of `body`."""
        frame = self.group.frame(self.split(q)[1])  # its columns are orthogonal
        return self.join(p_x, frame @ (mu / jnp.sum(frame**2, axis=0)))

    def to_identity(self, q: Array, *vectors: Array) -> tuple[Array, ...]:
        """(x, e), and tangent vectors at q translated there."""
        x, g = self.split(q)
        e = self.group.identity()
        there, here = self.group.frame(e), self.chart_of_group(g)
        parts = [self.split(v) for v in vectors]
        return self.join(x, e), *(self.join(v_x, there @ here.components(v_g)) for v_x, v_g in parts)

    def between(self, g0: Array, g1: Array) -> Array:
        """g0⁻¹ g1."""
        return self.chart_of_group(self.group.identity()).to_manifold(self.chart_of_group(g0).to_local(g1))

    # ------------------------------------------------------------------ the connection

    def step_along(self, x0: Array, x1: Array, vertical: Array) -> Array:
        """The coordinates s at e of f = h⁰_d(x0, x1) · v, for the vertical part v with coordinates `vertical` at e."""
        if self.connection is None:
            return vertical
        here, lifted = self.chart_of_group(self.group.identity()), self.chart_of_group(self.connection.lift_of_shapes(x0, x1))
        return here.to_local(lifted.to_manifold(vertical))

    def vertical_of(self, x0: Array, x1: Array, along: Array) -> Array:
        """The inverse: `vertical` of the s of f."""
        if self.connection is None:
            return along
        here, lifted = self.chart_of_group(self.group.identity()), self.chart_of_group(self.connection.lift_of_shapes(x0, x1))
        return lifted.to_local(here.to_manifold(along))

    def shift(self, x: Array, mu: Array) -> Array:
        """A(x)ᵀ μ, a covector of Σ at x as a tangent vector, with A(x) the derivative of h⁰_d(x, ·) at x."""
        if self.connection is None:
            return jnp.zeros_like(x)
        return self.shapes.projection(x, gradient(lambda x1: mu @ self._lifted(x, x1))(x))

    def matrix(self, chart: RetractionChart, r: Array) -> Float[Array, "k d"]:
        """A in the coordinates of a chart of Σ, at r."""
        if self.connection is None:
            return jnp.zeros((self.k, self.shapes.dimension))
        x = chart.to_manifold(r)
        return jacobian(lambda r: self._lifted(x, chart.to_manifold(r)))(r)

    def _lifted(self, x0, x1):
        """The coordinates of h⁰_d at e."""
        return self.step_along(x0, x1, jnp.zeros(self.k))

    def check(self) -> None:
        """Raise `ValueError` where h⁰_d is no lift: of a wrong shape, off the group, or not e on the diagonal."""
        if self.connection is None:
            return
        lift, random = self.connection.lift_of_shapes, np.random.default_rng(0)
        start = np.eye(self.shapes.ambient_dimension)[0]
        points = random.normal(size=(2 * SAMPLES, self.shapes.ambient_dimension)) + start

        def at(a, b):
            x0, x1 = self.shapes.nearest(a), self.shapes.nearest(b)
            return lift(x0, x0), lift(x0, x1), x0, x1

        for a, b in zip(points[::2], points[1::2], strict=True):
            fixed, moved, x0, x1 = (np.asarray(value) for value in evaluated(at, a, b))
            if moved.shape != (self.group.ambient_dimension,):
                raise ValueError(
                    f"lift(x0, x1) must return an element of {self.group}, of shape ({self.group.ambient_dimension},), but it "
                    f"returned shape {moved.shape}."
                )
            off = float(self.group.defect(jnp.asarray(moved)))
            if not (np.all(np.isfinite(moved)) and off <= STRUCTURE_DEFECT):
                raise ValueError(f"lift(x0, x1) is no element of {self.group} at x0 = {x0}, x1 = {x1}: it is {moved}.")
            defect = float(np.max(np.abs(fixed - np.asarray(self.group.identity()))))
            if not defect <= STRUCTURE_DEFECT:
                raise ValueError(f"the connection is none: h⁰_d(x, x) = e fails by {defect:.3g} at x = {x0}.")


class FactorTranslation(AbstractAction):
    """Φ_ξ(x, g) = (x, exp(ξ) g), or (x, g + ξ), on a bundle."""

    bundle: TrivialBundle

    def dimension(self) -> int:
        """k."""
        return self.bundle.k

    def check(self, q: Float[Array, " N"]) -> None:
        """Raise `ValueError` where q is no point of the bundle."""
        self.bundle.manifold.check_point(q, "q")

    def __call__(self, g: Float[Array, " k"], q: Float[Array, " N"]) -> Float[Array, " N"]:
        """exp(g) q."""
        x, element = self.bundle.split(q)
        group = self.bundle.group
        return self.bundle.join(x, group.multiply(group.group_exp(g), element))


def _split(q: Array, fibre: tuple[int, ...]) -> tuple[Array, Array]:
    others = np.setdiff1d(np.arange(q.shape[-1]), fibre)
    return picked(q, others), picked(q, np.array(fibre))


def _join(x: Array, g: Array, fibre: tuple[int, ...]) -> Array:
    n = x.shape[-1] + g.shape[-1]
    order = np.argsort(np.concatenate([np.setdiff1d(np.arange(n), fibre), fibre]))
    return picked(jnp.concatenate([x, g]), order)
