"""Discretization maps R_d: TM → M × M ([BLM] Definition 4.5): how a velocity becomes a pair of points, and back.

(D1) R_d(x, 0) = (x, x), and (D2) D_v R_d²(x, 0) − D_v R_d¹(x, 0) = id, so that R_d is invertible near v = 0
([BLM] Proposition 4.6). A map knows the manifold it lives on as `map.manifold(N)`, N the length of x.
"""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from dirax.geometry.lie_group import AbstractLieGroup
from dirax.geometry.manifolds import AbstractGeodesicManifold, AbstractManifold, Vector
from dirax.geometry.products import Product
from dirax.geometry.spaces import Euclidean, Sphere
from dirax.geometry.squared_angles import Scalar, norm
from dirax.numerics.arrays import is_whole
from dirax.program.user_functions import is_traced
from dirax.text.representation import value_text

Pair = tuple[Vector, Vector]


class AbstractDiscretizationMap(eqx.Module):
    """A discretization map: `map(x, v) -> (x0, x1)` and `map.inverse(x0, x1) -> (x, v)`, all vectors (N,).

    Both raise `ValueError` for concrete arguments that are not on the manifold or not tangent to it, with the defect,
    and for velocities outside the injectivity radius; traced arguments are not looked at. `forward` and `backward` are
    the same functions without any check.
    """

    @property
    def is_known(self) -> bool:
        """Whether it is known to have (D1) and (D2); schemes ask it of others at initial data."""
        return False

    @abstractmethod
    def manifold(self, ambient_dimension: int) -> AbstractManifold:
        """The manifold M of the map, for points of length `ambient_dimension`; `ValueError` if it has another one."""

    @abstractmethod
    def forward(self, x: Vector, v: Vector) -> Pair:
        """R_d(x, v)."""

    @abstractmethod
    def backward(self, x0: Vector, x1: Vector) -> Pair:
        """R_d⁻¹(x0, x1)."""

    @property
    def has_explicit_inverse(self) -> bool:
        """Whether `backward` is a formula, and not a root that is searched for."""
        return True

    @property
    def base_fraction(self) -> float:
        """The fraction of a step at which the base point x of R_d⁻¹(x0, x1) lies: ½, the choice for symmetric maps, unless the
        map says otherwise. Explicit time is taken there."""
        return 0.5

    @abstractmethod
    def reach(self, x: Vector, v: Vector) -> Scalar:
        """‖v‖ in units of the injectivity radius at x: the map and its inverse are used where this is below 1."""

    def __call__(self, x: ArrayLike, v: ArrayLike) -> Pair:
        x, v = jnp.asarray(x, dtype=float), jnp.asarray(v, dtype=float)
        manifold = self.manifold(x.shape[-1])
        manifold.check_point(x, "x")
        manifold.check_tangent(x, v, "v")
        self._check_reach(x, v, "Take a smaller v (a smaller step).")
        return self.forward(x, v)

    def inverse(self, x0: ArrayLike, x1: ArrayLike) -> Pair:
        """The point x and tangent vector v with map(x, v) = (x0, x1)."""
        x0, x1 = jnp.asarray(x0, dtype=float), jnp.asarray(x1, dtype=float)
        manifold = self.manifold(x0.shape[-1])
        manifold.check_point(x0, "x0")
        manifold.check_point(x1, "x1")
        x, v = self.backward(x0, x1)
        self._check_reach(x, v, "The two points are too far apart: take a smaller step.")
        return x, v

    def _check_reach(self, x: Vector, v: Vector, way_out: str) -> None:
        if is_traced(x, v):
            return
        length, reach = norm(v), self.reach(x, v)
        if is_traced(length, reach):  # constants, inside a traced function
            return
        if not (jnp.isfinite(length) and reach < 1.0 - 1e-9):
            raise ValueError(
                f"{type(self).__name__} is used outside its injectivity radius: v has norm {length:.6g}, "
                f"which is {reach:.6g} of the radius and must be less than 1. {way_out}"
            )


class Theta(AbstractDiscretizationMap):
    """R_d(x, v) = (x − θv, x + (1 − θ)v) on R^n, 0 ≤ θ ≤ 1 ([BLM] Example 4.8); θ = ½ is the midpoint rule.

    θ = 0 gives the explicit Euler method, θ = 1 the implicit one. Raises `ValueError` for another θ.
    """

    theta: float = eqx.field(static=True)

    def __check_init__(self):
        _check_theta(self.theta)

    @property
    def is_known(self):
        """It is."""
        return True

    def manifold(self, ambient_dimension):
        """R^N."""
        return Euclidean(ambient_dimension)

    @property
    def base_fraction(self):
        """θ."""
        return self.theta

    def forward(self, x, v):
        """(x − θv, x + (1 − θ)v)."""
        return x - self.theta * v, x + (1.0 - self.theta) * v

    def backward(self, x0, x1):
        """((1 − θ)x0 + θx1, x1 − x0)."""
        return (1.0 - self.theta) * x0 + self.theta * x1, x1 - x0

    def reach(self, x, v):
        """0: every pair of points is reached."""
        return jnp.zeros(())


def Midpoint() -> Theta:
    """R_d(x, v) = (x − v/2, x + v/2) on R^n: `Theta(0.5)`."""
    return Theta(0.5)


class RiemannianExp(AbstractDiscretizationMap):
    """R_d(x, v) = (exp_x(−θv), exp_x((1 − θ)v)) on a Riemannian manifold ([BLM] Example 4.9).

    Raises `TypeError` for a group without a bi-invariant metric, SE(2) and SE(3): `LieGroupExp` is for these.
    """

    space: AbstractGeodesicManifold
    theta: float = eqx.field(static=True, default=0.5)

    def __check_init__(self):
        _check_theta(self.theta)
        for factor in self.space.factors if isinstance(self.space, Product) else (self.space,):
            if not isinstance(factor, AbstractGeodesicManifold):
                raise TypeError(f"RiemannianExp needs a manifold such as Sphere(3), but {factor!r} came.")
            if isinstance(factor, AbstractLieGroup) and not factor.bi_invariant:
                raise TypeError(
                    f"{type(factor).__name__} has no bi-invariant metric, so its one-parameter subgroups are not "
                    f"geodesics: use LieGroupExp({type(factor).__name__}(), theta)."
                )

    @property
    def is_known(self):
        """It is."""
        return True

    def manifold(self, ambient_dimension):
        """`space`; raises `ValueError` for points of another length."""
        return _same_size(self.space, ambient_dimension)

    @property
    def base_fraction(self):
        """θ."""
        return self.theta

    def forward(self, x, v):
        """(exp(x, −θv), exp(x, (1 − θ)v))."""
        return tuple(jax.vmap(lambda time: self.space.exp(x, time * v))(_times(self.theta)))

    def backward(self, x0, x1):
        """The point at time θ of the shortest geodesic from x0 to x1, and the velocity there."""
        return self.space.geodesic(x0, self.space.log(x0, x1), jnp.asarray(self.theta))

    def reach(self, x, v):
        """‖v‖ over the injectivity radius."""
        return self.space.exp_reach(x, v)


class LieGroupExp(AbstractDiscretizationMap):
    """R_d(g, v) = (g exp(−θ g⁻¹v), g exp((1 − θ) g⁻¹v)) on a Lie group ([BLM] Example 4.10).

    Raises `TypeError` for something that is not a Lie group.
    """

    group: AbstractLieGroup
    theta: float = eqx.field(static=True, default=0.5)

    def __check_init__(self):
        _check_theta(self.theta)
        if not isinstance(self.group, AbstractLieGroup):
            raise TypeError(f"LieGroupExp needs a group such as SO3(), but {self.group!r} came.")

    @property
    def is_known(self):
        """It is."""
        return True

    def manifold(self, ambient_dimension):
        """`group`; raises `ValueError` for elements of another length."""
        return _same_size(self.group, ambient_dimension)

    @property
    def base_fraction(self):
        """θ."""
        return self.theta

    def forward(self, x, v):
        """(x exp(−θξ), x exp((1 − θ)ξ)) with ξ = x⁻¹v."""
        xi = self.group.to_algebra(x, v)
        move = lambda time: self.group.multiply(x, self.group.group_exp(time * xi))
        return tuple(jax.vmap(move)(_times(self.theta)))

    def backward(self, x0, x1):
        """(x0 exp(θξ), its left translate of ξ) with ξ = log(x0⁻¹x1)."""
        xi = self.group.group_log(self.group.multiply(self.group.inverse(x0), x1))
        x = self.group.multiply(x0, self.group.group_exp(self.theta * xi))
        return x, self.group.left_translate(x, xi)

    def reach(self, x, v):
        """The angle of rotation over π."""
        return self.group.exp_reach(x, v)


class SphereProjection(AbstractDiscretizationMap):
    """R_d(x, v) = ((x − v/2)/‖x − v/2‖, (x + v/2)/‖x + v/2‖) on the unit sphere of R^n ([BLM] (2)).

    Its inverse is (x0, x1) ↦ ((x0 + x1)/‖x0 + x1‖, 2(x1 − x0)/‖x0 + x1‖); every pair but antipodes is reached.
    """

    @property
    def is_known(self):
        """It is."""
        return True

    def manifold(self, ambient_dimension):
        """The unit sphere of R^N."""
        return Sphere(ambient_dimension)

    def forward(self, x, v):
        """((x − v/2)/‖x − v/2‖, (x + v/2)/‖x + v/2‖)."""
        back, ahead = x - v / 2.0, x + v / 2.0
        return back / norm(back), ahead / norm(ahead)

    def backward(self, x0, x1):
        """((x0 + x1)/‖x0 + x1‖, 2(x1 − x0)/‖x0 + x1‖)."""
        length = norm(x0 + x1)
        return (x0 + x1) / length, 2.0 * (x1 - x0) / length

    def reach(self, x, v):
        """The angle between x0 and x1 over π."""
        return jnp.arctan(norm(v) / 2.0) * (2.0 / jnp.pi)


class ProductMap(AbstractDiscretizationMap):
    """Several maps side by side, on the product of their manifolds: `ProductMap((map, N), (map, N), …)`.

    Each map comes with the ambient dimension N of its block; raises `TypeError` for anything else:

        pendulum = dx.ProductMap((dx.SphereProjection(), 3), (dx.SphereProjection(), 3))   # on S² × S²
    """

    maps: tuple[AbstractDiscretizationMap, ...]
    sizes: tuple[int, ...] = eqx.field(static=True)

    def __init__(self, *blocks: tuple[AbstractDiscretizationMap, int]):
        for block in blocks:
            whole = isinstance(block, tuple | list) and len(block) == 2 and is_whole(block[1]) and block[1] > 0
            if not whole or not isinstance(block[0], AbstractDiscretizationMap):
                raise TypeError(
                    "dx.ProductMap takes pairs of a map and the number of coordinates that it moves, like "
                    f"(dx.SphereProjection(), 3), but {value_text(block)} was given."
                )
        self.maps = tuple(map for map, _ in blocks)
        self.sizes = tuple(int(size) for _, size in blocks)

    def manifold(self, ambient_dimension):
        """The product of the manifolds of the maps; raises `ValueError` for points of another length."""
        factors = [map.manifold(size) for map, size in zip(self.maps, self.sizes, strict=True)]
        return _same_size(Product(*factors), ambient_dimension)  # pyrefly: ignore[bad-argument-type]  # it refuses others

    @property
    def is_known(self):
        """Where all of its maps are."""
        return all(map.is_known for map in self.maps)

    @property
    def has_explicit_inverse(self):
        """Where all factors have one."""
        return all(map.has_explicit_inverse for map in self.maps)

    @property
    def base_fraction(self):
        """That of its maps where they agree, else ½."""
        fractions = {map.base_fraction for map in self.maps}
        return fractions.pop() if len(fractions) == 1 else 0.5

    def forward(self, x, v):
        """Each map on its block."""
        return self._joined("forward", x, v)

    def backward(self, x0, x1):
        """The inverse of each map on its block."""
        return self._joined("backward", x0, x1)

    def reach(self, x, v):
        """The largest of the maps."""
        return jnp.max(jnp.stack([map.reach(*block) for map, *block in self._blocks(x, v)]))

    def _blocks(self, a: Vector, b: Vector):
        ends = np.cumsum(self.sizes)[:-1].tolist()
        return zip(self.maps, jnp.split(a, ends), jnp.split(b, ends), strict=True)

    def _joined(self, method: str, a: Vector, b: Vector) -> Pair:
        firsts, seconds = zip(*(getattr(map, method)(*block) for map, *block in self._blocks(a, b)), strict=True)
        return jnp.concatenate(firsts), jnp.concatenate(seconds)


def _times(theta: float) -> Float[Array, " 2"]:
    return jnp.array([-theta, 1.0 - theta])


def _check_theta(theta: float) -> None:
    if not isinstance(theta, int | float | np.number) or not 0.0 <= theta <= 1.0:
        raise ValueError(f"theta must be in [0, 1], but {theta!r} came; ½ is the midpoint rule.")


def _same_size(manifold: AbstractManifold, ambient_dimension: int) -> AbstractManifold:
    if manifold.ambient_dimension != ambient_dimension:
        raise ValueError(
            f"The map is on {manifold}, whose points have {manifold.ambient_dimension} components, "
            f"but points with {ambient_dimension} came."
        )
    return manifold
